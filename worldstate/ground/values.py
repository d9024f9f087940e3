"""Small values and functions for all packages."""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cache
from numbers import Integral
from operator import attrgetter
from typing import Any, Literal, TypeAlias, TypeVar

import numpy as np

from .checks import check_fields
from .errors import InvalidArgumentError
from .typing import FloatArray, IndexArray

# A float gives a float, an array gives an array.
T = TypeVar("T")
RealT = TypeVar("RealT", float, FloatArray)

# Last answer of a co-evidence channel about an entity: found, searched for and not found, not searched for.
Answer: TypeAlias = Literal["visible", "absent", "unqueried"]

# If a smaller share of hidden vehicles would be noticed, the hop is not used as evidence.
LEAST_HEARD = 0.2

# Keeps logarithms and quotients finite if a probability or a share is zero.
TINY = 1e-12
# Log-odds of certainty: e^-20 corresponds to one hop in 1.5 years.
CERTAIN_NATS = 20.0

_TURN = 2.0 * math.pi
NANOSECONDS_PER_SECOND = 1_000_000_000
SECONDS_PER_HOUR = 3600.0
# Limit of signed 64 bits less one hour, because later times, such as the end of an advisory, are written too.
_MOST_NS = (1 << 63) - 3600 * NANOSECONDS_PER_SECOND


@dataclass(frozen=True, slots=True)
class NotUsable:
    """A requested estimate that is not available, with the reason.

    It is neither zero nor missing: a fusion must marginalise over the quantity.

    Parameters
    ----------
    reason : str
        Why it is not available.

    Examples
    --------
    >>> NotUsable("no stable tone")
    NotUsable(reason='no stable tone')
    """

    reason: str

    def __post_init__(self) -> None:
        check_fields(self, reason=str)


def falling(value: float, between: tuple[float, float]) -> float:
    """Return 1 below the first of two values, 0 above the second, linear between them.

    Examples
    --------
    >>> [falling(value, (6.0, 12.0)) for value in (3.0, 9.0, 20.0)]
    [1.0, 0.5, 0.0]
    """
    low, high = between
    return min(max((high - value) / (high - low), 0.0), 1.0)


@cache
def _fields_of(cls: Any) -> tuple[tuple[str, ...], Callable[[Any], tuple[Any, ...]]]:
    names = tuple(one.name for one in fields(cls) if one.init)
    return names, attrgetter(*names, names[0])  # A single name would give no tuple


def replaced(value: T, /, **changes: Any) -> T:
    """Return a dataclass with some fields changed, like `dataclasses.replace` but without a call per field.

    Examples
    --------
    >>> replaced(NotUsable("no peak"), reason="silence")
    NotUsable(reason='silence')
    """
    cls: Any = type(value)
    names, values = _fields_of(cls)
    changed: T = cls(**dict(zip(names, values(value), strict=False)) | changes)
    return changed


def mean(values: np.ndarray, axis: int | None = None, dtype: Any = None) -> Any:
    """Return the arithmetic mean, equal to `numpy.mean` to the bit, in two calls instead of nine.

    Examples
    --------
    >>> mean(np.array([[1.0, 2.0], [3.0, 6.0]]), 0), mean(np.array([1.0, 2.0]))
    (array([2., 4.]), np.float64(1.5))
    """
    total = np.add.reduce(values, axis=axis, dtype=dtype)
    return total / (values.size / total.size)


def median(values: np.ndarray) -> Any:
    """Return the median over the last axis without NaN, like `numpy.median` in a tenth of its calls.

    Examples
    --------
    >>> median(np.array([[3.0, 1.0, 2.0], [5.0, 4.0, 6.0]])), median(np.array([1.0, 4.0]))
    (array([2., 5.]), np.float64(2.5))
    """
    ordered, half = values.copy(), values.shape[-1] // 2
    ordered.sort()
    middle = ordered[..., half]
    return middle if values.shape[-1] % 2 else (ordered[..., half - 1] + middle) / 2


@cache
def _parts(size: int, parts: int) -> tuple[IndexArray, IndexArray]:
    counts = np.array([len(one) for one in np.array_split(np.arange(size), parts)])
    return np.cumsum(counts) - counts, counts


def part_means(values: FloatArray, parts: int) -> FloatArray:
    """Return means over neighbours along the last axis, in the parts of `numpy.array_split`.

    Examples
    --------
    >>> part_means(np.array([[1.0, 3.0, 5.0, 8.0]]), 2)
    array([[2. , 6.5]])
    """
    starts, counts = _parts(values.shape[-1], parts)
    return np.asarray(np.add.reduceat(values, starts, axis=-1) / counts)


def significant(values: FloatArray, figures: int) -> FloatArray:
    """Round to some significant figures, which makes files of coefficients shorter.

    Examples
    --------
    >>> significant(np.array([1234.5678, 0.00012345678]), 3)
    array([1.23e+03, 1.23e-04])
    """
    rounded = [float(f"{value:.{figures}g}") for value in values.ravel().tolist()]
    return np.array(rounded).reshape(values.shape)


def wrap_angle(angle_rad: RealT) -> RealT:
    """Wrap an angle in radians into (-pi, pi].

    Parameters
    ----------
    angle_rad : float or ndarray, any shape
        Radians.

    Returns
    -------
    float or ndarray, same shape
        Radians.

    Examples
    --------
    >>> round(wrap_angle(3 * np.pi / 2), 3), wrap_angle(-np.pi) == np.pi
    (-1.571, True)
    """
    if type(angle_rad) is float or isinstance(angle_rad, float):
        # Ten times as fast as an array of one angle; a step of the filter wraps hundreds of single angles.
        return math.pi - (math.pi - float(angle_rad)) % _TURN % _TURN
    # Applied twice: for the smallest negative number the first result is rounded to a whole turn.
    wrapped = np.pi - (np.pi - np.asarray(angle_rad, dtype=np.float64)) % _TURN % _TURN
    return wrapped if wrapped.ndim else float(wrapped)  # type: ignore[return-value]


def vertex(left: float, middle: float, right: float) -> float:
    """Return the vertex of a parabola through three points, in steps from the second; 0 without a maximum.

    Examples
    --------
    >>> vertex(0.0, 1.0, 0.5), vertex(1.0, 0.0, 1.0)
    (0.16666666666666666, 0.0)
    """
    bend = left - 2.0 * middle + right
    return 0.5 * (left - right) / bend if bend < 0.0 else 0.0


def seconds(stamp_ns: int) -> float:
    """Convert integer nanoseconds to seconds.

    Parameters
    ----------
    stamp_ns : int
        Nanoseconds.

    Returns
    -------
    float
        Seconds.

    Examples
    --------
    >>> seconds(1_500_000_000)
    1.5
    """
    return stamp_ns / NANOSECONDS_PER_SECOND


def nanoseconds(time_s: float) -> int:
    """Convert seconds to the nearest integer nanosecond.

    Parameters
    ----------
    time_s : float
        Seconds.

    Returns
    -------
    int
        Nanoseconds.

    Examples
    --------
    >>> nanoseconds(1.5)
    1500000000
    """
    time_ns = time_s * NANOSECONDS_PER_SECOND
    if not abs(time_ns) < 1 << 63:  # Also true of NaN
        raise InvalidArgumentError(f"time: expected nanoseconds of 64 bits, got {time_s:g} s")
    return round(time_ns)


def integer_ns(name: str, value: object) -> int:
    """Return a time stamp as a Python integer, at least one hour within the limits of signed 64 bits.

    Examples
    --------
    >>> integer_ns("stamp_ns", 5)
    5
    """
    if type(value) is int and -_MOST_NS <= value <= _MOST_NS:
        return value
    # NaN and infinity would pass comparisons and stay in the belief.
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise InvalidArgumentError(f"{name}: expected integer nanoseconds, got {value!r:.40}")
    if abs(int(value)) > _MOST_NS:
        raise InvalidArgumentError(f"{name}: expected integer nanoseconds of 64 bits, got a larger number")
    return int(value)
