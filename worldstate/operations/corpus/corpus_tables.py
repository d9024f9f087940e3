"""Tables of a corpus: typed rows, with one Parquet file per recording and table, written atomically.

Files contain neither the time of writing nor a computer's name. With one release of pyarrow, equal rows give
equal bytes.
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
SINCE_1970_S = 1e9  # Larger stamps are times since 1970, not since the first sample


@dataclass(frozen=True, slots=True)
class HeardRecording:
    """A processed recording, or why it failed: table ``recordings``."""

    recording: str  # Name in the corpus
    site: str
    content: str  # Digest of its bytes, name and site
    # End of the first and of the last window, from the first sample; for a bag, since 1970.
    start_s: float | None = None
    end_s: float | None = None
    hops: int = 0
    heard: int = 0  # Hops in which a hidden vehicle would have been detected
    looked: int = 0  # Hops with a look of a camera
    usable: int = 0  # Hops in which every cue is usable
    onsets: int = 0  # Number of times an advisory of any side began while none was active
    budget: float | None = None  # Requested onsets per hour of the alarm; None if not stated
    failure: str | None = None  # Reason for the failure


@dataclass(frozen=True, slots=True)
class StateHours:
    """Hops in one state of the sensors: table ``hours``."""

    recording: str
    site: str
    day: str | None  # Day of the first hop, UTC; None if times start at the first sample
    sensors: str  # Condition of every sensor
    unheard: str | None  # Why nothing could be detected by sound; None if it could
    hops: int
    onsets: int


@dataclass(frozen=True, slots=True)
class HeardApproach:
    """An advisory, or a vehicle that came into view without one: table ``approaches``."""

    recording: str
    site: str
    side: str | None
    time_s: float | None = None  # Start of the advisory; None without one
    end_s: float | None = None  # Last hop of the advisory
    chance: float | None = None  # Initial probability that a vehicle comes into view within 8 s
    expected_s: float | None = None  # Initial estimate of the time to visible
    seen: bool | None = None  # Whether a vehicle came into view; None without a look of a camera
    seen_s: float | None = None  # Time at which the vehicle came into view
    gone_s: float | None = None  # Last hop in which the vehicle was in view
    lead_s: float | None = None  # Time from the advisory until the vehicle came into view
    label: str | None = None  # Most probable class of the vehicle
    usable: bool = False  # Whether the advisory was usable at its start
    kept: bool | None = None  # Whether a cascade keeps the start of the advisory; None if not determined


@dataclass(frozen=True, slots=True)
class HeardHop:
    """A hop of sound: table ``hops``, on request."""

    recording: str
    site: str
    risk: float | None
    snapshot: str  # JSON
    signature: int | None  # Checksum of the window model of the following scores; None without a model
    level_left: float | None  # Log-odds: largest threshold that raises the alarm; None if none does
    level_right: float | None
    # Columns of hop streams
    time_s: float
    log_likelihoods: tuple[float, ...]
    answer: int
    miss_rate: float
    clutter_rate: float
    approach: float
    seen: bool


TABLES: Mapping[str, type] = {
    # `recordings` is written last: its row means that the recording is complete.
    "hops": HeardHop,
    "approaches": HeardApproach,
    "hours": StateHours,
    "recordings": HeardRecording,
}
_ARROW = {str: "string", float: "double", int: "int64", bool: "bool"}


def write_table(path: Path, kind: type, rows: Iterable[Any]) -> None:
    """Write one file of a table, atomically."""
    arrow, parquet = optional("pyarrow"), optional("pyarrow.parquet")
    left, schema = map(asdict, rows), _schema(kind)
    with atomic_path(path) as temporary, parquet.ParquetWriter(temporary, schema, compression="zstd") as file:
        while batch := list(itertools.islice(left, BATCH_ROWS)):
            file.write_table(arrow.Table.from_pylist(batch, schema=schema))


def corpus_rows(out: Path, kind: type[Row]) -> Iterator[Row]:
    """Yield the rows of a table of a corpus, for completed recordings.

    Raises
    ------
    InputFileError
        If the folder is not a corpus, or a file is damaged or has other columns.
    """
    arrow, parquet = optional("pyarrow"), optional("pyarrow.parquet")
    table = next(name for name, one in TABLES.items() if one is kind)
    paths = sorted((out / "recordings").glob(f"[!.]*{PARQUET}"))
    if not paths:
        raise InputFileError(out, "expected the folder that `worldstate hear --out` wrote")
    # A recording that failed has no other table.
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
    # In "float | None" the first is the type of the values.
    first = get_args(hint)[0] if isinstance(hint, UnionType) else hint
    of_list = get_origin(first) is tuple
    plain = arrow.type_for_alias(_ARROW[get_args(first)[0] if of_list else first])
    return arrow.field(name, arrow.list_(plain) if of_list else plain, nullable=isinstance(hint, UnionType))
