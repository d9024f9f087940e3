"""Measured miss and clutter rates of a camera's detector, with their counts, in a file."""

from collections.abc import Mapping
from dataclasses import asdict, astuple, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from worldstate.abduction.co_evidence import MissRateTable, isotonic_grid
from worldstate.adapters.files.file_io import read_record, write_json
from worldstate.ground import FloatArray, InvalidArgumentError, finite_array
from worldstate.ground.serialisation import ADDED, Layout, encode

from .camera_health import LEVELS, CameraHealth, Health

# Far more than there are kinds of degradation; a limit for files of unknown origin.
MOST_FAMILIES = 100
# Jeffreys' prior of a rate. It keeps every cell between 0 and 1, so that no look is infallible.
PRIOR = 0.5

Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, slots=True)
class FamilyCounts:
    """Counts for one family of degradations."""

    # Number of reference objects, and number of those not detected; rows are azimuth bins, columns
    # degradation levels.
    looks: Rows
    misses: Rows
    # Number of query sectors without a reference object, and of those with a false detection, per level.
    sectors: tuple[float, ...]
    clutter: tuple[float, ...]

    def __post_init__(self) -> None:
        looks = finite_array("looks", self.looks, (None, len(LEVELS)))
        misses = finite_array("misses", self.misses, looks.shape)
        sectors = finite_array("sectors", self.sectors, (len(LEVELS),))
        clutter = finite_array("clutter", self.clutter, (len(LEVELS),))
        if (misses < 0).any() or (misses > looks).any() or (clutter < 0).any() or (clutter > sectors).any():
            raise InvalidArgumentError("counts: expected 0 <= misses <= looks and 0 <= clutter <= sectors")

    def __add__(self, other: "FamilyCounts") -> "FamilyCounts":
        """Return the counts of two sets of images together."""
        mine, theirs = astuple(self), astuple(other)
        return FamilyCounts(*(as_tuples(np.add(a, b)) for a, b in zip(mine, theirs, strict=True)))

    def miss_rates(self, repeats: float = 1.0) -> FloatArray:
        """Return beta, shape (bins, levels): posterior means, non-decreasing in azimuth and degradation."""
        # A cell without data has the prior mean of 0.5, as far as monotonicity allows.
        looks, misses = np.array(self.looks) / repeats, np.array(self.misses) / repeats
        weight = looks + 2.0 * PRIOR
        return isotonic_grid((misses + PRIOR) / weight, weight)

    def interval(self, repeats: float = 1.0) -> tuple[FloatArray, FloatArray]:
        """Return the 95 % limits of the Beta posterior of each cell, two arrays of shape (bins, levels)."""
        from scipy.special import betaincinv

        looks, misses = np.array(self.looks) / repeats, np.array(self.misses) / repeats
        a, b = misses + PRIOR, looks - misses + PRIOR
        return betaincinv(a, b, 0.025), betaincinv(a, b, 0.975)

    @property
    def clutter_rates(self) -> FloatArray:
        """P(a false detection in a query sector) at each level, shape (levels,), in (0, 1)."""
        return (np.array(self.clutter) + PRIOR) / (np.array(self.sectors) + 2.0 * PRIOR)


def as_tuples(values: FloatArray) -> Any:
    """Return counts as nested tuples."""
    rows = values.tolist()
    return tuple(tuple(row) for row in rows) if values.ndim == 2 else tuple(rows)


@dataclass(frozen=True)
class MissRates:
    r"""Miss and clutter rates of one detector with one camera.

    .. math:: \hat\beta = \frac{m / r + 1/2}{n / r + 1}

    with m misses in n looks and r repeats per cell, made monotone in azimuth and degradation.

    Parameters
    ----------
    azimuth_deg : tuple of float
        Edges of the azimuth bins off the optical axis, degrees, from 0 to the edge of the view.
    families : mapping of str to FamilyCounts
        Looks and misses per family of degradations.
    provenance : mapping of str to str
        Detector, data and version.
    health : CameraHealth, optional
        Scale for the degradation d of this camera's images.
    repeats : float
        Number r of successive images that carry the same information.

    Raises
    ------
    InvalidArgumentError
        If bins and counts do not match.

    Examples
    --------
    >>> counts = FamilyCounts(((10,) * 5,), ((0, 1, 2, 5, 10),), (99,) * 5, (0,) * 5)
    >>> rates = MissRates((0.0, 30.0), {"noise": counts}, {"detector": "mine"})
    >>> round(float(rates.table(azimuth_rad=0.1, degradation=1.0)), 2)
    0.95
    """

    LAYOUT: ClassVar = Layout("worldstate.MissRates", "1.0.0", order="provenance azimuth_deg repeats health")

    azimuth_deg: tuple[float, ...]
    families: Mapping[str, FamilyCounts]
    provenance: Mapping[str, str] = field(default_factory=dict, metadata=ADDED)
    health: CameraHealth | None = None
    repeats: float = field(default=1.0, metadata=ADDED)

    def __post_init__(self) -> None:
        edges = finite_array("azimuth_deg", self.azimuth_deg, (None,))
        if edges.size < 2 or edges[0] != 0.0 or edges[-1] > 180.0 or (np.diff(edges) <= 0).any():
            raise InvalidArgumentError("azimuth_deg: expected edges that increase from 0 to at most 180")
        if not 0 < len(self.families) <= MOST_FAMILIES:
            raise InvalidArgumentError(f"families: expected 1 to {MOST_FAMILIES}, got {len(self.families)}")
        if any(len(counts.looks) != edges.size - 1 for counts in self.families.values()):
            raise InvalidArgumentError(f"families: expected {edges.size - 1} bins in each")
        if not 1.0 <= self.repeats <= 1000.0:
            raise InvalidArgumentError(f"repeats: expected a number in [1, 1000], got {self.repeats}")

    @cached_property
    def tables(self) -> dict[str, MissRateTable]:
        """beta(theta, d) per family, constant from the middle of the last bin to its edge."""
        return {name: self._table(counts.miss_rates(self.repeats)) for name, counts in self.families.items()}

    @cached_property
    def table(self) -> MissRateTable:
        """Largest beta over the families at every d, so that absence is never overrated."""
        rates = [counts.miss_rates(self.repeats) for counts in self.families.values()]
        return self._table(np.max(rates, axis=0))

    def level(self, health: Health) -> float:
        """Return the d at which `table` has, at boresight, the miss rate of the worst family.

        A blur that hardly affects the detector therefore gives a small d. For a family that was not measured,
        the worst measured one is used.

        Parameters
        ----------
        health : Health
            Degradation per family, each in [0, 1].

        Returns
        -------
        float
            d in [0, 1].
        """
        rates = [self.tables.get(name, self.table)(0.0, d) for name, d in asdict(health).items()]
        at_boresight = np.array([self.table(0.0, d) for d in LEVELS])
        # Use the lowest of several levels with the same rate: np.interp needs increasing abscissae.
        rising = np.concatenate([[True], np.diff(at_boresight) > 0.0])
        return float(np.interp(max(rates), at_boresight[rising], np.array(LEVELS)[rising]))

    def clutter_rate(self, degradation: float) -> float:
        """Return P(false detection in a query sector) at d, the largest over the families."""
        return max(float(np.interp(degradation, LEVELS, one.clutter_rates)) for one in self.families.values())

    def to_dict(self) -> dict[str, Any]:
        """Return values for JSON with the schema's name and version."""
        return {**encode(self), "table": encode(self.table)}

    def _table(self, beta: FloatArray) -> MissRateTable:
        edges = np.array(self.azimuth_deg)
        knots = [0.0, *((edges[1:] + edges[:-1]) / 2.0).tolist(), float(edges[-1])]
        rows = [beta[0], *beta, beta[-1]]
        return MissRateTable(tuple(knots), LEVELS, tuple(tuple(row.tolist()) for row in rows))


def save_miss_rates(path: str | Path, rates: MissRates) -> None:
    """Write miss rates to a file, atomically.

    Raises
    ------
    InputFileError
        If the folder is missing.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> counts = FamilyCounts(((10,) * 5,), ((0, 1, 2, 5, 10),), (99,) * 5, (0,) * 5)
    >>> with TemporaryDirectory() as folder:
    ...     save_miss_rates(Path(folder) / "beta.json", MissRates((0.0, 30.0), {"noise": counts}))
    ...     load_miss_rates(Path(folder) / "beta.json").families["noise"].misses
    ((0.0, 1.0, 2.0, 5.0, 10.0),)
    """
    write_json(path, rates.to_dict(), indent=1)


def load_miss_rates(path: str | Path) -> MissRates:
    """Read a file written by `save_miss_rates`.

    Raises
    ------
    InputFileError
        If the file is missing, larger than 16 MiB or not JSON, or a number is missing or out of range.
    SchemaVersionError
        If the file has another major version.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> counts = FamilyCounts(((10,) * 5,), ((0, 1, 2, 5, 10),), (99,) * 5, (0,) * 5)
    >>> with TemporaryDirectory() as folder:
    ...     save_miss_rates(Path(folder) / "beta.json", MissRates((0.0, 30.0), {"noise": counts}))
    ...     load_miss_rates(Path(folder) / "beta.json").families["noise"].misses
    ((0.0, 1.0, 2.0, 5.0, 10.0),)
    """
    return read_record(MissRates, path, "miss rates")
