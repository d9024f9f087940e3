"""A stream at another rate, exact in blocks of any length: all channels resampled, or one decimated."""

from fractions import Fraction
from math import ceil

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import signal

from worldstate.ground import FloatArray, in_range
from worldstate.ground.typing import Float32Array

# Attenuation of what aliases into the band, and of the ripple within it: the resolution of 16-bit converters.
_ATTENUATION_DB = 80.0
# Samples kept per period of the highest frequency: with 2 the filter would need an endless transition.
_OVERSAMPLING = 3.0


class Decimator:
    r"""Decimate to about three samples per period of the highest frequency.

    .. math:: y[m] = \sum_{n=0}^{L-1} h[n]\, x[m D + n], \qquad D = \lfloor f_s / 3 f_{high} \rfloor

    with a linear-phase Kaiser low-pass, flat up to :math:`f_{high}`, closed from :math:`f_s / D - f_{high}`.
    Only outputs whose L samples are all there are given; what is left over waits.
    """

    def __init__(self, sample_rate_hz: float, high_hz: float) -> None:
        rate = in_range("sample_rate_hz", sample_rate_hz, 0.0, np.inf, open_low=True)
        high = in_range("high_hz", high_hz, 0.0, 0.5 * rate, open_low=True, open_high=True)
        self.factor = max(int(rate / (_OVERSAMPLING * high)), 1)
        self.rate_hz = rate / self.factor
        taps = _low_pass(rate, high, self.rate_hz) if self.factor > 1 else np.ones(1)
        self.n_taps = len(taps)
        # Zeros in front of the taps: every D-th value of the whole convolution is then a sum of L samples.
        self._taps = np.concatenate([np.zeros((1 - self.n_taps) % self.factor), taps])
        self._waiting: FloatArray = np.empty(0)

    def push(self, samples: NDArray[np.floating]) -> FloatArray:
        r"""Take the next samples (n,) and return the outputs that they complete.

        .. math:: y[m] = \sum_n h[n]\, x[m D + n]
        """
        waiting = np.concatenate([self._waiting, samples])
        n_out = max((len(waiting) - self.n_taps) // self.factor + 1, 0)
        self._waiting = waiting[n_out * self.factor :]
        # The taps are symmetric, so that a convolution is the sum above.
        first = (len(self._taps) - 1) // self.factor
        filtered = signal.upfirdn(self._taps, waiting, down=self.factor)
        return np.asarray(filtered[first : first + n_out], dtype=np.float64)


def _low_pass(rate: float, high: float, low_rate: float) -> FloatArray:
    width = (low_rate - 2.0 * high) / (0.5 * rate)
    n_taps, beta = signal.kaiserord(_ATTENUATION_DB, width)
    taps = signal.firwin(n_taps | 1, 0.5 * low_rate, window=("kaiser", beta), fs=rate)
    return np.asarray(taps, dtype=np.float64)


# Share of half the lower rate: flat up to .9 of it as converters are, closed from 1.1 on.
_TRANSITION = 0.2
# 147:160 has the largest terms of the rates in use; at others the output is off by .4 % at most, and says so.
_LARGEST_TERM = 160


class Resampler:
    r"""Bring all channels of a stream to another rate, without delay: output m lies at m D / U of the input.

    .. math:: y[m] = U \sum_n h[m D - n U]\, x[n], \qquad U / D \approx f_{out} / f_s

    with a linear-phase Kaiser low-pass h, at 80 dB, about half of the lower rate. Outputs are given in groups
    of U, each the same product of matrices, so that they are the same to the bit for blocks of any length.
    Before the stream lies silence.

    Parameters
    ----------
    n_channels : int
        Number of channels M.
    sample_rate_hz, wanted_hz : float
        Rate of the input, and about that of the output.

    Attributes
    ----------
    rate_hz : float
        Rate of the output, exactly ``U / D`` of that of the input.
    tail : int
        Silent samples that, pushed after the end of a stream, give all outputs up to that end.

    Examples
    --------
    >>> resampler = Resampler(2, 44_100, 48_000)
    >>> sound = np.ones((44_100, 2), np.float32)
    >>> parts = [resampler.push(part) for part in (*np.split(sound, 100), sound[: resampler.tail])]
    >>> resampler.rate_hz, len(np.concatenate(parts)) >= 48_000
    (48000.0, True)
    """

    # A tenth of a second of 56 channels from 44.1 to 48 kHz costs 1.7 ms as products of matrices, 12 ms by
    # `scipy.signal.upfirdn`, 3.2 ms by soxr, which gives the same, 15 ms later instead of 4.

    def __init__(self, n_channels: int, sample_rate_hz: float, wanted_hz: float) -> None:
        ratio = Fraction(wanted_hz / sample_rate_hz).limit_denominator(_LARGEST_TERM)
        self._up, self._down = up, down = ratio.as_integer_ratio()
        self.rate_hz = sample_rate_hz * up / down
        n_taps, beta = signal.kaiserord(_ATTENUATION_DB, _TRANSITION / max(up, down))
        half = ceil(n_taps / (2 * up))
        taps = up * signal.firwin(2 * half * up + 1, 1.0 / max(up, down), window=("kaiser", beta))
        # Row m: what output m of a group takes of the inputs from `half` before the group on.
        self._width = down + 2 * half
        index = np.arange(up)[:, None] * down - (np.arange(self._width) - 2 * half) * up
        inside = (index >= 0) & (index < len(taps))
        self._rows = np.where(inside, taps[index * inside], 0.0).astype(np.float32)
        self._waiting: Float32Array = np.zeros((half, n_channels), np.float32)
        self.tail = half + down + ceil(down / up)

    def push(self, samples: Float32Array) -> Float32Array:
        """Take the next samples (n, M) and return the outputs that they complete."""
        waiting = np.concatenate([self._waiting, samples])
        if len(waiting) < self._width:
            self._waiting = waiting
            return waiting[:0]
        windows = sliding_window_view(waiting, self._width, axis=0)[:: self._down]
        self._waiting = waiting[len(windows) * self._down :].copy()
        groups: Float32Array = np.matmul(self._rows, windows.transpose(0, 2, 1))
        return groups.reshape(-1, samples.shape[1])
