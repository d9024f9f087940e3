"""Input and output of files within limits: text, JSON of one dataclass, CSV rows and arrays.

Files are written atomically: a reader never sees a partial file, and a run that fails leaves no file. Only
logs of an unlimited run grow under their own name. A symbolic link is kept, and its target is replaced.
Devices, pipes and folders are never replaced.
"""

import csv
import gzip
import io
import itertools
import json
import logging
import math
import os
import shutil
import stat
import uuid
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, BinaryIO, Self, TypeAlias, TypeVar, get_args, get_type_hints

import numpy as np

from worldstate.ground.errors import InputFileError, InvalidArgumentError, SchemaVersionError
from worldstate.ground.serialisation import decode, decode_json

try:
    import fcntl
except ImportError:  # On Windows no other program can write to an open file
    fcntl = None  # type: ignore[assignment]

_LOG = logging.getLogger(__name__)


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary sibling of `path` that replaces it on success and is removed on error."""
    # The sibling has the same suffix, because `numpy.savez` and `soundfile` use the suffix.
    target = check_target(path)
    temporary = target.with_name(f".{target.stem[:100]}-{uuid.uuid4().hex[:12]}{target.suffix}")
    try:
        yield temporary
        if target.exists():
            shutil.copymode(target, temporary)
        temporary.replace(target)
    finally:
        try:
            _remove(temporary)
        except BaseException:  # a second Ctrl-C, while the first one propagates
            _remove(temporary)
            raise


@contextmanager
def whole_file(path: str | Path) -> Iterator[BinaryIO]:
    """Yield an open file that gets its name at the end."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        yield file


def check_target(path: str | Path) -> Path:
    """Return the target of output to `path`, with links resolved; refuse anything but a new or plain file.

    Examples
    --------
    >>> check_target("/dev/null")
    Traceback (most recent call last):
    worldstate.ground.errors.InputFileError: /dev/null: expected a file to write to, found a device or pipe
    """
    try:
        target = Path(os.path.realpath(path))
    except ValueError as error:
        raise InputFileError(path, f"expected a file to write to ({error})") from error
    if not target.parent.is_dir():
        raise InputFileError(path, f"expected an existing folder {target.parent} to write into")
    if target.is_dir():
        raise InputFileError(path, "expected a file name to write to, found a folder")
    if os.path.lexists(target) and not target.is_file():
        raise InputFileError(path, "expected a file to write to, found a device or pipe")
    there = target if target.exists() else target.parent
    if not (os.access(there, os.W_OK) and os.access(target.parent, os.W_OK | os.X_OK)):
        raise InputFileError(path, "expected a place to write to, but permission is denied")
    return target


def write_text(path: str | Path, text: str) -> None:
    """Write `text` as UTF-8 with plain newlines, atomically; compressed if the name ends in .gz."""
    with atomic_path(path) as temporary:
        data = text.encode()
        temporary.write_bytes(gzip.compress(data, mtime=0) if temporary.suffix == ".gz" else data)


def write_json(path: str | Path, value: object, indent: int | None = None) -> None:
    """Write a value as strict JSON, atomically."""
    write_text(path, json.dumps(value, allow_nan=False, indent=indent) + "\n")


def write_rows(
    path: str | Path, columns: Sequence[str], rows: Iterable[Sequence[object]], newline: str = "\r\n"
) -> None:
    """Write CSV with a header, atomically."""
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator=newline)
        writer.writerow(columns)
        writer.writerows(rows)


_GONE = "expected the file of this run, but it was moved or removed"
FileOpener: TypeAlias = Callable[[Path], "AbstractContextManager[BinaryIO | GrowingFile]"]


@contextmanager
def line_writer(path: Path | None, opener: FileOpener = whole_file) -> Iterator[Callable[[str], None]]:
    """Yield a function that writes lines of UTF-8 to a file, or that does nothing without a path."""
    if path is None:
        yield lambda line: None
        return
    with opener(path) as file:

        def write(line: str) -> None:
            if isinstance(file, GrowingFile):
                file.go_on()
            file.write(f"{line}\n".encode())

        yield write


class GrowingFile:
    """Log file of an unlimited run, which has its name from the start and is never buffered.

    An earlier file of the same name is renamed to NAME.N.SUFFIX with the first free number, and so is a full
    file; only one full file of this run is kept. A record that cannot be written, or whose file was removed,
    is counted, and the cause is logged once: a failing log must not stop the run.

    Parameters
    ----------
    path : str or Path
        File to write.
    most_bytes : int, optional
        Size at which the file is full; by default it is never full.

    Attributes
    ----------
    lost : int
        Number of records that were not written.
    whole : bool
        Whether the file contains every record so far. If not, it accepts no more until `begin` or `go_on`.

    Raises
    ------
    InputFileError
        If the file cannot be opened, or another run writes to it.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     with GrowingFile(Path(folder) / "log.txt") as log:
    ...         _ = log.write(b"first")
    ...         log.begin()
    ...         _ = log.write(b"second")
    ...     [path.read_text() for path in sorted(Path(folder).iterdir())]
    ['first', 'second']
    """

    def __init__(self, path: str | Path, most_bytes: int | None = None) -> None:
        self.path, self._most, self.lost, self.whole = Path(path), most_bytes, 0, True
        self._file, self._bytes, self._said = claimed_file(path), 0, set[str]()
        self._aside: tuple[Path, os.stat_result] | None = None

    def begin(self) -> None:
        """Start a new file."""
        try:
            if is_named(self._file, self.path):
                self._make_way()
            else:
                self._lose(_GONE)
            self._file.close()
            self._file, self._bytes, self.whole = claimed_file(self.path), 0, True
            self._said.clear()
        except (OSError, InputFileError) as error:
            self._lose(str(error))

    def _make_way(self) -> None:
        """Rename this file to the name of the previous full file of this run, or to a free name."""
        here, before = os.fstat(self._file.fileno()), self._aside
        ours = before and before[0].exists() and os.path.samestat(before[0].stat(), before[1])
        target = check_target(self.path)
        self._aside = _set_aside(self._file, target, before[0] if before and ours else None), here

    def go_on(self) -> None:
        """Start a new file if this one is full or removed, else accept records again after a lost one."""
        if self.full:
            self.begin()
        self.whole = not self._file.closed

    @property
    def full(self) -> bool:
        """Whether the file has reached its size, or its name now belongs to another file."""
        return (self._most is not None and self._bytes >= self._most) or not is_named(self._file, self.path)

    def tell(self) -> int:
        """Return the length of the file in bytes."""
        return self._bytes

    def write(self, record: bytes) -> int:
        """Write a record completely or not at all."""
        left = memoryview(record)
        if not is_named(self._file, self.path):
            self._lose(_GONE)
        try:
            while left and self.whole:
                left = left[self._file.write(left) :]
        except OSError as error:
            with suppress(OSError):  # otherwise the next record would follow a gap
                self._file.seek(self._bytes)
                self._file.truncate()
            self._lose(f"expected room to write ({error.strerror})")
        self._bytes += len(record) if self.whole else 0
        self.lost += not self.whole
        return len(record)

    def _lose(self, problem: str) -> None:
        self.whole = False
        if problem not in self._said:
            _LOG.warning("%s: %s", self.path, problem.removeprefix(f"{self.path}: "))
            self._said.add(problem)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        if self.lost:
            _LOG.warning("%s: %d records were lost", self.path, self.lost)


def claimed_file(path: str | Path) -> io.FileIO:
    """Open a new file at `path` that no other run writes to; rename an existing one to NAME.N.SUFFIX.

    Raises
    ------
    InputFileError
        If the file cannot be opened, or another run writes to it.
    """
    target = check_target(path)
    while True:
        file = io.FileIO(os.open(target, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666), "r+")
        _lock(file, path)
        if is_named(file, target) and not os.fstat(file.fileno()).st_size:
            return file
        if is_named(file, target):
            _set_aside(file, target)
        file.close()


def is_named(file: io.FileIO, path: Path) -> bool:
    """Return whether a path still refers to an open file."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except (OSError, ValueError):  # removed, or closed
        return False


def _lock(file: io.FileIO, path: str | Path) -> None:
    """Lock a file until it is closed, if the system has such locks."""
    if fcntl is None:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        file.close()
        raise InputFileError(path, "expected a file of its own, but another run writes to it") from error
    except OSError:  # a file system without locks
        return


def _set_aside(file: io.FileIO, target: Path, name: Path | None = None) -> Path:
    """Rename an open file to `name`, by default to NAME.N.SUFFIX with the first free number; return it."""
    if fcntl is None:  # Windows cannot rename an open file; elsewhere its lock excludes other runs
        file.close()
    numbers = itertools.count(1)
    while name is None:
        free = target.with_name(f"{target.stem}.{next(numbers)}{target.suffix}")
        with suppress(FileExistsError):
            free.touch(exist_ok=False)  # reserves the number against other runs
            name = free
    return target.replace(name)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


T = TypeVar("T")

MAX_BYTES = 16 << 20
MAX_ROWS = 200_000
MAX_COLUMNS = 10_000
MAX_CELL = 1000


def read_text(path: str | Path, what: str, max_bytes: int) -> str:
    """Return the content of a UTF-8 file of at most `max_bytes`."""
    try:
        return read_bytes(path, what, max_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputFileError(path, f"expected {what} in UTF-8") from error


def plain_file(path: str | Path, what: str) -> BinaryIO:
    """Open a file to read; refuse a pipe or device, which may never start or end, and a name with NUL.

    Raises
    ------
    InputFileError
        If the file cannot be opened, or is not a plain file.

    Examples
    --------
    >>> plain_file("/dev/zero", "positions")
    Traceback (most recent call last):
    worldstate.ground.errors.InputFileError: /dev/zero: expected positions, found a device or pipe
    """
    # Non-blocking, because opening a pipe otherwise waits until a program writes to it.
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    try:
        file = open(path, "rb", opener=lambda name, _: os.open(name, flags))  # noqa: SIM115 - the caller's
    except (OSError, ValueError) as error:
        raise InputFileError(path, f"expected {what} ({getattr(error, 'strerror', error)})") from error
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise InputFileError(path, f"expected {what}, found a device or pipe")
    return file


UNREADABLE = (OSError, EOFError, zlib.error)  # Errors of a disk, or of a compressed file


@contextmanager
def unpacked_file(path: str | Path, what: str) -> Iterator[BinaryIO]:
    """Yield an open file, decompressed while it is read if its name ends in .gz."""
    with plain_file(path, what) as file:
        if Path(path).suffix != ".gz":
            yield file
            return
        with gzip.GzipFile(fileobj=file) as packed, io.BufferedReader(packed) as unpacked:
            yield unpacked


def read_bytes(path: str | Path, what: str, max_bytes: int) -> bytes:
    """Return the content of a file of at most `max_bytes`, decompressed if its name ends in .gz."""
    try:
        with unpacked_file(path, what) as file:
            data = file.read(max_bytes + 1)
    except UNREADABLE as error:
        problem = getattr(error, "strerror", None) or error
        raise InputFileError(path, f"expected {what} ({problem})") from error
    if len(data) > max_bytes:
        raise InputFileError(path, f"expected {what} of at most {max_bytes >> 20} MiB")
    return data


def read_json(path: str | Path, what: str) -> object:
    """Return the content of a JSON file, strictly decoded."""
    with refused_as_file(path):
        return decode_json(read_text(path, what, MAX_BYTES), what)


def read_record(kind: type[T], path: str | Path, what: str, *, by_hand: bool = False) -> T:
    """Return the value of type `kind` in a JSON file; with `by_hand`, unknown keys are refused."""
    with refused_as_file(path):
        given = read_json(path, f"a {what} file")
        if by_hand:
            _check_keys(given, kind, what)
        return decode(kind, given, what)


def _check_keys(given: object, kind: type, where: str) -> None:
    """Refuse unknown keys in hand-written files, because a misspelt key would be silently ignored."""
    if not isinstance(given, dict):  # the decoder reports it
        return
    hints = {one.name: get_type_hints(kind)[one.name] for one in fields(kind)}
    if unknown := sorted(set(given) - set(hints)):
        raise InvalidArgumentError(f"{where}: expected keys among {sorted(hints)}, got {unknown}")
    for key, value in given.items():
        several, part = isinstance(value, list), _record_in(hints[key])
        for number, one in enumerate(value if several else [value]):
            if part is not None:
                _check_keys(one, part, f"{where}.{key}" + f"[{number}]" * several)


def _record_in(hint: Any) -> Any:
    """Return the dataclass in a type hint, also within a container; None without one."""
    return hint if is_dataclass(hint) else next(filter(None, map(_record_in, get_args(hint))), None)


@contextmanager
def refused_as_file(path: object, where: str = "") -> Iterator[None]:
    """Convert errors in the context to errors of a file, with its name and the place in it."""
    try:
        yield
    except SchemaVersionError as error:
        raise SchemaVersionError(path, error.problem) from error
    except InvalidArgumentError as error:
        raise InputFileError(path, f"{where}{error}") from error


def read_rows(
    path: Path,
    columns: Collection[str],
    optional: Collection[str] = (),
    most_bytes: int = MAX_BYTES,
    most_rows: int = MAX_ROWS,
) -> Iterator[tuple[int, dict[str, str]]]:
    r"""Yield line number and wanted columns of each CSV row, with the optional columns that exist.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = (Path(folder) / "list.csv").write_text("ID,Note\n1_00_0002,wet\n")
    ...     list(read_rows(Path(folder) / "list.csv", ["ID"]))
    [(2, {'ID': '1_00_0002'})]
    """
    # Decoded while it is read, because `StringIO` takes four bytes per character.
    data = io.BytesIO(read_bytes(path, "a CSV file", most_bytes))
    reader = csv.reader(io.TextIOWrapper(data, encoding="utf-8-sig", newline=""))
    try:
        places = _places(path, next(reader, []), columns, optional)
        for number, cells in enumerate(filter(None, reader)):
            if number >= most_rows:
                raise InputFileError(path, f"expected at most {most_rows} lines")
            row = {name: cells[at].strip() if at < len(cells) else "" for name, at in places.items()}
            if max(map(len, row.values())) > MAX_CELL:
                problem = f"expected at most {MAX_CELL} characters between two commas"
                raise InputFileError(path, f"line {reader.line_num}: {problem}")
            yield reader.line_num, row
    except UnicodeDecodeError as error:
        raise InputFileError(path, "expected a CSV file in UTF-8") from error
    except csv.Error as error:
        raise InputFileError(path, f"line {reader.line_num}: expected CSV: {error}") from error


def number(path: str | Path, line: int, row: dict[str, str], column: str) -> float:
    """Return the finite number in a column of a row from `read_rows`."""
    try:
        value = float(row[column])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        problem = f"line {line}: expected a finite number as {column}, got {row[column][:40]!r}"
        raise InputFileError(path, problem)
    return value


def check_row(path: str | Path, line: int, *cells: tuple[str, object, object]) -> None:
    """Refuse the first cell that does not fit, given as what is expected, the cell, and whether it fits."""
    for expected, got, fits in cells:
        if not fits:
            raise InputFileError(path, f"line {line}: expected {expected}, got {got!r:.60}")


def _places(
    path: Path, header: list[str], columns: Collection[str], optional: Collection[str]
) -> dict[str, int]:
    """Return the position of each column in a line."""
    if len(header) > MAX_COLUMNS:
        raise InputFileError(path, f"expected at most {MAX_COLUMNS} columns, got {len(header)}")
    header = [name.strip() for name in header]
    missing = [column for column in columns if column not in header]
    if missing:
        mark = next((f", got {one!r} for commas" for one in ";\t" if one in "".join(header[:1])), "")
        problem = f"expected columns {', '.join(columns)}, missing {', '.join(missing)}{mark}"
        raise InputFileError(path, problem)
    return {name: header.index(name) for name in (*columns, *optional) if name in header}


def in_order(stamps_ns: Sequence[int], source: str) -> list[int]:
    """Return the indices that sort the stamps, with the last one of equal stamps; warn of any change.

    Examples
    --------
    >>> in_order([0, 200, 100, 200], "camera")
    [0, 2, 3]
    """
    last = {stamp_ns: place for place, stamp_ns in enumerate(stamps_ns)}
    late = sum(b < a for a, b in itertools.pairwise(stamps_ns))
    if late or len(last) < len(stamps_ns):
        told = "%s: %d stamps were late and are sorted; of %d repeated stamps only the last one is used"
        _LOG.warning(told, source, late, len(stamps_ns) - len(last))
    return [last[stamp_ns] for stamp_ns in sorted(last)]


Result = TypeVar("Result")

# A zip file ends with a record of 22 bytes and a comment of at most 65,535 bytes.
_END, _END_BYTES, _LONGEST_COMMENT = b"PK\5\6", 22, 65_535
_MAX_DIRECTORY_BYTES = 1 << 16


def save_npz(path: str | Path, values: Mapping[str, Any]) -> None:
    """Write arrays under their names."""
    with whole_file(path) as file:
        np.savez_compressed(file, **values)


def load_npz(
    path: str | Path, what: str, max_bytes: int, read: Callable[[dict[str, np.ndarray]], Result]
) -> Result:
    """Return the result of `read` for the arrays of a file, which take at most `max_bytes` when decoded.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     save_npz(Path(folder) / "a.npz", {"x": np.arange(3)})
    ...     load_npz(Path(folder) / "a.npz", "numbers", 1 << 10, lambda values: values["x"].sum())
    np.int64(3)
    """
    try:
        with plain_file(path, f"{what} as npz") as file:
            if _decoded_bytes(file) > max_bytes:
                raise InputFileError(path, f"expected {what} of at most {max_bytes >> 20} MiB")
            with np.load(file, allow_pickle=False) as arrays:
                return read({name: arrays[name] for name in arrays.files})
    except InputFileError:
        raise
    except OSError as error:
        raise InputFileError(path, f"expected {what} as npz ({error.strerror or error})") from error
    except InvalidArgumentError as error:
        raise InputFileError(path, f"expected {what} ({error})") from error
    except Exception as error:  # zipfile, zlib and numpy raise different errors for damaged bytes
        raise InputFileError(path, f"expected {what} as npz, but it cannot be read: {error}") from error


def _decoded_bytes(file: BinaryIO) -> int:
    """Return the memory that the arrays take, with at least 64 bits per number, from their headers."""
    _check_directory(file)
    total = 0
    with zipfile.ZipFile(file) as archive:
        for name in archive.namelist():
            with archive.open(name) as member:
                # The header of a later version may be 4 GiB long, so it is refused.
                if np.lib.format.read_magic(member) != (1, 0):
                    raise InvalidArgumentError(f"{name}: expected an array in version 1.0 of its format")
                shape, _, dtype = np.lib.format.read_array_header_1_0(member)
                total += math.prod(shape) * max(dtype.itemsize, 8)
    file.seek(0)
    return total


def _check_directory(file: BinaryIO) -> None:
    """Refuse a zip file whose list of members could itself fill the memory."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - _END_BYTES - _LONGEST_COMMENT, 0))
    tail = file.read()
    at = tail.rfind(_END)
    extended = tail[max(at - 20, 0) : at].startswith(b"PK\6\7")
    if at < 0 or extended or int.from_bytes(tail[at + 12 : at + 16], "little") > _MAX_DIRECTORY_BYTES:
        raise InvalidArgumentError("expected a zip file with a short list of members")
