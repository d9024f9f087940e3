"""Rates of alarms: the exact interval of a count, and what alarms at random moments would detect."""

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError


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


def random_detection(windows_s: ArrayLike, alarms: int, scored_s: float) -> float:
    r"""Return the detection rate of as many alarms at uniformly random moments; NaN without an approach.

    .. math:: \frac1n \sum_i 1 - (1 - w_i / T)^N

    `windows_s` (n,) holds w, the time before each T0 in which an onset counts; T is all scored time.

    Examples
    --------
    >>> random_detection([5.0, 2.5], alarms=2, scored_s=10.0)
    0.59375
    """
    windows = finite_array("windows_s", windows_s, (None,))
    total_s = in_range("scored_s", scored_s, 0.0, np.inf, open_low=True)
    number = in_range("alarms", alarms, 0, np.inf)
    if not windows.size:
        return float("nan")
    if windows.min() < 0.0 or windows.max() > total_s:
        got = f"{windows.min():g} to {windows.max():g} s"
        raise InvalidArgumentError(f"windows_s: expected each within the {total_s:g} s scored, got {got}")
    return float(np.mean(1.0 - (1.0 - windows / total_s) ** number))
