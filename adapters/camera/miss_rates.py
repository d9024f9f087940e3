"""Measured miss rates of a camera's detector, on disk: tables, counts, clutter, and where they come from."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from worldstate.abduction.absence import MissRateTable
from worldstate.abduction.cueing.isotonic_grid import isotonic_grid
from worldstate.adapters.files.atomic import write_text
from worldstate.ground.checks import finite_array
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.ground.reading import decode_json
from worldstate.ground.schema import check_schema, read_numbers, read_rows, schema_stamp
from worldstate.ground.serialisation import encode
from worldstate.ground.typing import FloatArray

from .camera_health import CameraHealth, Health
from .degradation import LEVELS

SCHEMA = "worldstate.MissRates"
VERSION = "1.0.0"
MAX_BYTES = 16 << 20
MOST_FAMILIES = 100
# Jeffreys' prior of a rate.
PRIOR = 0.5

Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, slots=True)
class FamilyCounts:
    """What one family of degradations came to.

    Examples
    --------
    >>> counts = FamilyCounts(((10,) * 5,), ((0, 1, 2, 5, 10),), (99,) * 5, (0,) * 5)
    >>> counts.miss_rates().round(2).tolist(), round(counts.clutter_rates[0].item(), 3)
    ([[0.05, 0.14, 0.23, 0.5, 0.95]], 0.005)
    """

    # Reference objects that were there, and those that were not found again; one row an azimuth bin, one
    # column a level of degradation.
    looks: Rows
    misses: Rows
    # Query sectors without a reference object, and those of them with a false detection, at each level.
    sectors: tuple[float, ...]
    clutter: tuple[float, ...]

    def __post_init__(self) -> None:
        looks = finite_array("looks", self.looks, (None, len(LEVELS)))
        misses = finite_array("misses", self.misses, looks.shape)
        sectors = finite_array("sectors", self.sectors, (len(LEVELS),))
        clutter = finite_array("clutter", self.clutter, (len(LEVELS),))
        if (misses < 0).any() or (misses > looks).any() or (clutter < 0).any() or (clutter > sectors).any():
            raise InvalidArgumentError("counts: expected 0 <= misses <= looks and 0 <= clutter <= sectors")

    def miss_rates(self, repeats: float = 1.0) -> FloatArray:
        """Return beta, shape (bins, levels): posterior means, never falling with azimuth or degradation."""
        # A cell that nobody looked at is at one half, as far as its neighbours let it: not known is neither
        # found nor missed.
        looks, misses = np.array(self.looks) / repeats, np.array(self.misses) / repeats
        weight = looks + 2.0 * PRIOR
        return isotonic_grid((misses + PRIOR) / weight, weight)

    def interval(self, repeats: float = 1.0) -> tuple[FloatArray, FloatArray]:
        """Return the 95 % limits of each cell's own Beta posterior, two of shape (bins, levels)."""
        from scipy.stats import beta

        looks, misses = np.array(self.looks) / repeats, np.array(self.misses) / repeats
        a, b = misses + PRIOR, looks - misses + PRIOR
        return beta.ppf(0.025, a, b), beta.ppf(0.975, a, b)

    @property
    def clutter_rates(self) -> FloatArray:
        """P(a false detection in a query sector) at each level, shape (levels,), in (0, 1)."""
        return (np.array(self.clutter) + PRIOR) / (np.array(self.sectors) + 2.0 * PRIOR)


@dataclass(frozen=True)
class MissRates:
    """Miss and clutter rates of one detector behind one camera.

    Parameters
    ----------
    azimuth_deg : tuple of float
        Edges of the azimuth bins off the optical axis, from 0 to the edge of the view.
    families : mapping of str to FamilyCounts
        Counts of each family of degradations.
    provenance : mapping of str to str
        Detector, data, version.
    health : CameraHealth, optional
        The scale on which this camera's d is read from its images.
    repeats : float
        Frames that say the same, see `FamilyCounts.miss_rates`.

    Raises
    ------
    InvalidArgumentError
        If bins and counts do not fit.
    """

    azimuth_deg: tuple[float, ...]
    families: Mapping[str, FamilyCounts]
    provenance: Mapping[str, str] = field(default_factory=dict)
    health: CameraHealth | None = None
    repeats: float = 1.0

    def __post_init__(self) -> None:
        edges = finite_array("azimuth_deg", self.azimuth_deg, (None,))
        if edges.size < 2 or edges[0] != 0.0 or edges[-1] > 180.0 or (np.diff(edges) <= 0).any():
            raise InvalidArgumentError("azimuth_deg: expected edges that increase from 0 to at most 180")
        if not self.families or any(len(c.looks) != edges.size - 1 for c in self.families.values()):
            raise InvalidArgumentError(f"families: expected at least one, each with {edges.size - 1} bins")
        if not 1.0 <= self.repeats <= 1000.0:
            raise InvalidArgumentError(f"repeats: expected a number in [1, 1000], got {self.repeats}")

    @cached_property
    def tables(self) -> dict[str, MissRateTable]:
        """beta(theta, d) of every family, constant from the middle of the last bin to the edge."""
        return {name: self._table(counts.miss_rates(self.repeats)) for name, counts in self.families.items()}

    @cached_property
    def table(self) -> MissRateTable:
        """The largest beta of all families at every d: absence claims no more than the worst allows."""
        return self._table(
            np.max([counts.miss_rates(self.repeats) for counts in self.families.values()], axis=0)
        )

    def level(self, health: Health) -> float:
        """Return the d at which `table` has, at boresight, the miss rate of the worst family.

        A blur that a detector hardly minds is then no strong degradation, however strong the blur. A family
        that was not measured counts like the worst of those that were.
        """
        rates = [self.tables.get(name, self.table)(0.0, d) for name, d in health.by_family.items()]
        at_boresight = np.array([self.table(0.0, d) for d in LEVELS])
        # Of several levels with the same rate the lowest: interpolation wants them increasing.
        rising = np.concatenate([[True], np.diff(at_boresight) > 0.0])
        return float(np.interp(max(rates), at_boresight[rising], np.array(LEVELS)[rising]))

    def clutter_rate(self, degradation: float) -> float:
        """Return P(false detection in a query sector) at d, the largest over the families."""
        return max(
            float(np.interp(degradation, LEVELS, counts.clutter_rates)) for counts in self.families.values()
        )

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-able values with the schema's name and version."""
        return {
            **schema_stamp(SCHEMA, VERSION),
            "provenance": dict(self.provenance),
            "azimuth_deg": list(self.azimuth_deg),
            "repeats": self.repeats,
            "health": None if self.health is None else self.health.to_dict(),
            "families": {name: _counts_to_dict(counts) for name, counts in self.families.items()},
            "table": encode(self.table),
        }

    @classmethod
    def from_dict(cls, data: object, source: object = "miss rates") -> "MissRates":
        """Return what `to_dict` wrote; the tables are formed anew from the counts.

        Raises
        ------
        InputFileError
            If something is missing, of the wrong type or out of range; it begins with `source`.
        SchemaVersionError
            If the major version is another one.
        """
        fields = check_schema(data, SCHEMA, VERSION, source)
        try:
            families = _mapping(fields.get("families"), "families")
            health = fields.get("health")
            return cls(
                azimuth_deg=read_numbers(fields.get("azimuth_deg"), "azimuth_deg"),
                families={str(name): _counts(value) for name, value in families.items()},
                provenance=_texts(fields.get("provenance", {})),
                health=None if health is None else CameraHealth.from_dict(health),
                repeats=read_numbers([fields.get("repeats", 1.0)], "repeats")[0],
            )
        except InvalidArgumentError as error:
            raise InputFileError(source, str(error)) from error

    def _table(self, beta: FloatArray) -> MissRateTable:
        edges = np.array(self.azimuth_deg)
        middles = (edges[1:] + edges[:-1]) / 2.0
        knots = [0.0, *middles.tolist(), float(edges[-1])]
        rows = [beta[0], *beta, beta[-1]]
        return MissRateTable(tuple(knots), LEVELS, tuple(tuple(row.tolist()) for row in rows))


def save_miss_rates(path: str | Path, rates: MissRates) -> None:
    """Write miss rates to exactly this path, whole or not at all.

    Parameters
    ----------
    path : str or Path
        Exactly this file.
    rates : MissRates
        As they were measured.

    Raises
    ------
    InputFileError
        If the folder is missing.
    """
    write_text(path, json.dumps(rates.to_dict(), allow_nan=False, indent=1) + "\n")


def load_miss_rates(path: str | Path) -> MissRates:
    """Read what `save_miss_rates` wrote.

    Parameters
    ----------
    path : str or Path
        JSON file.

    Returns
    -------
    MissRates
        As they were measured.

    Raises
    ------
    InputFileError
        If the file is missing, larger than 16 MiB, no JSON, or a number is missing or out of range.
    SchemaVersionError
        If it is of another major version.
    """
    name = Path(path)
    try:
        with name.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise InputFileError(name, f"expected miss rates of at most {MAX_BYTES >> 20} MiB")
        return MissRates.from_dict(decode_json(data.decode("utf-8"), "miss rates"), name)
    except OSError as error:
        raise InputFileError(name, f"expected a file of miss rates ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputFileError(name, "expected a file in UTF-8") from error
    except InputFileError:
        raise
    except InvalidArgumentError as error:
        raise InputFileError(name, str(error)) from error


def _counts_to_dict(counts: FamilyCounts) -> dict[str, Any]:
    return {
        "looks": [list(row) for row in counts.looks],
        "misses": [list(row) for row in counts.misses],
        "sectors": list(counts.sectors),
        "clutter": list(counts.clutter),
    }


def _counts(value: object) -> FamilyCounts:
    fields = _mapping(value, "family")
    return FamilyCounts(
        looks=read_rows(fields.get("looks"), "looks"),
        misses=read_rows(fields.get("misses"), "misses"),
        sectors=read_numbers(fields.get("sectors"), "sectors"),
        clutter=read_numbers(fields.get("clutter"), "clutter"),
    )


def _mapping(value: object, name: str) -> Mapping[str, object]:
    if not isinstance(value, Mapping) or len(value) > MOST_FAMILIES:
        raise InvalidArgumentError(f"{name}: expected an object of at most {MOST_FAMILIES} entries")
    return value


def _texts(value: object) -> dict[str, str]:
    entries = _mapping(value, "provenance")
    if not all(isinstance(text, str) for text in entries.values()):
        raise InvalidArgumentError("provenance: expected text")
    return {str(name): str(text) for name, text in entries.items()}
