"""The tables of a corpus: typed rows, a Parquet file for each recording and table, written whole.

Files hold neither the time of writing nor the name of a machine, and the same rows are the same bytes with
one release of pyarrow.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from worldstate.adapters.files.file_io import atomic_path
from worldstate.adapters.state_log import BATCH_ROWS, PARQUET
from worldstate.ground import InputFileError
from worldstate.ground.extras import optional

Row = TypeVar("Row")
SINCE_1970_S = 1e9  # A stamp above it is no time since a first sample


@dataclass(frozen=True, slots=True)
class HeardRecording:
    """A recording that was heard, or why it could not be: table ``recordings``."""

    recording: str  # Name in the corpus
    site: str
    content: str  # Digest of its bytes, name and site
    # End of the first window, and of the last: from the first sample on, or of a bag from 1970 on.
    start_s: float | None = None
    end_s: float | None = None
    hops: int = 0
    heard: int = 0  # Hops in which a hidden vehicle would have been noticed
    looked: int = 0  # Hops in which a camera had looked
    usable: int = 0  # Hops in which every cue may be acted on
    onsets: int = 0  # Times an advisory of any side began while none stood
    budget: float | None = None  # Onsets an hour that the alarm was set to; None if none is stated
    failure: str | None = None  # Why it could not be heard


@dataclass(frozen=True, slots=True)
class StateHours:
    """Hops in one state of the sensors: table ``hours``."""

    recording: str
    site: str
    day: str | None  # Of the first hop, UTC; None if times count from the first sample
    sensors: str  # Condition of every sensor
    unheard: str | None  # Why nothing could be heard; None if it could
    hops: int
    onsets: int


@dataclass(frozen=True, slots=True)
class HeardApproach:
    """An advisory, or a vehicle that came into view without one: table ``approaches``."""

    recording: str
    site: str
    side: str | None
    time_s: float | None = None  # When the advisory began; None without one
    end_s: float | None = None  # Its last hop
    chance: float | None = None  # That a vehicle comes into view within 8 s, as stated when it began
    expected_s: float | None = None  # Time to visible, as stated then
    seen: bool | None = None  # Whether a vehicle came into view; None if no camera looked
    seen_s: float | None = None  # When
    gone_s: float | None = None  # Last hop in which it was in view
    lead_s: float | None = None  # From the advisory to its coming into view
    label: str | None = None  # Likeliest class of the vehicle
    usable: bool = False  # Whether the advisory could be acted on when it began
    kept: bool | None = None  # Whether a cascade would have heard its beginning; None if that was not asked


@dataclass(frozen=True, slots=True)
class HeardHop:
    """A hop of sound: table ``hops``, on request."""

    recording: str
    site: str
    risk: float | None
    snapshot: str  # JSON
    signature: int | None  # Checksum of the window model whose scores follow; None without a model
    level_left: float | None  # Log-odds: the alarm is raised by thresholds up to it; None by no threshold
    level_right: float | None
    # As of hop streams
    time_s: float
    log_likelihoods: tuple[float, ...]
    answer: int
    miss_rate: float
    clutter_rate: float
    approach: float
    seen: bool


TABLES: Mapping[str, type] = {
    # The last is written last: a recording counts as heard once it is there.
    "hops": HeardHop,
    "approaches": HeardApproach,
    "hours": StateHours,
    "recordings": HeardRecording,
}
_ARROW = {str: "string", float: "double", int: "int64", bool: "bool"}


def write_rows(path: Path, kind: type, rows: Iterable[Any]) -> None:
    """Write one file of a table, whole or not at all."""
    arrow, parquet = optional("pyarrow"), optional("pyarrow.parquet")
    left, schema = map(asdict, rows), _schema(kind)
    with atomic_path(path) as temporary, parquet.ParquetWriter(temporary, schema, compression="zstd") as file:
        while batch := list(itertools.islice(left, BATCH_ROWS)):
            file.write_table(arrow.Table.from_pylist(batch, schema=schema))


def corpus_rows(out: Path, kind: type[Row]) -> Iterator[Row]:
    """Yield the rows of a table of a corpus, of recordings that were heard to their end.

    Raises
    ------
    InputFileError
        If it is no corpus, or a file is damaged or holds other columns.
    """
    arrow, parquet = optional("pyarrow"), optional("pyarrow.parquet")
    table = next(name for name, one in TABLES.items() if one is kind)
    paths = sorted((out / "recordings").glob(f"[!.]*{PARQUET}"))
    if not paths:
        raise InputFileError(out, "expected the folder that `worldstate hear --out` wrote")
    # What could not be heard has no other table.
    for path in filter(Path.exists, (out / table / path.name for path in paths)):
        try:
            with parquet.ParquetFile(path) as file:
                if not file.schema_arrow.equals(_schema(kind)):
                    raise InputFileError(path, f"expected the columns {', '.join(_schema(kind).names)}")
                for batch in file.iter_batches(BATCH_ROWS):
                    yield from (kind(**row) for row in batch.to_pylist())
        except (OSError, arrow.ArrowException) as error:
            raise InputFileError(path, f"expected a Parquet file of a corpus ({error})") from error


def _schema(kind: type) -> Any:
    hints = get_type_hints(kind)
    return optional("pyarrow").schema([_field(one.name, hints[one.name]) for one in fields(kind)])


def _field(name: str, hint: Any) -> Any:
    arrow = optional("pyarrow")
    # Of "float | None" the first is the type of the values.
    first = get_args(hint)[0] if isinstance(hint, UnionType) else hint
    of_list = get_origin(first) is tuple
    plain = arrow.type_for_alias(_ARROW[get_args(first)[0] if of_list else first])
    return arrow.field(name, arrow.list_(plain) if of_list else plain, nullable=isinstance(hint, UnionType))
