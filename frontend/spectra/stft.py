"""Spectra of a stream, identical for blocks of any length.

The short-time Fourier transform covers a range of bins; the phase transform keeps only their phases.
"""

import numpy as np

from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import Complex64Array, ComplexArray, Float32Array

# Smallest power of a bin with sound: far below 24-bit quantisation, far above float32 underflow.
_POWER_FLOOR = np.float32(1e-30)


def power(spectra: ComplexArray) -> np.ndarray:
    """Return the squared magnitude ``|X|^2 = (Re X)^2 + (Im X)^2``, same shape, without a square root.

    Examples
    --------
    >>> power(np.array([3 + 4j], np.complex64))
    array([25.], dtype=float32)
    """
    squared = np.square(spectra.real)
    squared += np.square(spectra.imag)
    return squared


def whiten(spectra: Complex64Array, powers: Float32Array | None = None) -> Complex64Array:
    r"""Return the phase transform :math:`Z = X / |X|`; bins without sound remain zero.

    Source: C. Knapp and G. C. Carter, IEEE Trans. ASSP 24, 1976.
    """
    weights = np.maximum(power(spectra) if powers is None else powers, _POWER_FLOOR)
    np.sqrt(weights, out=weights)
    np.reciprocal(weights, out=weights)
    return spectra * weights


def fast_length(least: int) -> int:
    """Return the smallest length from `least` on with a fast transform: no prime factor above 5.

    Examples
    --------
    >>> [fast_length(length) for length in (7, 121, 1024)]
    [8, 125, 1024]
    """
    rest = least
    for prime in (2, 3, 5):
        while rest % prime == 0:
            rest //= prime
    return least if rest == 1 else fast_length(least + 1)


def band_bins(band_hz: tuple[float, float], sample_rate_hz: float, nfft: int) -> range:
    """Return the bins of a band by pyroomacoustics' rule: ``k = round(f N / fs)``, upper end excluded."""
    low, high = (int(np.round(frequency / sample_rate_hz * nfft)) for frequency in band_hz)
    got = f"got {band_hz} Hz"
    if not 0 <= low < high:
        raise InvalidArgumentError(f"band_hz: expected a band of at least one bin of {nfft}, {got}")
    if high > nfft // 2:
        expected = f"less than half the sample rate of {sample_rate_hz} Hz"
        advice = "choose a lower band or a higher sample rate (simulate: --bandwidth)"
        raise InvalidArgumentError(f"band_hz: expected {expected}, {got}: {advice}")
    return range(low, high)


def bin_frequencies_hz(bins: range, sample_rate_hz: float, nfft: int) -> np.ndarray:
    """Return the centre frequencies ``f_k = k fs / N`` of the bins, Hz, shape (bins,)."""
    return np.arange(bins.start, bins.stop) * (sample_rate_hz / nfft)


class StreamingStft:
    r"""Hann-windowed STFT frames of `nfft` samples with half overlap, identical for blocks of any length.

    .. math:: X_t[k] = \sum_{n=0}^{N-1} w[n]\, x[t N/2 + n]\, e^{-j 2 \pi k n / N},
              \qquad w[n] = \tfrac12 - \tfrac12 \cos(2 \pi n / N)
    """

    # The first frame starts at the first sample, without padding. Every half frame is multiplied once by the
    # required rows of the DFT matrix (one sgemm); a full FFT and a decimation before it were both slower. Two
    # neighbouring halves form a frame, the second with sign (-1)^k, and the Hann window is the three-tap
    # filter (-1/4, 1/2, -1/4) across bins (F. J. Harris, Proc. IEEE 66, 1978).

    def __init__(self, n_channels: int, nfft: int, bins: range) -> None:
        if nfft < 4 or nfft % 2:
            raise InvalidArgumentError(f"nfft: expected an even number >= 4, got {nfft}")
        if bins.step != 1 or not 0 <= bins.start < bins.stop <= nfft // 2 + 1:
            raise InvalidArgumentError(f"bins: expected a range within 0..{nfft // 2}, got {bins}")
        self.bins = bins
        # One more bin on each side for the taps of the window.
        wider = np.arange(bins.start - 1, bins.stop + 1)
        # The real rows, then the imaginary rows of the DFT over half a frame.
        phase = -2.0 * np.pi / nfft * np.outer(wider, np.arange(nfft // 2))
        self._half_dft = np.concatenate([np.cos(phase), np.sin(phase)]).astype(np.float32)
        self._signs = ((-1.0) ** wider).astype(np.float32)[:, None]
        self._head = np.empty((nfft // 2, n_channels), np.float32)
        self._n_head = 0
        self._previous: Float32Array | None = None

    def push(self, samples: Float32Array) -> Complex64Array:
        r"""Process the next samples (n, M) and return the frames that they complete, (frames, bins, M).

        .. math:: X_t[k] = \sum_{n=0}^{N-1} w[n]\, x[t N/2 + n]\, e^{-j 2 \pi k n / N}

        """
        halves = self._halves(samples)
        if halves is None:
            return np.empty((0, len(self.bins), self._head.shape[1]), np.complex64)
        first = 1 if self._previous is None else 0
        if self._previous is not None:
            halves[0] = self._previous
        self._previous = halves[-1].copy()
        return _frames(halves[first:], self._signs)

    def _halves(self, samples: Float32Array) -> Float32Array | None:
        """Transform the half frames that are now full, (1 + n, 2, bins + 2, M); the first is not filled."""
        size, n_channels = self._head.shape
        missing = size - self._n_head
        if len(samples) < missing:
            self._head[self._n_head : self._n_head + len(samples)] = samples
            self._n_head += len(samples)
            return None
        self._head[self._n_head :] = samples[:missing]
        n_rest = (len(samples) - missing) // size
        rest = samples[missing : missing + n_rest * size].reshape(n_rest, size, n_channels)
        halves = np.empty((2 + n_rest, 2, len(self._signs), n_channels), np.float32)
        flat = halves.reshape(2 + n_rest, -1, n_channels)
        np.matmul(self._half_dft, self._head, out=flat[1])
        np.matmul(self._half_dft, rest, out=flat[2:])
        tail = samples[missing + n_rest * size :]
        self._head[: len(tail)] = tail
        self._n_head = len(tail)
        return halves


def _frames(halves: Float32Array, signs: Float32Array) -> Complex64Array:
    """Join neighbouring halves and apply the window, (n, 2, bins + 2, M) -> (n - 1, bins, M)."""
    joined = halves[1:] * signs
    joined += halves[:-1]
    sides = joined[:, :, :-2] + joined[:, :, 2:]
    sides *= np.float32(-0.25)
    windowed = joined[:, :, 1:-1] * np.float32(0.5)
    windowed += sides
    spectra = np.empty((len(windowed), *windowed.shape[2:]), np.complex64)
    spectra.real, spectra.imag = windowed[:, 0], windowed[:, 1]
    return spectra
