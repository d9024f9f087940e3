r"""Thresholds of a false-alarm budget: Neyman-Pearson, and conformal with a guarantee over recordings.

The exchangeable unit is a recording, because the windows of one recording are strongly correlated.
"""

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground import FloatArray, InvalidArgumentError, finite_array, in_range

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
    losses = _losses(hazard_free, sustain_hops)
    # Every window weighs the same, whichever recording it is of.
    return _smallest_threshold(losses._replace(shares=np.ones(losses.held.size)), budget * losses.held.size)


class _Losses(NamedTuple):
    """Sustained statistics of all windows, falling, with the share of its recording that each stands for."""

    held: FloatArray
    shares: FloatArray
    recordings: int


def conformal_threshold(
    hazard_free: Sequence[ArrayLike], alpha: float, sustain_hops: int = 1, confidence: float | None = None
) -> float:
    r"""Return the smallest threshold that keeps a budget on recordings not yet made.

    With :math:`L_i(\gamma)` the share of the windows of recording i that are in sustained alarm,

    .. math:: \gamma = \min \Big\{ \gamma : \frac{1 + \sum_{i=1}^n L_i(\gamma)}{n + 1} \le \alpha \Big\}
              \quad\Rightarrow\quad E[L_{n+1}(\gamma)] \le \alpha

    for exchangeable recordings, whatever the law of their windows (conformal risk control; with one window a
    recording it is split-conformal prediction). The expectation is over the calibration recordings as well:
    a single calibration may lie above. With `confidence` c it does so at most in a share 1 - c of them:

    .. math:: P\big(E[L_{n+1} \mid \gamma] \le \alpha\big) \ge c,

    by the Hoeffding-Bentkus bound on the mean of n independent losses in [0, 1], exact binomial where every
    recording is one window.

    Parameters
    ----------
    hazard_free : sequence of array_like, each of shape (windows,)
        Statistics of each hazard-free calibration recording, in the order of time. Long ones are best cut
        into pieces that are longer than the statistic's correlation time.
    alpha : float
        Budget: share of windows in alarm, in (0, 1).
    sustain_hops : int
        k, consecutive hops that the statistic has to hold.
    confidence : float, optional
        c in (0, 1).

    Returns
    -------
    float
        +inf where there are fewer than `recordings_needed`: no finite threshold has the guarantee.

    Raises
    ------
    InvalidArgumentError
        If there are no windows, one is not finite, or a number is out of range.

    References
    ----------
    Angelopoulos et al., "Conformal risk control", 2022; Bates et al., "Distribution-free, risk-controlling
    prediction sets", 2021.

    Examples
    --------
    >>> streams = np.random.default_rng(0).normal(size=(99, 1))
    >>> gamma = conformal_threshold(streams, alpha=0.02)
    >>> int((streams >= gamma).sum()), conformal_threshold(streams[:40], alpha=0.02)
    (1, inf)
    """
    budget = in_range("alpha", alpha, 0.0, 1.0, open_low=True, open_high=True)
    losses = _losses(hazard_free, sustain_hops)
    if confidence is None:
        allowed = budget * (losses.recordings + 1) - 1.0
    else:
        trust = in_range("confidence", confidence, 0.0, 1.0, open_low=True, open_high=True)
        allowed = _largest_sum(losses, budget, 1.0 - trust)
    return _smallest_threshold(losses, allowed)


def risk_controlling(losses: FloatArray, alpha: float, largest: float) -> int:
    r"""Return how many of ever lower thresholds keep the expected loss of a unit not yet seen within alpha.

    .. math:: \max \Big\{ k : \frac{1}{n + 1} \Big( L + \sum_{j=1}^n \max_{i \le k} \min(L_{ji}, L) \Big)
              \le \alpha \Big\}

    Shapes: losses (n, thresholds), of unit j at threshold i, counted up to the largest, L.

    Source: A. Angelopoulos et al., "Conformal risk control", ICLR 2024, eq. (4).

    Examples
    --------
    >>> losses = np.array([[0.0, 1.0, 4.0], [0.0, 0.0, 1.0]])
    >>> [risk_controlling(losses, alpha, largest=3.0) for alpha in (0.9, 1.0, 1.5, 3.0)]
    [0, 1, 2, 3]
    """
    # Onsets are no monotone loss, since alarms that grow together are one: what counts is the worst so far.
    worst = np.maximum.accumulate(np.minimum(losses, largest), axis=1)
    return int(np.sum(worst.sum(axis=0) + largest <= alpha * (len(losses) + 1) * (1.0 + 1e-9)))


def recordings_needed(alpha: float, confidence: float | None = None) -> int:
    r"""Return the fewest hazard-free recordings from which a conformal threshold is finite.

    .. math:: n = \lceil 1 / \alpha \rceil - 1, \qquad
              n_c = \Big\lceil \frac{\ln (1 - c)}{\ln (1 - \alpha)} \Big\rceil

    Parameters
    ----------
    alpha : float
        Budget, in (0, 1).
    confidence : float or None
        With which it should hold for every later recording; None: on average.

    Returns
    -------
    int
        Number of recordings.

    References
    ----------
    Angelopoulos et al. 2022 with no loss at all: see `conformal_threshold`; S. S. Wilks, "Determination of
    sample sizes for setting tolerance limits", Ann. Math. Statist. 12, 1941.

    Examples
    --------
    >>> recordings_needed(0.02), recordings_needed(0.02, confidence=0.95)
    (49, 149)
    """
    budget = in_range("alpha", alpha, 0.0, 1.0, open_low=True, open_high=True)
    if confidence is None:
        return math.ceil(1.0 / budget - 1e-9) - 1
    trust = in_range("confidence", confidence, 0.0, 1.0, open_low=True, open_high=True)
    return math.ceil(math.log(1.0 - trust) / math.log1p(-budget) - 1e-9)


def _losses(hazard_free: Sequence[ArrayLike], sustain_hops: int) -> _Losses:
    streams = [finite_array("hazard_free", stream, (None,)) for stream in hazard_free]
    streams = [stream for stream in streams if stream.size]
    if not streams:
        raise InvalidArgumentError("hazard_free: expected at least one window")
    held = np.concatenate([sustained_statistic(stream, sustain_hops) for stream in streams])
    shares = np.concatenate([np.full(stream.size, 1.0 / stream.size) for stream in streams])
    order = np.argsort(-held, kind="stable")
    return _Losses(held[order], shares[order], len(streams))


def _smallest_threshold(losses: _Losses, allowed: float) -> float:
    if allowed < -1e-9:
        return math.inf
    # The next float above the first window that the budget cannot pay for.
    first = int(np.searchsorted(np.cumsum(losses.shares), allowed + 1e-9, side="right"))
    if first == losses.held.size:
        return float(np.finfo(np.float64).min)
    return float(max(np.nextafter(losses.held[first], np.inf), np.finfo(np.float64).min))


def _largest_sum(losses: _Losses, alpha: float, delta: float) -> float:
    """Return the largest sum of losses from which "the mean exceeds alpha" is refuted at level delta."""
    sums = [0.0, *np.cumsum(losses.shares).tolist()]
    refuted = bisect_right(sums, delta, key=lambda total: _p_value(total, losses, alpha))
    return sums[refuted - 1] if refuted else -1.0


def _p_value(total: float, losses: _Losses, alpha: float) -> float:
    from scipy.special import rel_entr
    from scipy.stats import binom

    n = losses.recordings
    tail = float(binom.cdf(math.ceil(total - 1e-9), n, alpha))
    if losses.held.size == losses.recordings:
        return tail
    mean = min(total / n, alpha)
    # Kullback-Leibler divergence of the two laws of one loss, nats.
    divergence = float(rel_entr(mean, alpha) + rel_entr(1.0 - mean, 1.0 - alpha))
    return min(math.exp(-n * divergence), math.e * tail)
