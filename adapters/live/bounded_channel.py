"""What a sensor's thread hands over to the thread that computes; the oldest is dropped where it is full."""

import threading
from collections import deque
from typing import Generic, TypeVar

from worldstate.ground.checks import in_range

T = TypeVar("T")


class BoundedChannel(Generic[T]):
    """Queue of limited length between two threads.

    A sensor cannot wait: when nobody takes what it gives, the oldest item makes room for the newest, because
    the state is about now. Every item lost is counted.

    Parameters
    ----------
    capacity : int
        Largest number of items that wait, >= 1.

    Attributes
    ----------
    dropped : int
        Items that were lost because nobody took them in time.

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
        self._capacity = int(in_range("capacity", capacity, 1, 1 << 20))
        self._items: deque[T] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._error: BaseException | None = None
        self.dropped = 0

    def put(self, item: T) -> None:
        """Hand an item over; never waits. After the end nothing is taken any more."""
        with self._changed:
            if self._closed:
                return
            if len(self._items) == self._capacity:
                self._items.popleft()
                self.dropped += 1
            self._items.append(item)
            self._changed.notify()

    def take(self) -> T | None:
        """Wait for the oldest item and return it; None once the channel is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._closed)
            if self._items:
                return self._items.popleft()
            self._raise_failure()
            return None

    def take_all(self) -> list[T]:
        """Return all that waits, the oldest first, without waiting."""
        with self._changed:
            taken = list(self._items)
            self._items.clear()
            if not taken:
                self._raise_failure()
            return taken

    def close(self, error: BaseException | None = None) -> None:
        """Say that nothing more comes; an error is raised at whoever takes, once nothing waits."""
        with self._changed:
            self._closed = True
            self._error = self._error or error
            self._changed.notify_all()

    def _raise_failure(self) -> None:
        if self._error is not None:
            raise self._error
