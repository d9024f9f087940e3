"""A recording as a table, with one row per hop and named columns."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

from worldstate.abduction.co_evidence import Absent, Present
from worldstate.adapters.files.file_io import load_npz, save_npz
from worldstate.ground import InputFileError, InvalidArgumentError, NotUsable, seconds
from worldstate.ground.checks import check_shape, finite_array
from worldstate.ground.serialisation import encode
from worldstate.ground.typing import AnyArray, BoolArray
from worldstate.measurement.measurement import Measurement
from worldstate.operations.metrics.approach_table import SLACK_S

# One hour of hops with a feature of 60 values takes 20 MB.
MAX_BYTES = 512 << 20
MAX_RECORDINGS = 100_000
MAX_HEAD_BYTES = 64 << 20
# Files of other versions were written by other code: they are refused, and rebuilt if possible.
VERSION = 3

HOP_S = 0.1
UNQUERIED, ABSENT, PRESENT = 0, 1, 2
# Columns of a hop stream: the evidence of a recording at every hop, stored to try decisions on it again.
STREAM_COLUMNS = (
    "time_s",  # End of each window, seconds from the start
    "log_likelihoods",  # shape (n, K + 2): for hidden_1 .. hidden_K, visible, none; nats
    "answer",  # 0 unqueried, 1 absent, 2 present
    "miss_rate",  # Rates of the searched channel; without one, miss rate 1 and clutter rate 0
    "clutter_rate",
    "approach",  # 1/TTA over its standard deviation; NaN if unusable
    "seen",  # Whether a moving object was detected anywhere
    # Whether a moving object was in view according to the reference, if there is one; a degraded camera may
    # miss it
    "there",
)


@dataclass(frozen=True, slots=True, eq=False)
class HopTable:
    """Columns of equal length and data of the whole recording; columns are also attributes.

    Parameters
    ----------
    columns : mapping of str to ndarray, shape (n, ...)
        One row per hop.
    name : str
        Name of the recording.
    label : str
        Side from which a vehicle comes, or "none" for a hazard-free recording.
    t0_s : float
        Line-of-sight entry, seconds; NaN if there is none or it is unknown.
    about : mapping
        Further data, suitable for JSON.

    Raises
    ------
    InvalidArgumentError
        If the columns differ in length.

    Examples
    --------
    >>> table = HopTable({"time_s": np.array([1.0, 1.1, 1.2])}, name="a", label="left", t0_s=1.1)
    >>> len(table), table.time_s[0], table.before_sight().tolist(), table.replace(risk=np.zeros(3)).risk
    (3, np.float64(1.0), [True, True, False], array([0., 0., 0.]))
    """

    columns: Mapping[str, AnyArray]
    name: str = ""
    label: str = "none"
    t0_s: float = float("nan")
    about: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, column in self.columns.items():
            check_shape(name, np.shape(column)[:1], (len(self),))

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def __getattr__(self, name: str) -> AnyArray:
        # The first test prevents endless recursion in a partly constructed copy, such as during unpickling.
        if name == "columns" or name not in self.columns:
            raise AttributeError(f"no column {name}")
        return self.columns[name]

    @classmethod
    def of_rows(cls, names: Sequence[str], rows: Iterable[Sequence[Any]]) -> "HopTable":
        """Return the table of rows with one value per column.

        Examples
        --------
        >>> HopTable.of_rows(("time_s", "risk"), [(1.0, 0.2), (1.1, 0.4)]).risk
        array([0.2, 0.4])
        """
        values = list(zip(*rows, strict=True)) or [()] * len(names)
        return cls({name: np.array(column) for name, column in zip(names, values, strict=True)})

    def replace(self, **changes: Any) -> "HopTable":
        """Return the table with other columns, or another name, label, T0 or `about`."""
        own = {name: changes.pop(name) for name in _OWN if name in changes}
        return replace(self, columns={**self.columns, **changes}, **own)

    @property
    def hazard_free(self) -> bool:
        """Whether no vehicle approaches in this recording."""
        return self.label == "none"

    def before_sight(self, horizon_s: float = float("inf")) -> BoolArray:
        """Return which hops of an approach end at T0 or at most `horizon_s` before it, shape (n,)."""
        left_s = self.t0_s - self.time_s
        return np.asarray((left_s >= -SLACK_S) & (left_s <= horizon_s + SLACK_S) & (not self.hazard_free))

    def after_sight(self) -> BoolArray:
        """Return which hops of an approach are after T0 with the vehicle in view (`there`), shape (n,)."""
        return np.asarray(self.there & ~self.before_sight() & (not self.hazard_free))


_OWN = tuple(one.name for one in fields(HopTable) if one.name != "columns")


def joined(tables: Iterable[HopTable]) -> HopTable:
    """Return the rows of several recordings as one table without a name, with the columns of the first.

    Examples
    --------
    >>> one = HopTable({"risk": np.array([0.5])}, name="a")
    >>> joined([one, one]).risk
    array([0.5, 0.5])
    """
    kept = list(tables)
    return HopTable({name: np.concatenate([one.columns[name] for one in kept]) for name in kept[0].columns})


def save_tables(path: str | Path, tables: Iterable[HopTable]) -> None:
    """Write recordings with the same columns as npz without objects, atomically."""
    _save(path, {"": list(tables)})


def save_named(path: str | Path, tables: Mapping[str, HopTable]) -> None:
    """Write tables with different columns as npz without objects, atomically."""
    _save(path, {name: [table] for name, table in tables.items()})


def load_named(path: str | Path, what: str) -> dict[str, HopTable]:
    """Read a file written by `save_named`.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> boxes = HopTable({"label": np.array(["car", "bus"])})
    >>> with TemporaryDirectory() as folder:
    ...     save_named(f"{folder}/a.npz", {"boxes": boxes, "hops": HopTable({"time_s": np.zeros(5)})})
    ...     [(name, len(table)) for name, table in load_named(f"{folder}/a.npz", "tables").items()]
    [('boxes', 2), ('hops', 5)]
    """
    return {name: only for name, (only,) in load_npz(path, what, MAX_BYTES, _tables).items()}


def _save(path: str | Path, kinds: Mapping[str, Sequence[HopTable]]) -> None:
    """Write tables by kind; tables of one kind have the same columns, which are concatenated."""
    # With one array per recording and column, the list of members would exceed the reader's limit.
    about = [
        {name: getattr(one, name) for name in _OWN} | {"kind": kind, "hops": len(one)}
        for kind, tables in kinds.items()
        for one in tables
    ]
    head = {"version": VERSION, "recordings": about}
    columns = {
        # Columns of the kind without a name keep their names.
        f"{kind}/{name}" if kind else name: column
        for kind, tables in kinds.items()
        for name, column in joined(tables).columns.items()
    }
    save_npz(path, {"": np.array(json.dumps(head)), **columns})


def _tables(arrays: dict[str, AnyArray]) -> dict[str, list[HopTable]]:
    about = arrays.pop("")
    if about.nbytes > MAX_HEAD_BYTES:
        raise InvalidArgumentError(f"expected a head of at most {MAX_HEAD_BYTES >> 20} MiB")
    head = json.loads(str(about))
    if head["version"] != VERSION:
        raise InvalidArgumentError(f"version: expected {VERSION}, got {head['version']}")
    if len(head["recordings"]) > MAX_RECORDINGS:
        raise InvalidArgumentError(f"expected at most {MAX_RECORDINGS} tables, got {len(head['recordings'])}")
    kinds: dict[str, list[dict[str, Any]]] = {}
    for one in head["recordings"]:
        # Older files without kinds contain the kind without a name.
        kinds.setdefault(one.pop("kind", ""), []).append(one)
    columns: dict[str, dict[str, AnyArray]] = {kind: {} for kind in kinds}
    for member, column in arrays.items():
        kind, _, name = member.rpartition("/")
        columns[kind][name] = column
    return {kind: _split(tables, columns[kind]) for kind, tables in kinds.items()}


def _split(about: Sequence[dict[str, Any]], columns: Mapping[str, AnyArray]) -> list[HopTable]:
    """Split the concatenated columns of one kind into its tables."""
    hops = [int(one.pop("hops")) for one in about]
    if min(hops) < 0 or any(len(column) != sum(hops) for column in columns.values()):
        raise InvalidArgumentError("hops: expected counts that sum to the number of rows")
    parts = {name: np.split(column, np.cumsum(hops)[:-1]) for name, column in columns.items()}
    return [HopTable({name: part[i] for name, part in parts.items()}, **one) for i, one in enumerate(about)]


def hop_stream(
    measurements: Iterable[Measurement],
    *,
    name: str,
    label: str = "none",
    t0_s: float | None = None,
    there: Sequence[bool] | None = None,
) -> HopTable:
    """Return the measurements of an adapter as a hop stream."""
    measured = list(measurements)
    if not measured:
        raise InvalidArgumentError(f"{name}: expected at least one hop, so at least one second of sound")
    seen = [any(sighting.moving for sighting in one.sightings) for one in measured]
    flags = zip(seen, seen if there is None else there, strict=True)
    rows = [(*_measured(one), *both) for one, both in zip(measured, flags, strict=True)]
    entry_s = float("nan") if t0_s is None else t0_s
    return HopTable.of_rows(STREAM_COLUMNS, rows).replace(name=name, label=label, t0_s=entry_s)


def load_streams(path: str | Path) -> list[HopTable]:
    """Read and validate the hop streams of a file, which may come from a user."""
    streams = load_npz(path, "hop streams", MAX_BYTES, _checked_streams)
    if not streams:
        raise InputFileError(path, "expected at least one hop stream")
    return streams


def _checked_streams(arrays: dict[str, AnyArray]) -> list[HopTable]:
    streams = _tables(arrays).get("", [])
    for stream in streams:
        if not set(STREAM_COLUMNS) <= set(stream.columns):
            raise InvalidArgumentError(f"expected the columns {', '.join(STREAM_COLUMNS)}")
        for name in ("time_s", "miss_rate", "clutter_rate"):
            finite_array(name, stream.columns[name], (None,))
        finite_array("log_likelihoods", stream.log_likelihoods, (None, None))
        if not np.isin(stream.answer, (UNQUERIED, ABSENT, PRESENT)).all():
            raise InvalidArgumentError("answer: expected 0 unqueried, 1 absent or 2 present")
    return streams


def _measured(one: Measurement) -> tuple[Any, ...]:
    """Return the columns of a hop except the last two."""
    look, approach, answer = one.co_evidence, one.approach, (UNQUERIED, 1.0, 0.0)
    if isinstance(look, Absent | Present):
        answer = PRESENT if isinstance(look, Present) else ABSENT, look.miss_rate, look.clutter_rate
    rate = np.nan if isinstance(approach, NotUsable) else approach.inverse_tta_hz / approach.std_hz
    return seconds(one.stamp_ns), one.signature.log_likelihoods, *answer, rate


def signature_checksum(signature: object) -> int:
    """Return a checksum of a window model that identifies its scores."""
    return crc32(json.dumps(encode(signature)).encode())
