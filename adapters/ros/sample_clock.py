"""Clock of sound in messages: the samples give the time, and the stamps only reveal losses."""

import numpy as np

from worldstate.ground.typing import FloatArray, IntArray

# A delay that later messages recover within this time is jitter, a burst or a stall of the recorder.
CATCH_UP_NS = 30_000_000_000
# No messages after the last ones could show that a delay is recovered, so losses there are unknown.
_LEAST_AFTER_NS = 500_000_000
# Number of messages with which a delay is compared, its minimum, and the share of early stamps that is
# ignored.
_BEFORE, _LEAST_BEFORE, _EARLY = 200, 3, 0.1
# A loss is found if the least delay of the later messages exceeds the median of the earlier delays. With
# fewer later messages than this, it must exceed the largest of them.
_FEW_AFTER = 50
# If stamps go back by more than this for so many messages, they start again, as of a bag played in a loop.
_AGAIN_NS, _AGAIN = 2_000_000_000, 5
# Stamps that span a smaller share of the samples, such as equal stamps, cannot be used as a clock.
_LEAST_SPAN = 0.05
# With a wrong rate, every piece of a recording is longer than the span of its stamps; with a stall, only some
# pieces are.
_PIECES, _LONG_SHARE = 8, 0.75


def lost_before(stamps_ns: IntArray, lengths_ns: FloatArray) -> tuple[FloatArray, float]:
    """Return the loss before each message, and by how much the first stamp is too late, ns.

    The delay of message k is d_k = s_k - sum of the lengths before it. The loss before k is

        min_{j >= k} d_j - usual(d_i, i < k)

    if the minimum is more than half a message above the median of the d_i. The minimum is over the next 30 s,
    and *usual* is the 10 % quantile of the delays of the last messages. A delay that is recovered is ignored,
    and so is a stamp that is not above the previous one.

    Parameters
    ----------
    stamps_ns, lengths_ns : ndarray
        Time of the first sample of each message, and the length of its samples; shape (n,).

    Returns
    -------
    ndarray
        Shape (n,), 0 if nothing is missing.
    float
        0 if below half a message.

    Examples
    --------
    >>> bursts = np.array([0, 1, 2, 30, 31, 32] * 10) + np.repeat(np.arange(10), 6) * 60
    >>> float(lost_before(bursts * 10**6, np.full(60, 1e7))[0].sum())
    0.0
    >>> kept = np.delete(np.arange(200), 50)
    >>> np.flatnonzero(lost_before(kept * 10**7, np.full(199, 1e7))[0])
    array([50])
    """
    from scipy.ndimage import minimum_filter1d

    begins = np.cumsum(lengths_ns) - lengths_ns
    increasing = np.concatenate([[True], np.diff(stamps_ns) > 0])
    delays = np.where(increasing, stamps_ns - stamps_ns[0] - begins, np.inf)
    window = min(int(CATCH_UP_NS / lengths_ns.mean()) + 1, len(begins))
    coming = minimum_filter1d(delays, window, mode="constant", cval=np.inf, origin=-(window // 2))
    lost, total, last_ns = np.zeros(len(begins)), 0.0, begins[-1] + lengths_ns[-1] - _LEAST_AFTER_NS
    for k in range(_LEAST_BEFORE, int(np.searchsorted(begins, last_ns, "right"))):
        before = np.sort(delays[max(k - _BEFORE, 0) : k])  # corrected for earlier losses
        before = before[: np.searchsorted(before, np.inf)]
        if len(before) >= _LEAST_BEFORE:
            usual = before[max(1, int(_EARLY * len(before)))]
            middle = before[len(before) // 2 if len(begins) - k > _FEW_AFTER else -1]
            limit = max(usual, middle) + 0.5 * min(lengths_ns[k], lengths_ns[k - 1])
            if limit < coming[k] - total < np.inf:
                lost[k] = coming[k] - total - usual
                total += lost[k]
        delays[k] -= total
    early = -float(coming[0])
    return lost, early if early > 0.5 * lengths_ns[0] else 0.0


def begins_again(stamps_ns: IntArray, lengths_ns: FloatArray) -> list[tuple[int, int]]:
    """Return the messages at which stamps start again, with the offset to add from there on, ns.

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
    """Return how stamps and samples contradict each other as a whole; empty if they agree."""
    ends = np.linspace(0, len(stamps_ns) - 1, _PIECES + 1).astype(int)
    spans, sent = np.diff(stamps_ns[ends]), np.diff((np.cumsum(lengths_ns) - lengths_ns)[ends])
    longer = sent.sum() - spans.sum() > _AGAIN_NS and bool((spans < _LONG_SHARE * sent).all())
    # Losses before most messages mean that the rate is wrong.
    if (lost_ns > 0.0).mean() > 0.5 or (longer and bool((spans > _LEAST_SPAN * sent).all())):
        said = "stamps advance by {:.1f} s while {:.1f} s of samples were sent"
        return said.format(1e-9 * (spans.sum() + lengths_ns[-1]), 1e-9 * lengths_ns.sum())
    return ""
