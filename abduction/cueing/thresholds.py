"""Neyman-Pearson thresholds for a false-alarm budget."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground import TINY, InvalidArgumentError, finite_array, in_range

from .cueing_policy import sustained_statistic


def neyman_pearson_threshold(hazard_free: Sequence[ArrayLike], alpha: float, sustain_hops: int = 1) -> float:
    r"""Return the smallest threshold whose sustained alarm stays within its budget on hazard-free recordings.

    .. math::
        \gamma(\alpha) = \min \Big\{ \gamma : \frac{1}{N} \sum_t
        1\big[\min(s_{t-k+1}, \dots, s_t) \ge \gamma\big] \le \alpha \Big\}

    over all N windows of all recordings; consecutive hops never span two recordings. The rate on these
    windows never exceeds `alpha`, even if statistics are equal.

    Parameters
    ----------
    hazard_free : sequence of array_like, each of shape (windows,)
        Statistics of each hazard-free calibration recording, in temporal order.
    alpha : float
        Budget: share of windows in alarm, in [0, 1).
    sustain_hops : int
        k, the number of consecutive hops for which the statistic has to hold.

    Returns
    -------
    float
        Threshold on the scale of the statistic.

    Raises
    ------
    InvalidArgumentError
        If there are no windows, one is not finite, or alpha or k is out of range.

    References
    ----------
    "Evidence of Absence", section VII; DESIGN.md, Definitions, gamma(alpha).

    Examples
    --------
    >>> gamma = neyman_pearson_threshold([[0.1, 0.9, 0.2], [0.3, 0.4]], alpha=0.2)
    >>> 0.4 < gamma < 0.4000001
    True
    """
    budget = in_range("alpha", alpha, 0.0, 1.0, open_high=True)
    streams = [finite_array("hazard_free", stream, (None,)) for stream in hazard_free]
    held = np.concatenate([np.zeros(0), *(sustained_statistic(one, sustain_hops) for one in streams)])
    if not held.size:
        raise InvalidArgumentError("hazard_free: expected at least one window")
    # The threshold is the next float above the statistic of the first window that exceeds the budget.
    paid, least = int(budget * held.size * (1.0 + TINY)), float(np.finfo(np.float64).min)
    return least if paid >= held.size else max(float(np.nextafter(np.sort(held)[-1 - paid], np.inf)), least)
