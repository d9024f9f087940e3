"""Files: text, JSON of one dataclass, CSV rows and arrays, read within bounds; written whole or not at all.

A reader never meets half a file, and a run that fails leaves nothing behind; only logs of a run without an
end grow under their own name. A link is followed: what it
points to is replaced, and the link stays. Devices, pipes and folders are never replaced.
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
except ImportError:  # Windows, which lets no other program write to an open file anyway
    fcntl = None  # type: ignore[assignment]

_LOG = logging.getLogger(__name__)


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Lend a temporary sibling of `path`; it takes the name on success and disappears on error."""
    # The sibling keeps the suffix, because writers such as `numpy.savez` and `soundfile` look at it.
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
        except BaseException:  # a second Ctrl-C; the first one is on its way up already
            _remove(temporary)
            raise


@contextmanager
def whole_file(path: str | Path) -> Iterator[BinaryIO]:
    """Lend an open file that takes its name at the end."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        yield file


def check_target(path: str | Path) -> Path:
    """Return where output to `path` would go, links followed; refuse what is neither free nor a plain file.

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
        raise InputFileError(path, "expected a place to write to, permission denied")
    return target


def write_text(path: str | Path, text: str) -> None:
    """Write `text` as UTF-8 with plain newlines, whole or not at all; packed if the name ends in .gz."""
    with atomic_path(path) as temporary:
        data = text.encode()
        temporary.write_bytes(gzip.compress(data, mtime=0) if temporary.suffix == ".gz" else data)


def write_json(path: str | Path, value: object, indent: int | None = None) -> None:
    """Write a value as strict JSON, whole or not at all."""
    write_text(path, json.dumps(value, allow_nan=False, indent=indent) + "\n")


def write_rows(
    path: str | Path, columns: Sequence[str], rows: Iterable[Sequence[object]], newline: str = "\r\n"
) -> None:
    """Write CSV with a header, whole or not at all."""
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator=newline)
        writer.writerow(columns)
        writer.writerows(rows)


_GONE = "expected the file that was begun, it was moved or removed"
FileOpener: TypeAlias = Callable[[Path], "AbstractContextManager[BinaryIO | GrowingFile]"]


@contextmanager
def line_writer(path: Path | None, opener: FileOpener = whole_file) -> Iterator[Callable[[str], None]]:
    """Lend a function that writes lines of UTF-8 to a file; without a path one that writes nothing."""
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
    """File of a run without an end: under its own name from the start, every record in it when written.

    What was there before becomes NAME.N.SUFFIX, the first number that is free, and so does a file that is
    full; of this run one such file is kept. What cannot be written, or would go to a file that was removed,
    is logged once and counted: a log is not what a run is for.

    Parameters
    ----------
    path : str or Path
        Where to write.
    most_bytes : int, optional
        When a file is full. Without it none is.

    Attributes
    ----------
    lost : int
        Records that were not written.
    whole : bool
        Whether the file has every record up to now; it takes no more of them until `begin` or `go_on`.

    Raises
    ------
    InputFileError
        If it cannot be opened, or another run writes to it.

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
        """Begin a new file."""
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
        """Give this file the name of the one before it, unless that is gone or another's by now."""
        here, before = os.fstat(self._file.fileno()), self._aside
        ours = before and before[0].exists() and os.path.samestat(before[0].stat(), before[1])
        target = check_target(self.path)
        self._aside = _set_aside(self._file, target, before[0] if before and ours else None), here

    def go_on(self) -> None:
        """Begin a new file if this one is full or gone; else take records again after one that was lost."""
        if self.full:
            self.begin()
        self.whole = not self._file.closed

    @property
    def full(self) -> bool:
        """Whether the file has its size, or its name is no longer its own."""
        return (self._most is not None and self._bytes >= self._most) or not is_named(self._file, self.path)

    def tell(self) -> int:
        """Return how long the file is, bytes."""
        return self._bytes

    def write(self, record: bytes) -> int:
        """Write a record, whole or not at all."""
        left = memoryview(record)
        if not is_named(self._file, self.path):
            self._lose(_GONE)
        try:
            while left and self.whole:
                left = left[self._file.write(left) :]
        except OSError as error:
            with suppress(OSError):  # else what comes next would follow a hole
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
    """Open a new file at `path` that no other run writes to; what is there becomes NAME.N.SUFFIX.

    Raises
    ------
    InputFileError
        If it cannot be opened, or another run writes to it.
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
    """Whether a path still names an open file."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except (OSError, ValueError):  # it was removed; it is closed
        return False


def _lock(file: io.FileIO, path: str | Path) -> None:
    """Claim a file until it is closed, where the system has such locks."""
    if fcntl is None:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        file.close()
        raise InputFileError(path, "expected a file of its own, another run writes to it") from error
    except OSError:  # a file system without locks
        return


def _set_aside(file: io.FileIO, target: Path, name: Path | None = None) -> Path:
    """Rename an open file to `name`, else to NAME.N.SUFFIX with the first number that is free; return it."""
    if fcntl is None:  # Windows renames no open file; elsewhere its lock keeps other runs out
        file.close()
    numbers = itertools.count(1)
    while name is None:
        free = target.with_name(f"{target.stem}.{next(numbers)}{target.suffix}")
        with suppress(FileExistsError):
            free.touch(exist_ok=False)  # so that no other run takes the same number
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
    """Return what a file in UTF-8 of at most so many bytes holds."""
    try:
        return read_bytes(path, what, max_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputFileError(path, f"expected {what} in UTF-8") from error


def plain_file(path: str | Path, what: str) -> BinaryIO:
    """Open a file to read; refuse a pipe or device, which may never end or never begin, and a name with NUL.

    Raises
    ------
    InputFileError
        If it cannot be opened, or is no file.

    Examples
    --------
    >>> plain_file("/dev/zero", "positions")
    Traceback (most recent call last):
    worldstate.ground.errors.InputFileError: /dev/zero: expected positions, found a device or pipe
    """
    # Without waiting: a pipe is opened once somebody writes to it.
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    try:
        file = open(path, "rb", opener=lambda name, _: os.open(name, flags))  # noqa: SIM115 - the caller's
    except (OSError, ValueError) as error:
        raise InputFileError(path, f"expected {what} ({getattr(error, 'strerror', error)})") from error
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise InputFileError(path, f"expected {what}, found a device or pipe")
    return file


UNREADABLE = (OSError, EOFError, zlib.error)  # Of a disk, or of a packed file


@contextmanager
def unpacked_file(path: str | Path, what: str) -> Iterator[BinaryIO]:
    """Lend an open file; if its name ends in .gz, what is packed in it, unpacked as far as it is read."""
    with plain_file(path, what) as file:
        if Path(path).suffix != ".gz":
            yield file
            return
        with gzip.GzipFile(fileobj=file) as packed, io.BufferedReader(packed) as unpacked:
            yield unpacked


def read_bytes(path: str | Path, what: str, max_bytes: int) -> bytes:
    """Return what a file, unpacked if its name ends in .gz, of at most so many bytes holds."""
    try:
        with unpacked_file(path, what) as file:
            data = file.read(max_bytes + 1)
    except UNREADABLE as error:
        problem = getattr(error, "strerror", None) or error
        raise InputFileError(path, f"expected {what} ({problem})") from error
    if len(data) > max_bytes:
        raise InputFileError(path, f"expected {what} of at most {max_bytes >> 20} MiB")
    return data


def read_json(path: str | Path, what: str, max_bytes: int = MAX_BYTES) -> object:
    """Return what a JSON file holds, decoded strictly."""
    with refused_as_file(path):
        return decode_json(read_text(path, what, max_bytes), what)


def read_record(kind: type[T], path: str | Path, what: str, *, by_hand: bool = False) -> T:
    """Return the value of type `kind` that a JSON file holds, which is checked for its keys if `by_hand`."""
    with refused_as_file(path):
        given = read_json(path, f"a {what} file")
        if by_hand:
            _check_keys(given, kind, what)
        return decode(kind, given, what)


def _check_keys(given: object, kind: type, where: str) -> None:
    """Refuse keys that mean nothing in what is written by hand: a wrong name would be left out in silence."""
    if not isinstance(given, dict):  # the decoder says what it is
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
    """Return the dataclass of which a hint allows one or several, None without one."""
    return hint if is_dataclass(hint) else next(filter(None, map(_record_in, get_args(hint))), None)


@contextmanager
def refused_as_file(path: object, where: str = "") -> Iterator[None]:
    """Turn refusals inside into those of a file, which begin with its name and the place in it."""
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
    r"""Yield the wanted columns of a CSV file with a header, and the optional ones that it has, by line.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = (Path(folder) / "list.csv").write_text("ID,Note\n1_00_0002,wet\n")
    ...     list(read_rows(Path(folder) / "list.csv", ["ID"]))
    [(2, {'ID': '1_00_0002'})]
    """
    # Decoded as it is read: `StringIO` takes four bytes a character.
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
    """Return the finite number in a column of a row that `read_rows` yielded."""
    try:
        value = float(row[column])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        problem = f"line {line}: expected a finite number as {column}, got {row[column][:40]!r}"
        raise InputFileError(path, problem)
    return value


def _places(
    path: Path, header: list[str], columns: Collection[str], optional: Collection[str]
) -> dict[str, int]:
    """Return in which place of a line each column stands."""
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
    """Return the places of increasing stamps, of equal ones the last; a warning counts what was not so.

    Examples
    --------
    >>> in_order([0, 200, 100, 200], "camera")
    [0, 2, 3]
    """
    last = {stamp_ns: place for place, stamp_ns in enumerate(stamps_ns)}
    late = sum(b < a for a, b in itertools.pairwise(stamps_ns))
    if late or len(last) < len(stamps_ns):
        told = "%s: %d stamps came after later ones and are sorted, %d came again, of which the last counts"
        _LOG.warning(told, source, late, len(stamps_ns) - len(last))
    return [last[stamp_ns] for stamp_ns in sorted(last)]


Result = TypeVar("Result")

# The end of a zip file: a record of 22 bytes, then a comment of at most 65,535.
_END, _END_BYTES, _LONGEST_COMMENT = b"PK\5\6", 22, 65_535
_MAX_DIRECTORY_BYTES = 1 << 16


def save_npz(path: str | Path, values: Mapping[str, Any]) -> None:
    """Write arrays by name."""
    with whole_file(path) as file:
        np.savez_compressed(file, **values)


def load_npz(
    path: str | Path, what: str, max_bytes: int, read: Callable[[dict[str, np.ndarray]], Result]
) -> Result:
    """Return what `read` makes of the arrays of a file, which take at most `max_bytes` when decoded.

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
    except Exception as error:  # zipfile, zlib and numpy each have errors of their own for damaged bytes
        raise InputFileError(path, f"expected {what} as npz, they do not read: {error}") from error


def _decoded_bytes(file: BinaryIO) -> int:
    """Return how much memory the arrays take, as numbers of 64 bits at least, from their headers alone."""
    _check_directory(file)
    total = 0
    with zipfile.ZipFile(file) as archive:
        for name in archive.namelist():
            with archive.open(name) as member:
                # The header of a later version may be 4 GiB long.
                if np.lib.format.read_magic(member) != (1, 0):
                    raise InvalidArgumentError(f"{name}: expected an array in version 1.0 of its format")
                shape, _, dtype = np.lib.format.read_array_header_1_0(member)
                total += math.prod(shape) * max(dtype.itemsize, 8)
    file.seek(0)
    return total


def _check_directory(file: BinaryIO) -> None:
    """Refuse a zip file whose list of members would itself fill the memory."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - _END_BYTES - _LONGEST_COMMENT, 0))
    tail = file.read()
    at = tail.rfind(_END)
    extended = tail[max(at - 20, 0) : at].startswith(b"PK\6\7")
    if at < 0 or extended or int.from_bytes(tail[at + 12 : at + 16], "little") > _MAX_DIRECTORY_BYTES:
        raise InvalidArgumentError("expected a zip file with a short list of members")
