"""Checks for the public boundary: values are checked once there and trusted inside.

Every message contains the argument, its value and the expected value.
"""

import math
import sys
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any, TypeVar, get_args

import numpy as np
from numpy.typing import ArrayLike

from .errors import InvalidArgumentError
from .typing import ComplexArray, FloatArray

T = TypeVar("T")
# Limits of a range that excludes zero, one or infinity.
ABOVE_ZERO, BELOW_ONE, MOST = math.ulp(0.0), math.nextafter(1.0, 0.0), sys.float_info.max


def finite_array(name: str, value: ArrayLike, shape: Sequence[int | None]) -> FloatArray:
    """Return `value` as finite float64 of the given shape; `None` allows any length of an axis.

    Examples
    --------
    >>> finite_array("position_m", [1, 2, 3], (3,))
    array([1., 2., 3.])
    """
    try:
        # With `dtype`, numpy would also read numbers written as text.
        array = np.asarray(value).astype(np.float64, casting="same_kind", copy=False)
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidArgumentError(f"{name}: expected numbers, got {type(value).__name__}") from error
    if array.shape != shape:
        check_shape(name, array.shape, shape)
    if not np.isfinite(array).all():
        raise InvalidArgumentError(f"{name}: expected finite numbers, got NaN or infinity")
    return array


def finite_complex(name: str, value: ArrayLike, shape: Sequence[int | None]) -> ComplexArray:
    """Return `value` as finite complex numbers of the given shape; single precision is kept.

    Examples
    --------
    >>> finite_complex("spectra", [[1, 1j]], (None, 2)).shape
    (1, 2)
    """
    try:
        array = np.asarray(value)
    except ValueError as error:  # Rows of different lengths
        raise InvalidArgumentError(f"{name}: expected numbers, got {type(value).__name__}") from error
    if array.dtype.kind not in "biufc":
        raise InvalidArgumentError(f"{name}: expected numbers, got {array.dtype}")
    check_shape(name, array.shape, shape)
    if not np.isfinite(array).all():
        raise InvalidArgumentError(f"{name}: expected finite numbers, got NaN or infinity")
    single = array.dtype in (np.complex64, np.float32)
    return array.astype(np.complex64 if single else np.complex128, copy=False)


def check_shape(name: str, got: tuple[int, ...], expected: Sequence[int | None]) -> None:
    """Raise an error for a wrong shape; `None` in `expected` allows any length of an axis.

    Examples
    --------
    >>> check_shape("block", (4800, 56), (None, 56))
    """
    as_expected = [e in (None, g) for g, e in zip(got, expected, strict=False)]
    if len(got) != len(expected) or False in as_expected:
        wanted = ", ".join("any" if e is None else str(e) for e in expected)
        raise InvalidArgumentError(f"{name}: expected shape ({wanted}), got {got}")


def freeze_arrays(instance: object, **shapes: Sequence[int | None]) -> None:
    """Replace the given arrays of a frozen dataclass by checked, read-only copies."""
    for name, shape in shapes.items():
        value = finite_array(name, getattr(instance, name), shape).copy()
        value.flags.writeable = False
        object.__setattr__(instance, name, value)


def in_range(
    name: str, value: float, low: float, high: float, *, open_low: bool = False, open_high: bool = False
) -> float:
    """Return `value` as a float if it is in the range; ends are included unless they are open.

    Examples
    --------
    >>> in_range("alpha", 0.02, 0, 1, open_low=True)
    0.02
    >>> in_range("std_rad", 0.0, ABOVE_ZERO, 3.2)
    Traceback (most recent call last):
        ...
    worldstate...InvalidArgumentError: std_rad: expected a number in (0.0, 3.2], got 0.0
    """
    if type(value) is float and low < value < high:  # The usual case
        return value
    try:
        number = math.ldexp(value, 0)  # Like `float`, but it does not read text
    except (TypeError, OverflowError) as error:
        raise InvalidArgumentError(f"{name}: expected a number, got {type(value).__name__}") from error
    if not math.isfinite(number):
        raise InvalidArgumentError(f"{name}: expected a finite number, got {number}")
    below = number <= low if open_low else number < low
    above = number >= high if open_high else number > high
    if below or above:
        start = "(0.0" if low == ABOVE_ZERO else f"{'(' if open_low else '['}{low}"
        end = "1.0)" if high == BELOW_ONE else f"{high}{')' if open_high else ']'}"
        raise InvalidArgumentError(f"{name}: expected a number in {start}, {end}, got {number}")
    return number


def check_ranges(instance: object, **ranges: tuple[float, float]) -> None:
    """Raise an error for fields of a dataclass outside their ranges, ends included; no value is changed.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> check_ranges(SimpleNamespace(speed_mps=8.0, stop_s=4), speed_mps=(0.0, 20.0), stop_s=(0.0, 120.0))
    """
    for name, (low, high) in ranges.items():
        in_range(name, getattr(instance, name), low, high)


def pair(name: str, value: ArrayLike, largest: float) -> tuple[float, float]:
    """Return two numbers with absolute values of at most `largest`.

    Examples
    --------
    >>> pair("position_m", [3, -4.5], largest=1e4)
    (3.0, -4.5)
    """
    first, second = finite_array(name, value, (2,)).tolist()
    first = in_range(f"{name}[0]", first, -largest, largest)
    return first, in_range(f"{name}[1]", second, -largest, largest)


def one_of(name: str, value: str, expected: Iterable[str]) -> str:
    """Return `value` if it is one of the expected words.

    Examples
    --------
    >>> one_of("side", "left", ("left", "right"))
    'left'
    """
    if value not in (words := tuple(expected)):
        raise InvalidArgumentError(f"{name}: expected one of {', '.join(words)}, got {value!r:.40}")
    return value


def named(name: str, value: object) -> None:
    """Raise an error unless the value is a text that is not empty.

    Examples
    --------
    >>> named("source", "radar")
    """
    if (type(value) is not str and not isinstance(value, str)) or not value:
        raise InvalidArgumentError(f"{name}: expected a name, got {value!r:.40}")


def check_fields(instance: object, **expected: Any) -> None:
    """Raise an error for a field that does not have the expected type, or is outside the expected range.

    A tuple gives a range; one that ends with None also allows None. Numbers are converted to Python's own
    types.

    Examples
    --------
    >>> from dataclasses import make_dataclass
    >>> check_fields(make_dataclass("Box", ["score"], frozen=True)(1.5), score=(0.0, 1.0))
    Traceback (most recent call last):
        ...
    worldstate.ground.errors.InvalidArgumentError: score: expected a number in [0.0, 1.0], got 1.5
    """
    for name, wanted in expected.items():
        value, is_range = getattr(instance, name), type(wanted) is tuple
        # The usual case. NaN compares false, and numpy's float64 is a float of another type.
        if is_range:
            if type(value) is float and wanted[0] <= value <= wanted[1]:
                continue
        elif type(value) in _types(wanted):
            continue
        if isinstance(value, np.generic):
            value = value.item()
            object.__setattr__(instance, name, value)
        if is_range:
            if value is not None or wanted[-1] is not None:
                object.__setattr__(instance, name, in_range(name, value, *wanted[:2]))
        elif not isinstance(value, wanted):
            raise InvalidArgumentError(f"{name}: expected {_called(wanted)}, got {_shown(value)}")


@cache
def _types(kind: Any) -> frozenset[type]:
    """Return the types of a union, or the single type: `isinstance` with a union is slow."""
    return frozenset(get_args(kind) or (kind,))


def all_of(name: str, values: object, kind: type[T], most: int = 64) -> tuple[T, ...]:
    """Return the values as a tuple if they are at most `most`, and all of one type.

    Examples
    --------
    >>> all_of("sides", ["left", "right"], str, most=2)
    ('left', 'right')
    """
    if type(values) is tuple and not values:
        return ()
    if not isinstance(values, list | tuple):
        raise InvalidArgumentError(f"{name}: expected {kind.__name__}s in a tuple, got {_shown(values)}")
    if len(values) > most:
        raise InvalidArgumentError(f"{name}: expected at most {most}, got {len(values)}")
    for i, one in enumerate(values):
        if type(one) is not kind and not isinstance(one, kind):
            raise InvalidArgumentError(f"{name}[{i}]: expected {kind.__name__}, got {_shown(one)}")
    return tuple(values)


def _called(kind: Any) -> str:
    return " or ".join(one.__name__ for one in get_args(kind) or (kind,)).replace("NoneType", "None")


def _shown(value: object) -> str:
    # An integer with thousands of digits cannot be converted to text.
    return type(value).__name__ if isinstance(value, int) and abs(value) >= 1 << 63 else f"{value!r:.40}"


def host_and_port(name: str, address: str, lowest: int = 0) -> tuple[str, int]:
    """Split HOST:PORT.

    Examples
    --------
    >>> host_and_port("--odometry", "127.0.0.1:9100")
    ('127.0.0.1', 9100)
    """
    host, _, port = address.rpartition(":")
    if not (host and port.isdecimal() and len(port) < 6 and lowest <= int(port) < 1 << 16):
        raise InvalidArgumentError(f"{name}: expected HOST:PORT, got {address!r:.60}")
    return host, int(port)
