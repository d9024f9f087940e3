"""Miss rates of a detector over azimuth and degradation, with intervals over recordings."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import pairwise
from operator import add
from typing import Literal, NamedTuple

import numpy as np

from worldstate.adapters.camera.camera_health import LEVELS, Family
from worldstate.adapters.camera.detections import DetectionLog
from worldstate.adapters.camera.miss_rates import FamilyCounts, MissRates, as_tuples
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray, IndexArray
from worldstate.operations.detectors.miss_rate_measurement import REPEATS, AbsenceSettings, AbsenceTally
from worldstate.operations.recordings.hop_table import HopTable
from worldstate_lab.metrics.intervals import draw_weights, middle, ratio

from .conditions import FAMILIES, at_level, detections_in, health_of

# Misses are counted as in `measure-absence`, in every sweep.
SETTINGS = AbsenceSettings(families=FAMILIES)
# With fewer looks, a single vehicle changes the rate of a bin by more than the compared differences.
FEWEST_LOOKS = 20

Counts = Mapping[str, FamilyCounts]


class Band(NamedTuple):
    """Values with the central 95 % over resampled recordings, arrays of one shape."""

    value: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True, slots=True)
class Fall:
    """A step at which beta decreases although it should increase.

    Examples
    --------
    >>> Fall("azimuth", "blur 0.5 at 20-30 deg", 0.08, -0.1, 0.3).certain
    False
    """

    along: Literal["degradation", "azimuth"]
    where: str  # Description of the step
    by: float
    low: float  # Central 95 % over resampled recordings
    high: float

    @property
    def certain(self) -> bool:
        """Whether the central 95 % of the draws contain no increase."""
        return self.low > 0.0


@dataclass(frozen=True, slots=True, eq=False)
class BetaCurves:
    """Measured beta(theta, d) of one detector: misses divided by looks, NaN without a look."""

    azimuth_deg: tuple[float, ...]  # Edges of the bins, angle to the optical axis
    looks: FloatArray  # shape (families, bins, levels)
    by_azimuth: Band  # Same shape; families as in `FAMILIES`, level 0 is the clean camera
    overall: Band  # shape (families, levels): All azimuths
    falls: tuple[Fall, ...]  # Largest first

    @property
    def bins(self) -> tuple[str, ...]:
        """The azimuth bins as text."""
        edges = self.azimuth_deg
        return tuple(f"{low:.0f}-{high:.0f} deg" for low, high in pairwise(edges))


def absence_counts(reference: DetectionLog, boxes: HopTable) -> dict[str, FamilyCounts]:
    """Count the misses of a detector against the reference of one recording, in every condition."""
    tally = AbsenceTally(PinholeCamera.ovad(), SETTINGS)
    for family, level in staged_levels():
        for number, found in enumerate(detections_in(boxes, at_level(family, level).name).frames):
            tally.count(reference, number, found, family, level)
    return tally.counts()


def staged_levels() -> list[tuple[Family, int]]:
    """Return every level of every family; the clean camera belongs to all of them but is counted once."""
    return [(one, level) for one in FAMILIES for level in range(one != FAMILIES[0], len(LEVELS))]


def pooled(counts: Sequence[Counts]) -> dict[str, FamilyCounts]:
    """Return the counts of several recordings together."""
    return {family: reduce(add, [one[family] for one in counts]) for family in FAMILIES}


def counts_table(counts: Counts) -> HopTable:
    """Return counts as a table for a cache: one row per family and azimuth bin, the last for clutter."""
    rows = [
        (family, *row)
        for family, one in counts.items()
        for row in (*zip(one.looks, one.misses, strict=True), (one.sectors, one.clutter))
    ]
    return HopTable.of_rows(("family", "looks", "misses"), rows)


def counts_of(table: HopTable) -> dict[str, FamilyCounts]:
    """Return the counts from a table of `counts_table`."""
    counts = {}
    for family in FAMILIES:
        chosen = table.family == family
        looks, misses = (as_tuples(table.columns[name][chosen]) for name in ("looks", "misses"))
        counts[str(family)] = FamilyCounts(looks[:-1], misses[:-1], looks[-1], misses[-1])
    return counts


def pooled_rates(
    counts: Sequence[Counts], readings: Sequence[HopTable], provenance: Mapping[str, str]
) -> MissRates:
    """Return the miss rates of several recordings together, with the health scale of their camera."""
    families = pooled(counts)
    if not np.sum(families[FAMILIES[0]].looks):
        raise InvalidArgumentError("recordings: expected moving objects in view to measure beta on")
    edges = SETTINGS.edges_deg(PinholeCamera.ovad())
    return MissRates(edges, families, provenance, health_of(readings), REPEATS)


def beta_curves(counts: Sequence[Counts], draws: IndexArray) -> BetaCurves:
    """Return the curves of all recordings; `draws` (draws, recordings) lists the recordings of each draw."""
    edges = SETTINGS.edges_deg(PinholeCamera.ovad())
    looks, misses = (
        np.array([[getattr(one[family], name) for family in FAMILIES] for one in counts])
        for name in ("looks", "misses")
    )
    weight = draw_weights(draws, len(counts))
    drawn_bins = ratio(np.tensordot(weight, misses, 1), np.tensordot(weight, looks, 1))
    drawn_all = ratio(np.tensordot(weight, misses.sum(axis=2), 1), np.tensordot(weight, looks.sum(axis=2), 1))
    total, missed = looks.sum(axis=0), misses.sum(axis=0)
    by_azimuth = _band(ratio(missed, total), drawn_bins)
    overall = _band(ratio(missed.sum(axis=1), total.sum(axis=1)), drawn_all)
    found = BetaCurves(edges, total, by_azimuth, overall, ())
    falls = sorted(_falls(found, drawn_bins, drawn_all), key=lambda fall: -fall.by)
    return replace(found, falls=tuple(falls))


def _falls(curves: BetaCurves, drawn_bins: FloatArray, drawn_all: FloatArray) -> Iterator[Fall]:
    for i, family in enumerate(FAMILIES):
        by = -np.diff(curves.overall.value[i])
        for level in np.flatnonzero(by > 0.0).tolist():
            where = f"{family} {LEVELS[level]:g} to {LEVELS[level + 1]:g}"
            drawn = drawn_all[:, i, level] - drawn_all[:, i, level + 1]
            yield Fall("degradation", where, float(by[level]), *middle(drawn))
    for family, level in staged_levels():
        i = FAMILIES.index(family)
        beta = curves.by_azimuth.value[i, :, level]
        for a, b in pairwise(np.flatnonzero(curves.looks[i, :, level] >= FEWEST_LOOKS)):
            if beta[a] > beta[b]:
                where = f"{at_level(family, level).name}, {curves.bins[a]} to {curves.bins[b]}"
                drawn = drawn_bins[:, i, a, level] - drawn_bins[:, i, b, level]
                yield Fall("azimuth", where, float(beta[a] - beta[b]), *middle(drawn))


def _band(value: FloatArray, drawn: FloatArray) -> Band:
    flat = drawn.reshape(len(drawn), -1)
    low, high = np.array([middle(column) for column in flat.T]).T.reshape(2, *value.shape)
    return Band(value, low, high)
