r"""The published feature of 60 values: pair sums after the phase transform, two segments x thirty azimuths.

.. math:: F_s(\theta) = \frac{1}{T_s K P} \Big| \sum_{t \in s} \sum_k \sum_{i<j}
          \overline{a_{k,i}(\theta)}\, Z_{t,k,i}\, \overline{Z_{t,k,j}}\, a_{k,j}(\theta) \Big|,
          \qquad Z = X / |X|

over the T_s frames of segment s, K bins of 50-1500 Hz and the P = M (M - 1) / 2 pairs: the modulus of a
complex sum without the diagonal, between 0 and 1. As in the released data, azimuths run from -90 to 90
degrees, positive to the RIGHT; index 0 of each segment is +90 degrees (far left) in this library.
"""

from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import ArrayLike

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.steering import Steering, cross_spectra, one_blas_thread
from worldstate.frontend.spectra.stft import band_bins, bin_frequencies_hz, whiten
from worldstate.ground import InvalidArgumentError, finite_array, in_range
from worldstate.ground.typing import Complex64Array, Complex128Array, Float32Array, FloatArray

FEATURE_AZIMUTHS_RAD = np.radians(np.linspace(90.0, -90.0, 30))
"""The published azimuths in this library's convention (left positive), in the published order."""
FEATURE_AZIMUTHS_RAD.flags.writeable = False

# Parameters of the released data. The released features were computed with pyroomacoustics 0.3.1, whose sum
# is not real. Later releases return another scale, with which a classifier transfers less well to simulated
# sound. The modulus of the complex sum depends by about one per cent on the order of the microphones, which
# is that of the array file.
FEATURE_BAND_HZ = (50.0, 1500.0)
FEATURE_VERSION = "SRP-PHAT pairs 1"
"""Version of the feature, stored in every model; it changes whenever the values for a sound change."""
FEATURE_NFFT = 512
FEATURE_RATE_HZ = 47_998.0  # Rate of the released sound
_FULL_RATE_HZ = 48_000.0
FEATURE_SEGMENTS = 2
# Two per cent of the rate change the upper limit of the band by a third of a bin.
RATE_TOLERANCE = 0.02
# At 3 kHz the band would end at half the rate, where converters suppress the signal.
MOST_HALVINGS = 3
LEAST_RATE_HZ = (1.0 - RATE_TOLERANCE) * _FULL_RATE_HZ / 2**MOST_HALVINGS


def feature_nfft(sample_rate_hz: float) -> int:
    r"""Return the frame length with the frequencies of the published bins, or 512 if there is none.

    .. math:: N = 512 / 2^k, \qquad |2^k f_s / 47\,998 - 1| \le 0.02, \quad k = 0, \ldots, 3

    Examples
    --------
    >>> feature_nfft(47_998), feature_nfft(12_000), feature_nfft(6000), feature_nfft(16_000)
    (512, 128, 64, 512)
    """
    # Only halvings; sound at other rates is resampled. Frames of 170 samples at 16 kHz have the same duration
    # within 0.4 % but other start times, which changes the probability of an approach by 0.05 in the median,
    # as a shift of 2 ms at 48 kHz does.
    halvings = round(np.log2(FEATURE_RATE_HZ / sample_rate_hz))
    fits = abs(2.0**halvings * sample_rate_hz / FEATURE_RATE_HZ - 1.0) <= RATE_TOLERANCE
    return FEATURE_NFFT >> halvings if fits and 0 <= halvings <= MOST_HALVINGS else FEATURE_NFFT


def feature_rate_hz(sample_rate_hz: float) -> float:
    """Return the rate for the feature: the given one if its frames are as long as the published ones.

    Otherwise it is the next higher of 12, 24 and 48 kHz, at most 48 kHz. Below 6 kHz the rate is unchanged,
    because resampling does not restore the band.

    Examples
    --------
    >>> [feature_rate_hz(rate) for rate in (8000, 16_000, 44_100, 47_998, 96_000)]
    [12000.0, 24000.0, 48000.0, 47998, 48000.0]
    """
    as_long = sample_rate_hz * FEATURE_NFFT / feature_nfft(sample_rate_hz)
    if abs(as_long / FEATURE_RATE_HZ - 1.0) <= RATE_TOLERANCE or sample_rate_hz < LEAST_RATE_HZ:
        return sample_rate_hz
    rates = (_FULL_RATE_HZ / 2**halvings for halvings in range(MOST_HALVINGS - 1, -1, -1))
    return next((rate for rate in rates if rate >= sample_rate_hz), _FULL_RATE_HZ)


def feature_steering(
    array: MicrophoneArray, bins: range, sample_rate_hz: float, nfft: int = FEATURE_NFFT
) -> Steering:
    r"""Return the beams in the thirty published azimuths.

    .. math:: w_k(\theta_i) = \overline{a_k(\theta_i)}, \qquad \theta_i = 90^\circ - i\, 180^\circ / 29

    Examples
    --------
    >>> feature_steering(MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]]), range(1, 16), 47_998).weights.shape
    (15, 2, 30)
    """
    return Steering.towards(array, bin_frequencies_hz(bins, sample_rate_hz, nfft), FEATURE_AZIMUTHS_RAD)


def pair_sum(
    matrices: Complex64Array, steering: Steering, order: tuple[int, ...] | None = None
) -> Complex128Array:
    r"""Return the complex sum over microphone pairs i < j from cross-spectra (bins, M, M).

    .. math:: S(\theta) = \sum_k \sum_{i<j} \overline{a_{k,i}(\theta)}\, Q_{k,ij}\, a_{k,j}(\theta)

    The channels are in `order`, or in the order of the array by default.
    """
    pairs = matrices * _pairs_mask(order or tuple(range(matrices.shape[2])))
    return steering.quadratic_form(steering.compress(pairs))


def segment_feature(sums: Complex128Array, n_frames: int, n_bins: int, n_microphones: int) -> FloatArray:
    r"""Return the modulus of summed pair sums per frame, bin and pair.

    .. math:: F(\theta) = \frac{1}{T K P} \Big| \sum_s S_s(\theta) \Big|, \qquad P = M (M - 1) / 2

    Shapes: sums (S, directions).

    Examples
    --------
    >>> segment_feature(np.array([[3.0 + 0j], [4j]]), n_frames=2, n_bins=1, n_microphones=2)
    array([2.5])
    """
    pairs = n_microphones * (n_microphones - 1) / 2
    return np.asarray(np.abs(np.add.reduce(sums)) / (n_frames * n_bins * pairs))


def published_feature(window: ArrayLike, array: MicrophoneArray, sample_rate_hz: float) -> FloatArray:
    r"""Return the published feature of one window, with zero-padded edge frames as in the released data.

    .. math:: F_s(\theta) = \frac{1}{T_s K P} \Big| \sum_{t \in s} \sum_k \sum_{i<j}
              \overline{a_{k,i}(\theta)}\, Z_{t,k,i}\, \overline{Z_{t,k,j}}\, a_{k,j}(\theta) \Big|

    Parameters
    ----------
    window : array_like, shape (n, M)
        About one second of sound, any unit; at least a frame of `feature_nfft` samples.
    array : MicrophoneArray
        One microphone per channel, in the order of the channels.
    sample_rate_hz : float
        Samples per second.

    Returns
    -------
    ndarray of float64, shape (60,)
        Segment 1 at thirty azimuths from left to right, then segment 2. With an odd number of frames the last
        one is omitted.

    Raises
    ------
    InvalidArgumentError
        On another shape, a window shorter than a frame, NaN or infinity.

    References
    ----------
    Y. Schulz, A. Mattar, T. Hehn and J. Kooij, "Hearing what you cannot see: acoustic vehicle detection
    around corners", IEEE Robotics and Automation Letters 6, 2021.

    Examples
    --------
    >>> array = MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]])
    >>> noise = np.random.default_rng(0).standard_normal(47_998)
    >>> feature = published_feature(np.stack([noise, noise], axis=1), array, 47_998)
    >>> feature.shape, bool(abs(feature[14] - feature[15]) < 1e-3)
    ((60,), True)
    """
    samples = finite_array("window", window, (None, array.n_microphones))
    rate = in_range("sample_rate_hz", sample_rate_hz, 0.0, np.inf, open_low=True, open_high=True)
    nfft = feature_nfft(rate)
    if len(samples) < nfft:
        raise InvalidArgumentError(f"window: expected at least {nfft} samples, got {len(samples)}")
    bins = band_bins(FEATURE_BAND_HZ, rate, nfft)
    spectra = scipy.signal.stft(samples, nperseg=nfft, axis=0)[2][bins.start : bins.stop]
    whitened = whiten(np.ascontiguousarray(spectra.transpose(2, 0, 1), np.complex64))
    length = len(whitened) // FEATURE_SEGMENTS
    with one_blas_thread():
        steering = feature_steering(array, bins, rate, nfft)
        parts = (whitened[i * length :][:length].transpose(1, 0, 2) for i in range(FEATURE_SEGMENTS))
        sums = [pair_sum(cross_spectra(part), steering) for part in parts]
    return np.concatenate([segment_feature(s[None], length, len(bins), array.n_microphones) for s in sums])


@lru_cache(maxsize=8)
def _pairs_mask(order: tuple[int, ...]) -> Float32Array:
    """Return a mask that is 1 if the row precedes the column in an order of the channels, otherwise 0."""
    place = np.argsort(order)
    mask = (place[:, None] < place[None]).astype(np.float32)
    mask.flags.writeable = False
    return mask
