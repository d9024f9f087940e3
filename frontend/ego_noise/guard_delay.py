"""Delay line: each hop leaves after `hops` hops with the minimum weight seen meanwhile."""

from collections import deque
from typing import Generic, TypeVar

Item = TypeVar("Item")


class GuardDelay(Generic[Item]):
    r"""Queue of hops, weighted :math:`w'_n = \min(w_n, \dots, w_{n + hops})` over the guard interval."""

    # Without it a source is learned as noise in the moments before it is detected.

    def __init__(self, hops: int) -> None:
        self._waiting: deque[Item] = deque()
        self._weights: deque[float] = deque(maxlen=hops + 1)

    def push(self, item: Item, weight: float) -> tuple[Item, float] | None:
        """Take a hop with its weight; return the one that leaves the delay, None while it fills."""
        self._waiting.append(item)
        self._weights.append(weight)
        if len(self._waiting) < (self._weights.maxlen or 0):
            return None
        return self._waiting.popleft(), min(self._weights)
