"""Microphone positions from files (Acoular XML, CSV, JSON, ODAS) and of boards known by name."""

import csv
import json
import logging
import math
import re
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import defusedxml.ElementTree as SafeElementTree
import numpy as np
from defusedxml.common import DefusedXmlException

from worldstate.frontend.array.microphone_array import (
    LEAST_SPACING_M,
    MAX_MICROPHONES,
    MicrophoneArray,
    nearest_spacings_m,
)
from worldstate.ground import FloatArray, InputFileError, InvalidArgumentError

from .array_match import by_number, microphone_order
from .file_io import read_bytes, write_text

_LOG = logging.getLogger(__name__)
DATA = Path(str(files("worldstate"))) / "data"
MODELS, PACKED = DATA / "models", ".json.gz"  # Further models; `DATA` contains two for the roof array

Axes = Literal["acoular", "base_link"]
# The coordinates x, y and z of a microphone, before conversion to numbers.
Row: TypeAlias = Sequence[object]

MAX_BYTES = 1 << 20
# Limits of the width of an array and of the distances between its microphones. No vehicle carries an array
# beyond them: such a file is in millimetres, centimetres or kilometres.
MAX_APERTURE_M = 20.0
MAX_SPACING_M, FAR_APART_M = 3.0, 1.0
MIN_SPACING_M = 1e-3
_UNITS_M = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_STATED = "a header x_mm,y_mm,z_mm, or positions_mm in JSON, states them"
_HEADER = re.compile(r"(?:pos(?:ition)?[ _]?)?([xyz])(?:[ _]*[\[(]?(mm|cm|m)[\])]?)?", re.IGNORECASE)
_TRANSPOSED = "three rows are a 3 x M matrix, as of MATLAB and pyroomacoustics: write its transpose"
_MATRIX = "numpy.savetxt and MATLAB's writematrix write CSV of an M x 3 matrix"
_DECIMAL_COMMAS = re.compile(r"(-?\d*,\d+|-?\d+)([;\s]+(-?\d*,\d+|-?\d+)){2,3}")
# Comments of libconfig are removed and strings kept; an unterminated comment extends to the end of the file.
_COMMENT = re.compile(r'("(?:\\.|[^"\\])*"?)|#[^\n]*|//[^\n]*|/\*(?:.*?\*/|.*)', re.DOTALL)
_MICS, _GROUPS = (
    re.compile(r"\bmics\s*[:=]\s*[(\[](?=[\s,]*[{@])"),
    re.compile(r"(?:[\s,]*\{[^{}]*\})*[\s,]*[)\]]"),
)
_MU, _MAP = (re.compile(rf"\b{key}\s*[:=]\s*[(\[]([^()\[\]]*)[)\]]") for key in ("mu", "map"))


class _Rows(NamedTuple):
    """Content of a file, before its numbers are read."""

    rows: list[Row]
    axes: str = "base_link"
    channels: tuple[Any, ...] = ()
    unit_m: float = 1.0


def read_array(path: str | Path, axes: Axes | None = None) -> MicrophoneArray:
    r"""Read microphone positions in metres, one microphone per channel, in the order of the channels.

    The start of the file determines its format:

    - Acoular XML, ``<MicArray><pos Name="1" x="0.1" y="0" z="0" /> ...``, in the axes of the array plane: x
      to the right, y up, z along the look direction, so that :math:`(x, y, z)_{base} = (z, -x, y)_{file}`.
    - CSV with x, y, z of one microphone per line, with or without a header and a column of names; separated
      by comma, semicolon, tab or spaces. The axes are those of `base_link`: x forward, y left, z up. A header
      may give another unit: ``x_mm,y_mm,z_mm``.
    - JSON, ``[[x, y, z], ...]`` or ``{"positions_m": [[x, y, z], ...], "axes": "base_link"}``, in `base_link`
      axes unless ``"axes"`` is ``"acoular"``. ``"channels": [2, 3, ...]``, counted from 1, selects the
      channels if the sound card has more channels than microphones. ``"positions_mm"`` and ``"positions_cm"``
      use other units.
    - ODAS configuration: ``mics = ( { mu = ( x, y, z ); ... }, ... );``, in `base_link` axes, with ``map: (2,
      3, ...)`` as the channels.

    If no such file exists, the name may be one of `named_arrays`.

    Parameters
    ----------
    path : str or Path
        The file, at most 1 MiB and 1024 microphones, or the name of an array.
    axes : {"acoular", "base_link"}, optional
        Axes of the numbers if they differ from those of the format; not allowed with a name.

    Returns
    -------
    MicrophoneArray
        Positions of shape (M, 3) in metres: x forward, y left, z up.

    Raises
    ------
    InputFileError
        If the file is missing, too large or in none of the four formats; contains a document type or
        entities; has fewer than two microphones, or two at the same place; a coordinate is missing or not
        finite; the array cannot be in metres; or it has no horizontal extent (a vertical line cannot resolve
        azimuth).

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     name = Path(folder) / "mics.csv"
    ...     _ = name.write_text("name,x,y,z\nleft,0,0.2,1.4\nright,0,-0.2,1.4\n")
    ...     read_array(name).positions_m.tolist()
    [[0.0, 0.2, 1.4], [0.0, -0.2, 1.4]]
    >>> read_array("respeaker-6").n_microphones
    6
    """
    name = Path(path)
    known = named_arrays()
    if name.name in known and not name.exists():  # also if a car file gives the name as a path
        if axes is not None:
            # Acoular's axes are left-handed, so a flat board in them would be its mirror image.
            raise InputFileError(name, f"expected no axes with the name of an array, got {axes}")
        board = known[name.name]
        return MicrophoneArray(board["positions_m"], name.name, tuple(board.get("channels", ())))
    data = read_bytes(name, f"an array file or one of {', '.join(known)}", MAX_BYTES)
    held = _held(name, data)
    positions = [[held.unit_m * one for one in row] for row in _numbers(name, held.rows)]
    if len(positions) == 3 and len({*positions[2]}) == 1 < len({row[2] for row in positions}):
        _LOG.warning("%s: read as three microphones; if %s", name, _TRANSPOSED)
    return checked_array(name, positions, axes or held.axes, held.channels)


def _held(path: Path, data: bytes) -> _Rows:
    """Return the content of a file of any format."""
    start = data.removeprefix(b"\xef\xbb\xbf").lstrip()[:1]
    if start == b"<":
        return _Rows(_xml_rows(path, data), "acoular")
    if start in (b"[", b"{"):
        return _json_rows(path, data)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        problem = "expected microphones as XML, CSV, JSON or .cfg of ODAS in UTF-8"
        raise InputFileError(path, f"{problem}; {_MATRIX}") from error
    plain = _COMMENT.sub(lambda found: found[1] or "", text)
    mics = _MICS.search(plain)
    if "@include" in plain[0 if mics is None else mics.end() :]:
        raise InputFileError(path, "expected one file: replace @include by the content of that file")
    return _csv_rows(path, text) if mics is None else _odas_rows(path, plain, mics.end())


@cache
def named_arrays() -> dict[str, dict[str, Any]]:
    """Return the boards known by name, each as in a JSON file with its ``"source"``.

    Examples
    --------
    >>> ", ".join(named_arrays())
    'respeaker-4, respeaker-6, respeaker-usb, uma-8, uma-16, xmos'
    """
    text = (DATA / "arrays.json").read_text("utf-8")
    known: dict[str, dict[str, Any]] = json.loads(text)
    return known


def shipped_models() -> dict[str, Path]:
    """Return the files of the shipped models by name; the two for the roof array come first."""
    roof = {"standing": DATA / "default_model.json", "moving": DATA / "moving_model.json"}
    return roof | {one.name.removesuffix(PACKED): one for one in sorted(MODELS.glob(f"*{PACKED}"))}


def file_of_model(
    path: str | Path | None = None, array: MicrophoneArray | None = None, *, moving_ego: bool = False
) -> Path:
    """Return the file that `read_model` reads for these arguments."""
    shipped = shipped_models()
    if path is not None and (str(path) not in shipped or Path(path).exists()):
        return Path(path)
    boards = named_arrays() if path is None and array is not None else {}
    for name in boards.keys() & shipped.keys():
        if array is not None and microphone_order(np.array(boards[name]["positions_m"]), array) is not None:
            path = name
    return shipped[str(path or ("moving" if moving_ego else "standing"))]


def write_array_xml(path: str | Path, array: MicrophoneArray, name: str = "array") -> None:
    """Write an array as Acoular XML, atomically; `read_array` returns the same numbers.

    Parameters
    ----------
    path : str or Path
        File to write.
    array : MicrophoneArray
        Positions in `base_link` axes.
    name : str
        Value of the ``name`` attribute.

    Raises
    ------
    InputFileError
        If the folder does not exist.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     name = Path(folder) / "pair.xml"
    ...     write_array_xml(name, MicrophoneArray(np.array([[0.0, 0.2, 0.0], [0.0, -0.2, 0.0]])))
    ...     print(name.read_text().splitlines()[2].strip())
    <pos Name="Point 1" x="-0.2" y="0.0" z="0.0" />
    """
    in_file = array.positions_m[:, [1, 2, 0]] * [-1.0, 1.0, 1.0] + 0.0
    rows = [
        f'    <pos Name="Point {number}" x="{x!r}" y="{y!r}" z="{z!r}" />'
        for number, (x, y, z) in enumerate(in_file.tolist(), start=1)
    ]
    from xml.sax.saxutils import quoteattr  # Imports an HTTP client

    head = f'<?xml version="1.0" encoding="utf-8"?>\n<MicArray name={quoteattr(name)}>'
    write_text(path, "\n".join([head, *rows, "</MicArray>", ""]))


def array_csv(array: MicrophoneArray) -> str:
    r"""Return an array as CSV in `base_link` axes and metres, as `read_array` reads it.

    Examples
    --------
    >>> array_csv(MicrophoneArray([[0.0, 0.2, 1.4], [0.0, -0.2, 1.4]]))
    'x,y,z\n0.0,0.2,1.4\n0.0,-0.2,1.4\n'
    """
    rows = (",".join(map(repr, row)) for row in (array.positions_m + 0.0).tolist())
    return "\n".join(["x,y,z", *rows, ""])


def checked_array(
    path: Path, in_file: Sequence[Sequence[float]], axes: str, channels: tuple[int, ...] = ()
) -> MicrophoneArray:
    """Check the positions of a file, and convert them to `base_link` axes."""
    if axes not in get_args(Axes):
        raise InputFileError(path, f"axes: expected {' or '.join(get_args(Axes))}, got {axes!r:.40}")
    if not 2 <= len(in_file) <= MAX_MICROPHONES:
        raise InputFileError(path, f"expected 2 to {MAX_MICROPHONES} microphones, got {len(in_file)}")
    positions = np.array(in_file, dtype=np.float64)
    if axes == "acoular":
        positions = positions[:, [2, 0, 1]] * [1.0, -1.0, 1.0] + 0.0
    _check_size(path, positions)
    try:
        return MicrophoneArray(positions, str(path), channels)
    except InvalidArgumentError as error:
        raise InputFileError(path, str(error)) from error


def _check_size(path: Path, positions_m: FloatArray) -> None:
    extent_m, spacings_m = np.ptp(positions_m, axis=0), nearest_spacings_m(positions_m)
    wide_m, mean_m, least_m = float(extent_m.max()), spacings_m.mean(), spacings_m.min()
    upright = extent_m[:2].max() < MIN_SPACING_M and least_m >= LEAST_SPACING_M
    # Two microphones at the same place in an otherwise plausible array do not show a wrong unit;
    # `MicrophoneArray` reports them.
    small = LEAST_SPACING_M <= least_m < MIN_SPACING_M or 0.0 < mean_m < MIN_SPACING_M
    metres = "expected positions in metres, got"
    for wrong, problem in (
        (wide_m > MAX_APERTURE_M, f"{metres} an array {wide_m:g} wide: millimetres? Then {_STATED}"),
        (mean_m > MAX_SPACING_M, f"{metres} microphones {mean_m:g} apart: centimetres? Then {_STATED}"),
        (small, f"{metres} microphones {least_m:g} apart: divided by 1000?"),
        (upright, "expected a horizontal extent, got a vertical line, which cannot resolve azimuth"),
    ):
        if wrong:
            raise InputFileError(path, problem)
    if mean_m > FAR_APART_M:
        _LOG.warning("%s: microphones %.3g m apart; if in centimetres or inches, %s", path, mean_m, _STATED)


def _xml_rows(path: Path, data: bytes) -> list[Row]:
    try:
        root: Any = SafeElementTree.fromstring(data, forbid_dtd=True)
    except DefusedXmlException as error:
        problem = "expected plain XML, got a document type or entities, which are refused"
        raise InputFileError(path, problem) from error
    except (SafeElementTree.ParseError, ValueError, LookupError) as error:
        raise InputFileError(path, f"expected array XML, but it does not parse: {error}") from error
    found = [one for one in root.iter() if str(one.tag).rpartition("}")[2] == "pos"]  # in any namespace
    order = by_number(path, [element.get("Name", "") for element in found])
    return [[found[place].get(axis) for axis in "xyz"] for place in order]


def _csv_rows(path: Path, text: str) -> _Rows:
    lines = (line.strip() for line in text.splitlines())
    kept = [line for line in lines if line and not line.startswith(("#", "%"))]
    if any("," in line and _DECIMAL_COMMAS.fullmatch(line) for line in kept):
        raise InputFileError(path, "expected decimal points, got decimal commas")
    separator = next((mark for mark in ";,\t" if kept and mark in kept[0]), None)
    try:
        rows = [*csv.reader(kept, delimiter=separator)] if separator else [line.split() for line in kept]
    except csv.Error as error:
        raise InputFileError(path, f"expected microphones as XML, CSV or JSON: {error}") from error
    cells = [[cell.strip() for cell in row] for row in rows]
    columns, names, unit_m = _csv_columns(path, cells)
    cells = cells[unit_m is not None :]
    labels = [row[names] if names is not None and names < len(row) else "" for row in cells]
    # Labels with a decimal point are gains and not names, so the order of the lines is kept.
    order = range(len(cells)) if any("." in label for label in labels) else by_number(path, labels)
    taken: list[Row] = [[cells[at][c] if c < len(cells[at]) else None for c in columns] for at in order]
    return _Rows(taken, unit_m=unit_m or 1.0)


def _csv_columns(path: Path, cells: list[list[str]]) -> tuple[list[int], int | None, float | None]:
    """Return the columns of x, y and z, the column of names, and a header's unit in metres."""
    first = cells[0] if cells else []
    named = {m[1].lower(): (i, m[2]) for i, cell in enumerate(first) if (m := _HEADER.fullmatch(cell))}
    if len(named) == 3:
        columns = [named[axis][0] for axis in "xyz"]
        units = {(unit or "m").lower() for _, unit in named.values()}
        if len(units) > 1:
            raise InputFileError(path, f"expected one unit of x, y and z, got {', '.join(sorted(units))}")
        names = next((i for i in range(len(first)) if i not in columns), None)
        return columns, names, _UNITS_M[units.pop()]
    numbers = [_number(cell) is not None for cell in first]
    if all(numbers) and len(first) > 3:
        return _numbered(path, cells)
    if numbers in ([True] * 3, [True, True, True, False], [False, True, True, True]):
        names = {3: None, 4: 0 if numbers[-1] else 3}[len(first)]
        return [i for i in range(len(first)) if i != names], names, None
    expected = "microphones as XML, JSON or CSV with the columns x, y, z"
    raise InputFileError(path, f"expected {expected}, got {','.join(first)!r:.60}; {_MATRIX}")


def _numbered(path: Path, cells: list[list[str]]) -> tuple[list[int], int, None]:
    """Return the columns of lines with four numbers, if the first or the last one counts the microphones."""
    counted = [{row[i] for row in cells if len(row) == 4 and row[i].isdecimal()} for i in (0, 3)]
    counts = [i for i, found in zip((0, 3), counted, strict=True) if len(found) == len(cells)]
    if len(counts) == 1:
        return [i for i in range(4) if i != counts[0]], counts[0], None
    way_on = "a header x,y,z,gain states what they are"
    problem = f"expected x, y and z, got {len(cells[0])} numbers per line: {way_on}"
    raise InputFileError(path, f"{problem}; {_TRANSPOSED}" if len(cells) == 3 else problem)


def _odas_rows(path: Path, text: str, begin: int) -> _Rows:
    """Return the microphones of an ODAS configuration without comments."""
    block, used = _GROUPS.match(text, begin), _MAP.search(text)
    rows: list[Row] = [found[1].split(",") for found in _MU.finditer(block[0] if block else "")]
    if block is None or block[0].count("{") != len(rows) or any(len(row) != 3 for row in rows):
        raise InputFileError(path, "expected mics = ( { mu = ( x, y, z ); ... }, ... ) as in ODAS")
    numbers = [one.strip() for one in used[1].split(",")] if used else []
    channels = tuple(int(one) if one.isdecimal() and len(one) < 10 else one for one in numbers)
    return _Rows(rows, channels=channels)


def _json_rows(path: Path, data: bytes) -> _Rows:
    try:
        document = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputFileError(path, f"expected array JSON, but it does not parse: {error}") from error
    held = document if isinstance(document, dict) else {"positions_m": document}
    stated = [unit for unit in _UNITS_M if f"positions_{unit}" in held]
    if len(stated) > 1 or {"unit", "units"} & {*held}:
        raise InputFileError(path, "expected one list, its unit in its name: positions_m, _cm or _mm")
    unit = next(iter(stated), "m")
    rows = held.get(f"positions_{unit}")
    if not isinstance(rows, list) or not all(isinstance(row, list) and len(row) == 3 for row in rows):
        problem = "expected a list of positions [x, y, z], or one as positions_m"
        three = isinstance(rows, list) and len(rows) == 3
        raise InputFileError(path, f"{problem}; {_TRANSPOSED}" if three else problem)
    channels = held.get("channels", [])
    numbers = tuple(channels) if isinstance(channels, list) else (channels,)
    return _Rows(rows, held.get("axes", "base_link"), numbers, _UNITS_M[unit])


def _numbers(path: Path, rows: list[Row]) -> list[list[float]]:
    """Return the coordinates of each microphone; refuse all but finite numbers."""
    found: list[list[float]] = [[] for _ in rows]
    for number, row in enumerate(rows, start=1):
        for axis, value in zip("xyz", row, strict=True):
            if (read := _number(value)) is None:
                problem = f"microphone {number}: expected a finite number as {axis}, got {value!r:.40}"
                raise InputFileError(path, problem)
            found[number - 1].append(read)
    return found


def _number(value: object) -> float | None:
    """Convert text or a JSON value to a finite number; None if it is not one."""
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None
