"""Independent work in processes, with results in order and independent of the number of processes."""

import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TypeVar

from .errors import WorldstateError

Item = TypeVar("Item")
Result = TypeVar("Result")

GRACE_S = 5.0  # Time to remove unfinished files


def in_processes(
    work: Callable[[Item], Result], items: Sequence[Item], jobs: int
) -> Generator[Result, None, None]:
    """Yield ``work(item)`` for every item, in the order of the items.

    Examples
    --------
    >>> list(in_processes(abs, [-2, 1], jobs=1))
    [2, 1]
    """
    # Processes are spawned, not forked: threads of a numerical library do not survive a fork. joblib (1.6) is
    # not used: after an error or a signal it ends its workers with SIGKILL, so half-written files stay, and
    # the workers of a terminated parent ran for five more minutes.
    if jobs == 1 or len(items) <= 1:
        yield from map(work, items)
        return
    context = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    with ProcessPoolExecutor(min(jobs, len(items)), context, _begin) as pool:
        try:
            with _handled(signal.SIG_IGN, signal.SIGINT):  # This process ends its workers itself
                waiting = deque(pool.submit(_work_or_leave, work, item) for item in items)
            while waiting:
                yield waiting.popleft().result()
        except BrokenProcessPool as error:
            raise WorldstateError("a process ended before its work was done: out of memory?") from error
        except BaseException:
            # After an error, Ctrl-C or SIGTERM, the work of the workers is not needed.
            for worker in set(multiprocessing.active_children()) - others:
                worker.terminate()
            raise


def in_executor(
    executor: Executor, work: Callable[[Item], Result], items: Sequence[Item]
) -> Generator[Result, None, None]:
    """Yield ``work(item)`` from any executor for every item, in the order of the items.

    Examples
    --------
    >>> from concurrent.futures import ThreadPoolExecutor
    >>> with ThreadPoolExecutor(2) as threads:
    ...     list(in_executor(threads, abs, [-2, 1]))
    [2, 1]
    """
    waiting = deque(executor.submit(work, item) for item in items)
    try:
        while waiting:
            yield waiting.popleft().result()
    finally:
        for one in waiting:
            one.cancel()


def _begin() -> None:
    """Prepare a worker to remove unfinished files and end on SIGTERM, and to end with its parent process."""
    # In this order: a signal during `start` would print a traceback.
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGTERM, _terminate)


def _terminate(number: int, frame: object) -> None:
    raise SystemExit(128 + number)


def _end_with_parent() -> None:
    # After a SIGKILL of the parent, no signal reaches the workers: they would wait for work for ever.
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
        # If the signal arrives between two items, the pool treats it as an error of the last item and waits
        # for a next item, which never comes: in about one of twenty runs a worker did not end.
        time.sleep(GRACE_S)
        os._exit(128 + signal.SIGTERM)


def _work_or_leave(work: Callable[[Item], Result], item: Item) -> Result:
    """Do the work; on SIGTERM remove unfinished files and end, since the pool would take the next item."""
    try:
        return work(item)
    except SystemExit:
        os._exit(128 + signal.SIGTERM)


@contextmanager
def _handled(handler: Callable[[int, object], object] | signal.Handlers, *numbers: int) -> Iterator[None]:
    """Handle signals by a function while the block runs; outside the main thread nothing changes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) or signal.SIG_DFL for number in numbers}
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


@contextmanager
def deferred_signals() -> Iterator[None]:
    """Delay SIGINT and SIGTERM until all files that belong together are written."""
    # Signals are not blocked, because a blocked one would reach another thread of the process, and its
    # handler runs in the main thread anyway.
    arrived: list[int] = []
    try:
        with _handled(lambda number, _: arrived.append(number), signal.SIGINT, signal.SIGTERM):
            yield
    finally:
        for late in arrived:
            signal.raise_signal(late)
