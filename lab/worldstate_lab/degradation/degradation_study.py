"""The paper's degradation sweep: miss rates of two detectors, and awareness with a degraded camera."""

import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from worldstate.adapters.camera.miss_rates import MissRates
from worldstate.adapters.camera.video import VIDEO_NAME, open_video
from worldstate.adapters.datasets.ovad import Recording
from worldstate.adapters.files.model_file import read_model
from worldstate.adapters.source import open_source
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.ground.serialisation import encode
from worldstate.ground.typing import BoolArray
from worldstate.operations.recordings.hop_table import HopTable
from worldstate_lab.degradation import conditions, staged_filter
from worldstate_lab.metrics.intervals import deal_folds, stratified_draws

from .awareness import Awareness, AwarenessRow, hazard_awareness
from .beta_curves import (
    BetaCurves,
    Counts,
    absence_counts,
    beta_curves,
    counts_of,
    counts_table,
    pooled_rates,
)
from .conditions import FAMILIES, RAIN_DB, READINGS, StagedDetector, look, motion_detectors
from .staged_filter import Camera, by_condition, filter_in_conditions

# Minimum of each kind: with fewer, no recording remains on which to set thresholds and miss rates.
LEAST = 2


def sweep_data(
    recordings: Sequence[Recording], approaches: int = 12, hazard_free: int = 12
) -> tuple[list[Recording], list[str]]:
    """Choose recordings with video and a standing ego of each kind, evenly over junctions and sides.

    The result has the recordings, approaches first, and descriptions of those that are missing.

    Examples
    --------
    >>> try:
    ...     sweep_data([], approaches=2, hazard_free=0)
    ... except InvalidArgumentError as error:
    ...     print(str(error).partition("; ")[2])
    2 of 2 approaches with video are missing
    """
    chosen, missing = [], []
    kinds = ("approaches", approaches, False), ("hazard-free recordings", hazard_free, True)
    for name, number, free in kinds:
        found = [one for one in recordings if (one.label == "none") == free]
        usable = [one for one in found if _usable(one)]
        chosen.append(_evenly(usable, number))
        if len(usable) < number:
            missing.append(f"{number - len(usable)} of {number} {name} with video are missing{_why(found)}")
    if min(map(len, chosen)) < LEAST:
        least = f"{LEAST} approaches and {LEAST} hazard-free recordings with video"
        raise InvalidArgumentError(f"recordings: a sweep needs {least}; {'; '.join(missing)}")
    return chosen[0] + chosen[1], missing


def _usable(recording: Recording) -> bool:
    # With a moving camera every box moves, so there is no reference.
    standing = not recording.moving_ego and recording.label is not None
    return standing and recording.detections_path is not None and (recording.path / VIDEO_NAME).is_file()


def _why(found: Sequence[Recording]) -> str:
    without = [one.recording_id for one in found if not one.moving_ego and not _usable(one)]
    if not without:
        return ""
    more = f" and {len(without) - 3} more" if len(without) > 3 else ""
    return f": no {VIDEO_NAME} or no detections beside {', '.join(without[:3])}{more}"


def _evenly(recordings: Sequence[Recording], number: int) -> list[Recording]:
    """Take one recording of each junction and side in turn; the order of the data set is kept."""
    taken: Counter[tuple[str | None, str | None]] = Counter()
    ranked = []
    for place, one in enumerate(recordings):
        stratum = (one.environment, one.label)
        # Sides are taken before junctions, so that a remainder is spread over as many junctions as possible.
        ranked.append((taken[stratum], one.label or "", place))
        taken[stratum] += 1
    return [recordings[place] for place in sorted(place for *_, place in sorted(ranked)[:number])]


Tables = Mapping[str, HopTable]
# Caches the result of a pass over a recording: name of the pass, the data that it depends on, and a function
# that computes it.
Keep = Callable[[str, object, Callable[[], Tables]], Tables]
# Applies a function to every item, in order; a text result describes why a recording failed.
Over = Callable[[Callable[["SweepItem"], Tables], Sequence["SweepItem"]], Iterable[Tables | str]]


@dataclass(frozen=True, slots=True)
class DegradationSettings:
    """Options of a sweep.

    Parameters
    ----------
    detectors : tuple of StagedDetector
        Detectors with unique names, run in every condition; by default two kinds of background subtraction.
    model : Path, optional
        Signature model; by default the shipped one.
    approaches, hazard_free : int
        Number of recordings of each kind.
    width_px : int
        Images are reduced to this width once, before degradation, so that detectors need not reduce them
        further.
    seed : int
        Seed of noise, folds and intervals.

    Examples
    --------
    >>> DegradationSettings().approaches
    12
    """

    detectors: tuple[StagedDetector, ...] = field(default_factory=motion_detectors)
    model: Path | None = None
    approaches: int = 12
    hazard_free: int = 12
    width_px: int = 640
    seed: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class DetectorSweep:
    """Miss rates and awareness of one detector."""

    detector: str
    beta: BetaCurves
    awareness: Awareness

    @property
    def least_awareness(self) -> AwarenessRow:
        """The condition of the paper's sweep with the lowest awareness."""
        return min(self._paper(), key=lambda row: row.awareness.value)

    @property
    def least_vision(self) -> AwarenessRow:
        """The condition of the paper's sweep with the lowest awareness of vision alone."""
        return min(self._paper(), key=lambda row: row.vision.value)

    def family(self, name: str) -> list[AwarenessRow]:
        """Return the clean row and the rows of a family, by level."""
        rows = self.awareness.rows
        return [rows[0], *(row for row in rows if row.condition.family == name)]

    def _paper(self) -> list[AwarenessRow]:
        return [row for family in FAMILIES for row in self.family(family)]


@dataclass(frozen=True, slots=True, eq=False)
class DegradationStudy:
    """Miss rates and awareness of every detector on the same recordings.

    Parameters
    ----------
    sweeps : tuple of DetectorSweep
        In the order of the settings.
    approaches, hazard_free : tuple of str
        Names of the recordings used.
    skipped : mapping of str to str
        Recordings that failed, with the reason.
    missing : tuple of str
        Descriptions of missing recordings.
    settings : DegradationSettings
        The options of the sweep.
    """

    sweeps: tuple[DetectorSweep, ...]
    approaches: tuple[str, ...]
    hazard_free: tuple[str, ...]
    skipped: Mapping[str, str]
    missing: tuple[str, ...]
    settings: DegradationSettings

    @property
    def beta_shift(self) -> float:
        """Mean over families and levels of the last detector's beta minus that of the first."""
        first, last = (sweep.beta.overall.value for sweep in (self.sweeps[0], self.sweeps[-1]))
        return float(np.nanmean(last - first))

    @property
    def largest_awareness_difference(self) -> float:
        """Largest difference over all conditions between the first and the last detector."""
        rows = zip(self.sweeps[0].awareness.rows, self.sweeps[-1].awareness.rows, strict=True)
        return max(abs(a.awareness.value - b.awareness.value) for a, b in rows)


def _made(name: str, key: object, make: Callable[[], Tables]) -> Tables:
    """Compute the result without a cache."""
    return make()


def degradation_study(
    recordings: Sequence[Recording],
    settings: DegradationSettings | None = None,
    *,
    over: Over = map,
    keep: Keep = _made,
    fingerprint: Callable[[Path], str] = str,
) -> DegradationStudy:
    """Stage blur, darkness, noise and rain at four levels each, and measure vision and hazard awareness.

    Neither camera nor filter receives the staged degradation: d is estimated from the images, and beta comes
    from a table measured on recordings of other folds with the same detector. Thresholds are gamma(alpha) on
    the hazard-free recordings of other folds.

    Parameters
    ----------
    recordings : sequence of Recording
        Candidates; recordings with video, detections and a standing ego are chosen evenly over the junctions.
    settings : DegradationSettings, optional
        Options of the sweep.
    over : callable
        Applies a function to every recording, in order. A text result describes why a recording failed; the
        recording is then skipped.
    keep : callable
        Caches the result of a pass, such as `PassCache.tables`.
    fingerprint : callable
        Returns a fingerprint of the content of a recording's folder, for `keep`.

    Returns
    -------
    DegradationStudy
        Curves of beta, one row per condition, and the loss in rain compared with its two effects alone.

    Raises
    ------
    InvalidArgumentError
        If there are fewer than two approaches or hazard-free recordings with video.
    OutOfDomainError
        If the model was made for another array or rate.

    References
    ----------
    "Evidence of Absence", section IX and ablation (c).

    Examples
    --------
    >>> try:
    ...     degradation_study([])
    ... except InvalidArgumentError as error:
    ...     print(str(error).partition(";")[0])
    recordings: a sweep needs 2 approaches and 2 hazard-free recordings with video
    """
    chosen = settings or DegradationSettings()
    used, missing = sweep_data(recordings, chosen.approaches, chosen.hazard_free)
    passes = _Passes(chosen, {one.recording_id: fingerprint(one.path) for one in used}, keep)
    rng, skipped = np.random.default_rng(chosen.seed), dict[str, str]()
    seen = _done(over, passes.look, [SweepItem(one) for one in used], skipped)
    counts = [{name: counts_of(one.tables[f"{name} misses"]) for name in passes.names} for one in seen]
    sites = [str(one.recording.environment) for one in seen]
    folds = deal_folds([str(one.recording.label) for one in seen], sites, rng)
    rates = {fold: passes.rates(folds != fold, seen, counts) for fold in set(folds.tolist())}
    items = [replace(one, rates=rates[fold]) for one, fold in zip(seen, folds.tolist(), strict=True)]
    believed = _done(over, passes.filter, items, skipped)
    # Strata by kind only: each junction and side has one or two recordings, whose draws would hardly vary.
    draws = stratified_draws([one.hazard_free for one in believed], rng)
    policy = read_model(chosen.model).policies.policies[0]
    left = {str(one) for one in believed}
    counts = [one for one, its in zip(counts, seen, strict=True) if str(its) in left]
    # The same folds for every detector, so that differences between detectors do not come from the folds.
    fold_seed = int(rng.integers(2**32))

    def sweep(name: str) -> DetectorSweep:
        staged = [by_condition(one.tables[name]) for one in believed]
        anew = np.random.default_rng(fold_seed)
        awareness = hazard_awareness(staged, policy.reference_prior, policy.sustain_hops, draws, anew)
        return DetectorSweep(name, beta_curves([one[name] for one in counts], draws), awareness)

    names = {free: tuple(str(one) for one in believed if one.hazard_free == free) for free in (False, True)}
    sweeps = tuple(sweep(name) for name in passes.names)
    return DegradationStudy(sweeps, names[False], names[True], skipped, tuple(missing), chosen)


@dataclass(frozen=True, slots=True)
class SweepItem:
    """One recording with the results of the passes so far; its text form is its name."""

    recording: Recording
    tables: Tables = field(default_factory=dict)  # Result of the previous pass
    # Miss rates by detector, measured on other recordings
    rates: Mapping[str, MissRates] = field(default_factory=dict)

    def __str__(self) -> str:
        return self.recording.recording_id

    @property
    def hazard_free(self) -> bool:
        """Whether the recording contains no approach."""
        return self.recording.label == "none"


@dataclass(frozen=True, slots=True)
class _Passes:
    """The two passes over a recording, in any process: over its images, and over its sound."""

    settings: DegradationSettings
    fingerprints: Mapping[str, str]
    keep: Keep

    @property
    def names(self) -> list[str]:
        """Names of the detectors."""
        return [one.name for one in self.settings.detectors]

    def look(self, item: SweepItem) -> Tables:
        """Return the detections and the misses of every detector in every condition of the camera."""
        recording = item.recording

        def make() -> Tables:
            reference = recording.read_detections()
            if reference is None:
                raise InputFileError(recording.path, "expected camera detections")
            video, rng = open_video(recording.path / VIDEO_NAME), np.random.default_rng(self._seed(item))
            tables = look(video, self.settings.detectors, rng, self.settings.width_px)
            missed = {f"{n} misses": counts_table(absence_counts(reference, tables[n])) for n in self.names}
            return {**tables, **missed}

        return self.keep("degraded-looks", self._look_key(item), make)

    def filter(self, item: SweepItem) -> Tables:
        """Return the beliefs of the filter in every condition, one table per detector."""
        recording, model = item.recording, read_model(self.settings.model)
        rates = {name: one.to_dict() for name, one in item.rates.items()}
        key = [staged_filter.VERSION, self._look_key(item), rates, encode(model), list(map(repr, RAIN_DB))]

        def make() -> Tables:
            source = open_source(recording.path, model=model)
            tables = item.tables
            seen = [
                Camera(one, item.rates[one.name], tables[one.name], tables[READINGS])
                for one in self.settings.detectors
            ]
            about: dict[str, Any] = {
                "name": recording.recording_id,
                "label": recording.label,
                "t0_s": np.nan if source.t0_s is None else source.t0_s,
                "about": {"site": recording.environment},
            }
            filtered = filter_in_conditions(source, seen, self._seed(item))
            return {name: table.replace(**about) for name, table in filtered.items()}

        return self.keep("degraded-beliefs", key, make)

    def rates(
        self, others: BoolArray, seen: Sequence[SweepItem], counts: Sequence[Mapping[str, Counts]]
    ) -> dict[str, MissRates]:
        """Return the miss rates of every detector, measured on `others`."""
        chosen = np.flatnonzero(others).tolist()
        readings = [seen[i].tables[READINGS] for i in chosen]
        return {
            name: pooled_rates([counts[i][name] for i in chosen], readings, {"detector": name})
            for name in self.names
        }

    def _look_key(self, item: SweepItem) -> list[object]:
        chosen = self.settings
        return [conditions.VERSION, self.fingerprints[str(item)], self.names, chosen.width_px, chosen.seed]

    def _seed(self, item: SweepItem) -> tuple[int, int]:
        """Return a seed by which a recording's noise is independent of the other recordings."""
        return self.settings.seed, zlib.crc32(str(item).encode())


def _done(
    over: Over, work: Callable[[SweepItem], Tables], items: Sequence[SweepItem], skipped: dict[str, str]
) -> list[SweepItem]:
    """Run a pass; return the items with its results, and record those that failed."""
    done = []
    for item, tables in zip(items, over(work, items), strict=True):
        if isinstance(tables, str):
            skipped[str(item)] = tables
        else:
            done.append(replace(item, tables=tables))
    return done
