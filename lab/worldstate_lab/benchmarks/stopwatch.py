"""Wall-clock milliseconds of a call."""

import time
from collections.abc import Callable

Milliseconds = list[float]


def elapsed_ms(call: Callable[[], object]) -> float:
    """Return how long `call` took, milliseconds.

    Examples
    --------
    >>> elapsed_ms(lambda: None) < 1000.0
    True
    """
    start = time.perf_counter()
    call()
    return 1e3 * (time.perf_counter() - start)
