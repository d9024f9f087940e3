"""One BLAS thread for small matrices."""

from contextlib import AbstractContextManager
from functools import lru_cache
from typing import Any

from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]


def one_blas_thread() -> AbstractContextManager[Any]:
    """Keep BLAS on the calling thread while inside; afterwards as it was."""
    # The front-end multiplies thousands of small matrices a second. A second BLAS thread gains nothing there,
    # and where other programs keep the processor busy every product would wait for it to be scheduled
    # (measured on two busy cores: four times the processor time). It also keeps results the same bit for bit
    # on any number of cores. The limit is the process's: products that other threads of the host begin
    # meanwhile, about a millisecond in a hundred, run on one thread too. It costs 16 microseconds.
    return _controller().limit(limits=1)  # type: ignore[no-any-return]


@lru_cache(maxsize=1)
def _controller() -> Any:
    """Look for the libraries once: that costs a millisecond."""
    return ThreadpoolController().select(user_api="blas")
