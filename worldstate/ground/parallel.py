"""Parallel map over processes; results are in order and do not depend on the number of processes."""

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_processes(work: Callable[[Item], Result], items: Sequence[Item], jobs: int) -> Iterator[Result]:
    """Yield ``work(item)`` for every item, in the order of the items.

    Examples
    --------
    >>> list(in_processes(abs, [-2, 1], jobs=1))
    [2, 1]
    """
    # Processes are spawned, not forked: threads of a numerical library do not survive a fork.
    if jobs == 1 or len(items) <= 1:
        yield from map(work, items)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(jobs, len(items)), mp_context=context) as pool:
        yield from pool.map(work, items)
