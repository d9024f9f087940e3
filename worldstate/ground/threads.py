"""Work in threads beside the computation, and the channel between two threads."""

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Generic, Self, TypeVar

from .checks import in_range

T = TypeVar("T")


class WorkThread(ABC):
    """A thread that works while its context is open; `close` is called at the end.

    Parameters
    ----------
    close : callable
        Closes what the thread used.
    patience_s : float, optional
        Longest time to wait for the end of the work, seconds; default: as long as it takes.
    """

    def __init__(self, close: Callable[[], object], patience_s: float | None = None) -> None:
        self._close, self._patience_s, self._stopped = close, patience_s, threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join(self._patience_s)
        self._close()

    @abstractmethod
    def _work(self) -> None:
        """Work until `_stopped` is set."""


class BoundedChannel(Generic[T]):
    """Queue of limited length between two threads.

    A sensor cannot wait. If the channel is full, the newest item replaces the oldest, because the state
    describes the present. Lost items are counted.

    Parameters
    ----------
    capacity : int
        Largest number of waiting items, >= 1.

    Attributes
    ----------
    dropped : int
        Number of items lost because they were not taken in time.

    Raises
    ------
    InvalidArgumentError
        If the capacity is below one.

    Examples
    --------
    >>> channel = BoundedChannel(2)
    >>> for number in range(5):
    ...     channel.put(number)
    >>> channel.take_all(), channel.dropped
    ([3, 4], 3)
    """

    def __init__(self, capacity: int) -> None:
        self._items: deque[T] = deque(maxlen=int(in_range("capacity", capacity, 1, 1 << 20)))
        self._changed = threading.Condition()
        self._closed = False
        self._error: BaseException | None = None
        self.dropped = 0

    def put(self, item: T) -> None:
        """Add an item without waiting; after `close` it is ignored."""
        with self._changed:
            if self._closed:
                return
            self.dropped += len(self._items) == self._items.maxlen
            self._items.append(item)
            self._changed.notify()

    def take(self, wait_s: float | None = None) -> T | None:
        """Wait for the oldest item and return it; None if the channel is closed and empty.

        Raises
        ------
        TimeoutError
            If no item arrived within `wait_s` seconds.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._items or self._closed, wait_s):
                raise TimeoutError
            if self._items:
                return self._items.popleft()
            self._raise_failure()
            return None

    @property
    def ended(self) -> bool:
        """Whether the channel is closed and empty."""
        return self._closed and not self._items

    def take_all(self) -> list[T]:
        """Return all waiting items, oldest first, without waiting."""
        with self._changed:
            taken = list(self._items)
            self._items.clear()
            if not taken:
                self._raise_failure()
            return taken

    def take_newest(self, taken: T) -> T:
        """Return the newest waiting item and drop the others; return `taken` if none waits."""
        with self._changed:
            self.dropped += len(self._items)
            newest = self._items.pop() if self._items else taken
            self._items.clear()
            return newest

    def close(self, error: BaseException | None = None) -> None:
        """End the channel; an error is raised in the thread that takes, after the last item."""
        with self._changed:
            self._closed = True
            self._error = self._error or error
            self._changed.notify_all()

    def _raise_failure(self) -> None:
        if self._error is not None:
            raise self._error
