"""Wall-clock milliseconds of a call."""

import time
from collections.abc import Callable, Sequence
from itertools import pairwise

Milliseconds = list[float]
now = time.perf_counter


def elapsed_ms(call: Callable[[], object]) -> float:
    """Return how long `call` took, milliseconds.

    Examples
    --------
    >>> elapsed_ms(lambda: None) < 1000.0
    True
    """
    start = now()
    call()
    return 1e3 * (now() - start)


def marks_to_ms(marks_s: Sequence[float]) -> Milliseconds:
    """Return the differences of consecutive clock readings, milliseconds.

    Examples
    --------
    >>> marks_to_ms([0.0, 0.5, 0.75])
    [500.0, 250.0]
    """
    return [1e3 * (b - a) for a, b in pairwise(marks_s)]
