"""Rates of alarms: exact intervals of counts and shares, and what alarms at random moments would detect."""

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray

from .weighted_figures import ratio


def poisson_interval(count: int, exposure: float, confidence: float = 0.95) -> tuple[float, float]:
    r"""Return the exact interval of a Poisson rate, alarms an hour if the exposure is in hours.

    .. math:: \left[\chi^2_{\alpha/2}(2n),\ \chi^2_{1-\alpha/2}(2n + 2)\right] / 2T

    Examples
    --------
    >>> low, high = poisson_interval(0, exposure=0.103)
    >>> low, round(high, 1)
    (0.0, 35.8)
    """
    # F. Garwood, "Fiducial limits for the Poisson distribution", Biometrika 28, 1936. One alarm more or less
    # moves the rate by 1 / T, so without any alarm the high end says how little the hours can tell.
    from scipy.special import gammaincinv

    whole = in_range("count", count, 0, np.inf)
    time = in_range("exposure", exposure, 0.0, np.inf, open_low=True)
    tail = (1.0 - in_range("confidence", confidence, 0.0, 1.0, open_low=True, open_high=True)) / 2.0
    # A chi-square with 2 n degrees of freedom is twice a Gamma(n), whose inverse needs no scipy.stats.
    low = float(gammaincinv(whole, tail)) if whole else 0.0
    return low / time, float(gammaincinv(whole + 1.0, 1.0 - tail)) / time


def poisson_upper(count: int, exposure: float, confidence: float = 0.9) -> float:
    """Return the rate that is not exceeded with such confidence: the one-sided exact bound.

    Examples
    --------
    >>> round(poisson_upper(0, exposure=1.0), 2)
    2.3
    """
    # The upper end of a two-sided interval leaves as much beyond it on either side.
    return poisson_interval(count, exposure, 2.0 * confidence - 1.0)[1]


def share_interval(count: int, of: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the exact interval of a share.

    Examples
    --------
    >>> low, high = share_interval(0, of=1000)
    >>> low, round(high, 4)
    (0.0, 0.0037)
    """
    # C. Clopper and E. Pearson, "The use of confidence or fiducial limits", Biometrika 26, 1934.
    from scipy.special import betaincinv

    whole = in_range("count", count, 0, in_range("of", of, 1, np.inf))
    tail = (1.0 - in_range("confidence", confidence, 0.0, 1.0, open_low=True, open_high=True)) / 2.0
    low = float(betaincinv(whole, of - whole + 1.0, tail)) if whole else 0.0
    return low, float(betaincinv(whole + 1.0, of - whole, 1.0 - tail)) if whole < of else 1.0


def random_detection(
    windows_s: ArrayLike, alarms: ArrayLike, scored_s: ArrayLike, times: ArrayLike = 1.0
) -> FloatArray:
    r"""Return the detection rate of as many alarms at uniformly random moments; NaN without an approach.

    .. math:: \sum_i t_i \left(1 - (1 - w_i / T)^N\right) / \sum_i t_i

    `windows_s` (n,) holds w, the time before each T0 in which an onset counts; T is all scored time. On
    samples of the approaches, which hold each of them `times` (D, n), `alarms` and `scored_s` are (D,).

    Examples
    --------
    >>> float(random_detection([5.0, 2.5], alarms=2, scored_s=10.0))
    0.59375
    """
    windows = finite_array("windows_s", windows_s, (None,))
    number, total_s = (np.asarray(one, np.float64)[..., None] for one in (alarms, scored_s))
    in_range("scored_s", float(total_s.min(initial=1.0)), 0.0, np.inf, open_low=True)
    in_range("alarms", float(number.min(initial=0.0)), 0, np.inf)
    share, weight = np.broadcast_arrays(windows / total_s, np.asarray(times, np.float64))
    if ((share < 0.0) | (share > 1.0))[weight > 0.0].any():
        got = f"{windows.min():g} to {windows.max():g} s"
        raise InvalidArgumentError(f"windows_s: expected each within the time scored, got {got}")
    detected = 1.0 - (1.0 - np.clip(share, 0.0, 1.0)) ** number
    return ratio((weight * detected).sum(axis=-1), weight.sum(axis=-1))
