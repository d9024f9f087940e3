"""Milliseconds of a call."""

import time
from collections.abc import Callable

Milliseconds = list[float]


def elapsed_ms(call: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Return how long `call` took, milliseconds: by the wall, or by the processor (`time.process_time`).

    Examples
    --------
    >>> elapsed_ms(lambda: None) < 1000.0
    True
    """
    start = clock()
    call()
    return 1e3 * (clock() - start)
