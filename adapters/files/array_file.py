"""Microphone arrays in the XML that Acoular reads: ``<MicArray><pos Name= x= y= z= /></MicArray>``."""

import math
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import defusedxml.ElementTree as SafeElementTree
import numpy as np
from defusedxml.common import DefusedXmlException

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.ground.typing import FloatArray

from .atomic import write_text

MAX_BYTES = 1 << 20
MAX_MICROPHONES = 1024
# Wider than this and the file was written in millimetres.
MAX_APERTURE_M = 100.0


def read_array_xml(path: str | Path) -> MicrophoneArray:
    r"""Read an array from Acoular XML, turned into `base_link` axes.

    In the file x grows to the right in the array plane, y up, and z along the look direction, metres, so that

    .. math:: (x, y, z)_{base} = (z, -x, y)_{file}

    Parameters
    ----------
    path : str or Path
        The file; at most 1 MiB and 1024 microphones, in the order of the recording's channels.

    Returns
    -------
    MicrophoneArray
        Positions of shape (M, 3), metres, x forward, y left, z up.

    Raises
    ------
    InputFileError
        If the file is missing, too large, no XML, has a document type or entities, holds fewer than two
        microphones, or a coordinate is missing, no number, not finite, or in another unit than the metre.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     name = Path(folder) / "pair.xml"
    ...     write_array_xml(name, MicrophoneArray(np.array([[0.0, 0.2, 0.0], [0.0, -0.2, 0.0]])))
    ...     read_array_xml(name).positions_m[:, 1]
    array([ 0.2, -0.2])
    """
    name = Path(path)
    elements = _parse(name).findall("pos")
    if not 2 <= len(elements) <= MAX_MICROPHONES:
        problem = f"expected 2 to {MAX_MICROPHONES} <pos x= y= z= /> below the root, got {len(elements)}"
        raise InputFileError(name, problem)
    in_file = np.array([_coordinates(name, number, e) for number, e in enumerate(elements, start=1)])
    _check_aperture(name, in_file)
    try:
        return MicrophoneArray(_to_base_link(in_file))
    except InvalidArgumentError as error:
        raise InputFileError(name, str(error)) from error


def write_array_xml(path: str | Path, array: MicrophoneArray, name: str = "array") -> None:
    """Write an array as Acoular XML, whole or not at all; `read_array_xml` gives the same numbers back.

    Parameters
    ----------
    path : str or Path
        Where to write.
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
    rows = [
        f'    <pos Name="Point {number}" x="{x!r}" y="{y!r}" z="{z!r}" />'
        for number, (x, y, z) in enumerate(_to_file(array.positions_m).tolist(), start=1)
    ]
    head = f'<?xml version="1.0" encoding="utf-8"?>\n<MicArray name={quoteattr(name)}>'
    write_text(path, "\n".join([head, *rows, "</MicArray>", ""]))


def _parse(path: Path) -> Any:
    try:
        with path.open("rb") as file:
            text = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputFileError(path, f"expected an array XML file ({error.strerror})") from error
    if len(text) > MAX_BYTES:
        raise InputFileError(path, f"expected an array XML file of at most {MAX_BYTES} bytes")
    try:
        return SafeElementTree.fromstring(text, forbid_dtd=True)
    except DefusedXmlException as error:
        problem = "expected plain XML, got a document type or entities, which are refused"
        raise InputFileError(path, problem) from error
    except (SafeElementTree.ParseError, ValueError, LookupError) as error:
        raise InputFileError(path, f"expected array XML, it does not parse: {error}") from error


def _coordinates(path: Path, number: int, element: Any) -> list[float]:
    return [_coordinate(path, number, axis, element.get(axis)) for axis in ("x", "y", "z")]


def _coordinate(path: Path, number: int, axis: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputFileError(path, f"microphone {number}: expected a finite number as {axis}, got {text!r}")
    return value


def _check_aperture(path: Path, positions_m: FloatArray) -> None:
    aperture_m = float(np.ptp(positions_m, axis=0).max())
    if aperture_m > MAX_APERTURE_M:
        problem = f"expected positions in metres, got an array {aperture_m:g} wide: millimetres?"
        raise InputFileError(path, problem)


def _to_base_link(in_file: FloatArray) -> FloatArray:
    return in_file[:, [2, 0, 1]] * [1.0, -1.0, 1.0] + 0.0


def _to_file(in_base_link: FloatArray) -> FloatArray:
    return in_base_link[:, [1, 2, 0]] * [-1.0, 1.0, 1.0] + 0.0
