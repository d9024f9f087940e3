"""Decimation of one channel of a stream, exact in blocks of any length."""

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from worldstate.ground import FloatArray, in_range

# Attenuation of what aliases into the band, and of the ripple within it: the resolution of 16-bit converters.
_ATTENUATION_DB = 80.0
# Samples kept per period of the highest frequency: with 2 the filter would need an endless transition.
_OVERSAMPLING = 3.0


class Decimator:
    r"""Decimate to about three samples per period of the highest frequency.

    .. math:: y[m] = \sum_{n=0}^{L-1} h[n]\, x[m D + n], \qquad D = \lfloor f_s / 3 f_{high} \rfloor

    with a linear-phase Kaiser low-pass, flat up to :math:`f_{high}`, closed from :math:`f_s / D - f_{high}`.
    Only outputs whose L samples are all there are given; what is left over waits. In polyphase form: the
    samples as rows of D, one matrix product with the taps as columns of D, sums along its diagonals.
    """

    def __init__(self, sample_rate_hz: float, high_hz: float) -> None:
        rate = in_range("sample_rate_hz", sample_rate_hz, 0.0, np.inf, open_low=True)
        high = in_range("high_hz", high_hz, 0.0, 0.5 * rate, open_low=True, open_high=True)
        self.factor = max(int(rate / (_OVERSAMPLING * high)), 1)
        self.rate_hz = rate / self.factor
        taps = _low_pass(rate, high, self.rate_hz) if self.factor > 1 else np.ones(1)
        self.n_taps = len(taps)
        padded = np.concatenate([taps, np.zeros(-len(taps) % self.factor)])
        self._phases = np.ascontiguousarray(padded.reshape(-1, self.factor).T)
        self._waiting: FloatArray = np.empty(0)

    def push(self, samples: NDArray[np.floating]) -> FloatArray:
        r"""Take the next samples (n,) and return the outputs that they complete.

        .. math:: y[m] = \sum_n h[n]\, x[m D + n]
        """
        waiting = np.concatenate([self._waiting, samples])
        n_out = max((len(waiting) - self.n_taps) // self.factor + 1, 0)
        self._waiting = waiting[n_out * self.factor :]
        return self._filtered(waiting, n_out)

    def _filtered(self, x: FloatArray, n_out: int) -> FloatArray:
        D, Q = self._phases.shape
        rows = np.zeros((n_out + Q - 1, D))
        n_used = min(len(x), rows.size)
        rows.ravel()[:n_used] = x[:n_used]
        products = rows @ self._phases
        step = products.itemsize
        # Output m is the sum of products[m + q, q] over q.
        diagonals = np.lib.stride_tricks.as_strided(products, (n_out, Q), (Q * step, (Q + 1) * step))
        return np.asarray(diagonals.sum(axis=1))


def _low_pass(rate: float, high: float, low_rate: float) -> FloatArray:
    width = (low_rate - 2.0 * high) / (0.5 * rate)
    n_taps, beta = signal.kaiserord(_ATTENUATION_DB, width)
    taps = signal.firwin(n_taps | 1, 0.5 * low_rate, window=("kaiser", beta), fs=rate)
    return np.asarray(taps, dtype=np.float64)
