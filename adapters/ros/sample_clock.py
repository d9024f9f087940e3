"""Samples are the clock of sound that comes in messages: their stamps only show what was lost."""

from bisect import insort
from collections import deque
from collections.abc import Sequence

import numpy as np

from worldstate.ground.typing import FloatArray, IntArray

# A delay that later messages make up for within so long is jitter, a burst or a stall of the recorder.
CATCH_UP_NS = 30_000_000_000
# Of the last messages nothing follows that could catch up: what is lost there is not known.
_LEAST_AFTER_NS = 500_000_000
# Messages whose delays the next ones are compared with: enough to leave out single early stamps.
_BEFORE, _LEAST_BEFORE, _EARLY = 200, 3, 0.1
# So many later messages show the least delay well; of fewer all have to be later than any before.
_FEW_AFTER = 50
# Stamps that go back by more, and stay, begin again: a bag that was played in a loop.
_AGAIN_NS, _AGAIN = 2_000_000_000, 5
# Stamps that span less of the samples are no clock, such as those that are all the same.
_LEAST_SPAN = 0.05
# Of another rate every piece of a recording is too long, of a stall some are.
_PIECES, _TOO_LONG = 8, 0.25


def lost_before(stamps_ns: IntArray, lengths_ns: FloatArray) -> FloatArray:
    """Return how much was lost before each message, ns.

    The delay of message k is d_k = s_k - sum of the lengths before it. Before k a loss is

        min_{j >= k} d_j - usual(d_i, i < k)

    if the minimum is more than half a message above the median of the d_i. The minimum is over the next 30 s,
    and *usual* is the delay that one in ten of the last messages is below. A delay that is made up for does
    not count, nor does a stamp that is not above the one before it.

    Parameters
    ----------
    stamps_ns, lengths_ns : ndarray
        Time of the first sample of each message, and the length of its samples; shape (n,).

    Returns
    -------
    ndarray
        Shape (n,), 0 where nothing is missing.

    Examples
    --------
    >>> bursts = np.array([0, 1, 2, 30, 31, 32] * 10) + np.repeat(np.arange(10), 6) * 60
    >>> float(lost_before(bursts * 10**6, np.full(60, 1e7)).sum())
    0.0
    >>> kept = np.delete(np.arange(200), 50)
    >>> np.flatnonzero(lost_before(kept * 10**7, np.full(199, 1e7)))
    array([50])
    """
    begins = np.cumsum(lengths_ns) - lengths_ns
    delays, increasing = stamps_ns - stamps_ns[0] - begins, _increasing(stamps_ns)
    coming, end = _least_to_come(begins, np.where(increasing, delays, np.inf)), begins[-1] + lengths_ns[-1]
    lost, total, before = np.zeros(len(begins)), 0.0, _Recent()
    for k, (late, begin) in enumerate(zip(coming, begins, strict=True)):
        usual = before.delay(_EARLY)
        share = 0.5 if len(begins) - k > _FEW_AFTER else 1.0
        limit = max(usual, before.delay(share)) + 0.5 * min(lengths_ns[k], lengths_ns[k - 1])
        if limit < late - total < np.inf and end - begin >= _LEAST_AFTER_NS:
            lost[k] = late - total - usual
            total += lost[k]
        if increasing[k]:
            before.add(delays[k] - total)
    return lost


def early_ns(stamps_ns: IntArray, lengths_ns: FloatArray) -> float:
    """Return by how much the first sample is earlier than its stamp, as later messages show, ns."""
    begins = np.cumsum(lengths_ns) - lengths_ns
    delays = np.where(_increasing(stamps_ns), stamps_ns - stamps_ns[0] - begins, np.inf)
    early = -float(delays[begins <= CATCH_UP_NS].min())
    return early if early > 0.5 * lengths_ns[0] else 0.0


def begins_again(stamps_ns: IntArray, lengths_ns: FloatArray) -> list[tuple[int, int]]:
    """Return the messages from which on stamps begin again, each with what has to be added to them, ns.

    Examples
    --------
    >>> twice = np.tile(np.arange(30) * 10**8, 2)
    >>> begins_again(twice, np.full(60, 1e8))
    [(30, 3000000000)]
    """
    found, added = list[tuple[int, int]](), 0
    for k in np.flatnonzero(np.diff(stamps_ns) < -_AGAIN_NS) + 1:
        before, after = stamps_ns[max(k - _AGAIN, 0) : k], stamps_ns[k : k + _AGAIN]
        if after.max() < before.min() - _AGAIN_NS:
            added += int(stamps_ns[k - 1] - stamps_ns[k]) + round(lengths_ns[k - 1])
            found.append((int(k), added))
    return found


def contradiction(stamps_ns: IntArray, lengths_ns: FloatArray, lost_ns: FloatArray) -> str:
    """Return how stamps and samples contradict each other as a whole, empty where they do not."""
    sent_ns, span_ns = float(lengths_ns.sum()), _span_ns(stamps_ns, lengths_ns)
    more = max(_LEAST_SPAN * sent_ns, 1.0) < span_ns < min(sent_ns - _AGAIN_NS, (1.0 - _TOO_LONG) * sent_ns)
    pieces = np.array_split(np.arange(len(stamps_ns)), min(_PIECES, len(stamps_ns)))
    # Losses before most messages are no losses but another rate.
    if (lost_ns > 0.0).mean() > 0.5 or (more and all(_is_long(stamps_ns[k], lengths_ns[k]) for k in pieces)):
        return f"stamps advance by {1e-9 * span_ns:.1f} s while {1e-9 * sent_ns:.1f} s of samples were sent"
    return ""


def _is_long(stamps_ns: IntArray, lengths_ns: FloatArray) -> bool:
    """Whether samples are longer than their stamps span."""
    return _span_ns(stamps_ns, lengths_ns) < (1.0 - _TOO_LONG) * float(lengths_ns.sum())


def _span_ns(stamps_ns: IntArray, lengths_ns: FloatArray) -> float:
    return float(np.ptp(stamps_ns[_increasing(stamps_ns)]) + lengths_ns[-1])


def _increasing(stamps_ns: IntArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    return np.concatenate([[True], np.diff(stamps_ns) > 0])


def _least_to_come(begins_ns: FloatArray, delays_ns: Sequence[float] | FloatArray) -> FloatArray:
    """Return the least of each delay and those of what begins within the next 30 s."""
    least, rising = np.empty(len(begins_ns)), deque[int]()
    for k in range(len(begins_ns) - 1, -1, -1):
        while rising and delays_ns[rising[0]] >= delays_ns[k]:
            rising.popleft()
        rising.appendleft(k)
        while begins_ns[rising[-1]] > begins_ns[k] + CATCH_UP_NS:
            rising.pop()
        least[k] = delays_ns[rising[-1]]
    return least


class _Recent:
    """The delays of the last messages, in order of time and sorted."""

    def __init__(self) -> None:
        self._last, self._sorted = deque[float](), list[float]()

    def add(self, delay_ns: float) -> None:
        self._last.append(delay_ns)
        insort(self._sorted, delay_ns)
        if len(self._last) > _BEFORE:
            self._sorted.remove(self._last.popleft())

    def delay(self, share: float) -> float:
        """Return the delay that so many are below, but for the least one; none where there are few."""
        count = len(self._sorted)
        place = min(max(1, int(share * count)), count - 1)
        return self._sorted[place] if count >= _LEAST_BEFORE else np.inf
