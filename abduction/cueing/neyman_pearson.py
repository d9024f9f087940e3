r"""Neyman-Pearson threshold gamma(alpha) of a false-alarm budget."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray

from .cueing_policy import sustained_statistic


def neyman_pearson_threshold(hazard_free: Sequence[ArrayLike], alpha: float, sustain_hops: int = 1) -> float:
    r"""Return the smallest threshold whose sustained alarm keeps its budget on hazard-free recordings.

    .. math::
        \gamma(\alpha) = \min \Big\{ \gamma : \frac{1}{N} \sum_t
        1\big[\min(s_{t-k+1}, \dots, s_t) \ge \gamma\big] \le \alpha \Big\}

    over all N windows of all recordings; a run never crosses from one recording into the next. The rate on
    these windows never exceeds `alpha`, ties included.

    Parameters
    ----------
    hazard_free : sequence of array_like, each of shape (windows,)
        Statistics of each hazard-free calibration recording, in the order of time.
    alpha : float
        Budget: share of windows in alarm, in [0, 1).
    sustain_hops : int
        k, consecutive hops that the statistic has to hold.

    Returns
    -------
    float
        Of the statistic's own scale.

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
    held = [sustained_statistic(stream, sustain_hops) for stream in streams]
    statistic: FloatArray = np.sort(np.concatenate(held) if held else np.empty(0))[::-1]
    if not statistic.size:
        raise InvalidArgumentError("hazard_free: expected at least one window")
    # The next float above the first window that the budget cannot pay for; alpha < 1 leaves at least one.
    allowed = int(np.floor(budget * statistic.size + 1e-9))
    return float(max(np.nextafter(statistic[allowed], np.inf), np.finfo(np.float64).min))
