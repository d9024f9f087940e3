"""Effective number of independent windows in a stream of overlapping ones."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray


def correlation_time_hops(streams: Sequence[ArrayLike]) -> float:
    r"""Return the integrated autocorrelation time of a statistic, in hops, >= 1.

    .. math:: \tau = 1 + 2 \sum_{j \ge 1} \rho_j,

    Shapes: streams (windows,).

    References
    ----------
    Geyer, "Practical Markov chain Monte Carlo", 1992.
    """
    # summed while the sums of neighbouring pairs are positive (Geyer's initial positive sequence). N windows
    # tell as much of the mean as N / tau independent ones.
    values = [finite_array("streams", stream, (None,)) for stream in streams]
    if not sum(value.size for value in values):
        raise InvalidArgumentError("streams: expected at least one window")
    correlation = _autocorrelation(values)
    pairs = correlation[: correlation.size // 2 * 2].reshape(-1, 2).sum(axis=1)
    negative = np.flatnonzero(pairs <= 0.0)
    last = int(negative[0]) if negative.size else pairs.size
    return float(max(2.0 * pairs[:last].sum() - 1.0, 1.0))


def _autocorrelation(values: list[FloatArray]) -> FloatArray:
    """Pooled autocorrelation up to half the longest stream, lag 0 first."""
    mean = np.concatenate(values).mean()
    lags = max(value.size for value in values) // 2 + 2
    total, counts = np.zeros(lags), np.zeros(lags)
    for value in values:
        reach = min(lags, value.size)
        spectrum = np.fft.rfft(value - mean, 2 * value.size)
        total[:reach] += np.fft.irfft(np.abs(spectrum) ** 2, 2 * value.size)[:reach]
        counts[:reach] += value.size - np.arange(reach)
    covariance = np.divide(total, counts, out=np.zeros(lags), where=counts > 0)
    return covariance / covariance[0] if covariance[0] > 0.0 else np.zeros(lags)
