"""Learning late: what waits until it is known that nobody doubted it."""

from collections import deque
from typing import Generic, TypeVar

Item = TypeVar("Item")


class GuardDelay(Generic[Item]):
    """A queue of hops; each comes out some hops later with the least weight since.

    Examples
    --------
    >>> guard: GuardDelay[str] = GuardDelay(1)
    >>> [guard.push(item, weight) for item, weight in (("a", 1.0), ("b", 0.4), ("c", 0.9))]
    [None, ('a', 0.4), ('b', 0.4)]
    """

    # So a source is not learned in the moments before anybody believes in it.

    def __init__(self, hops: int) -> None:
        self._waiting: deque[Item] = deque()
        self._weights: deque[float] = deque(maxlen=hops + 1)

    def push(self, item: Item, weight: float) -> tuple[Item, float] | None:
        r"""Take a hop with its weight; return the one that has waited long enough.

        .. math:: w'_n = \min(w_n, w_{n+1}, \dots, w_{n + hops})
        """
        self._waiting.append(item)
        self._weights.append(weight)
        if len(self._waiting) < (self._weights.maxlen or 0):
            return None
        return self._waiting.popleft(), min(self._weights)
