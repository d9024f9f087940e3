r"""Steered response power with the phase transform (SRP-PHAT).

.. math:: P(\theta) = \frac{1}{T K M^2} \sum_{t,k}
          \Big| \sum_m \overline{a_{k,m}(\theta)}\, \frac{X_{t,k,m}}{|X_{t,k,m}|} \Big|^2

over T frames, K bins and M microphones: 1 for a single plane wave from theta, 1/M for noise that is
independent between microphones. The SRP of pyroomacoustics is M^2 / pairs = 2 M / (M - 1) times as large.
"""

from collections.abc import Sequence

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.steering import Steering
from worldstate.frontend.spectra.stft import whiten
from worldstate.ground.checks import check_shape
from worldstate.ground.typing import Complex64Array, FloatArray


def steered_power(whitened: Complex64Array, steering: Steering) -> FloatArray:
    r"""Sum the beam powers over frames and bins, the part of SRP that adds up over a running window.

    .. math:: S(\theta) = \sum_{t,k} \Big| \sum_m \overline{a_{k,m}(\theta)}\, Z_{t,k,m} \Big|^2

    Parameters
    ----------
    whitened : ndarray of complex64, shape (frames, bins, M)
        Spectra Z of modulus one.
    steering : Steering
        Beams for the same bins.

    Returns
    -------
    ndarray of float64, shape (directions,)
        Sum of the squared moduli of the beams, at most frames x bins x M^2.

    References
    ----------
    J. DiBiase, H. Silverman and M. Brandstein, "Robust localization in reverberant rooms", in *Microphone
    Arrays*, 2001.

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import MicrophoneArray
    >>> steering = Steering.towards(MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]]), [500.0], [0.0, 0.5])
    >>> steered_power(np.ones((3, 1, 2), np.complex64), steering).round(1)
    array([12. ,  9.8])
    """
    return np.asarray(steering.quadratic_form(steering.covariance(whitened)).real)


def normalised(total: FloatArray, n_frames: int, n_bins: int, n_microphones: int) -> FloatArray:
    r"""Scale a sum of beam powers to 0..1; negative round-off is set to zero.

    .. math:: P(\theta) = \frac{\max(S(\theta), 0)}{T K M^2}

    Shapes: total (directions,).

    Examples
    --------
    >>> normalised(np.array([8.0, 4.0]), n_frames=1, n_bins=2, n_microphones=2)
    array([1. , 0.5])
    """
    return np.asarray(np.maximum(total, 0.0) / (n_frames * n_bins * n_microphones**2))


def srp_phat(spectra: Complex64Array, steering: Steering) -> FloatArray:
    r"""Compute SRP-PHAT of a set of frames: 1 for a single plane wave, 1/M for independent noise.

    .. math:: P(\theta) = \frac{1}{T K M^2} \sum_{t,k}
              \Big| \sum_m \overline{a_{k,m}(\theta)}\, \frac{X_{t,k,m}}{|X_{t,k,m}|} \Big|^2

    Parameters
    ----------
    spectra : ndarray of complex64, shape (frames, bins, M)
        STFT of the microphones, at least one frame, any unit.
    steering : Steering
        Beams for the same bins.

    Returns
    -------
    ndarray of float64, shape (directions,)
        Between 0 and 1.

    Raises
    ------
    InvalidArgumentError
        If the spectra have other axes or another number of bins.

    References
    ----------
    J. DiBiase, H. Silverman and M. Brandstein, "Robust localization in reverberant rooms", in *Microphone
    Arrays*, 2001.

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import MicrophoneArray
    >>> array = MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]])
    >>> steering = Steering.towards(array, [500.0], [-0.5, 0.0, 0.5])
    >>> plane_wave = array.steering(500.0, 0.5).transpose(2, 0, 1).astype(np.complex64)
    >>> srp_phat(plane_wave, steering).round(3)
    array([0.408, 0.819, 1.   ])
    """
    check_shape("spectra", spectra.shape, (None, len(steering.weights), None))
    n_frames, n_bins, n_microphones = spectra.shape
    return normalised(steered_power(whiten(spectra), steering), n_frames, n_bins, n_microphones)


# What three deviations reach in all directions together is called noise only up to this share of its excess:
# a vehicle in view, heard by 4 microphones, has a lower peak in a quarter of the hops, and a bearing of
# noise that is let through states 50 degrees, for it has many peaks.
_DEVIATIONS, _SHARE = 3.0, 0.6
_ALL_ROUND_RAD = np.radians(np.arange(-180.0, 180.0, 10.0))


def noise_prominence(
    rows: Sequence[Steering],
    array: MicrophoneArray,
    frequencies_hz: FloatArray,
    n_frames: float,
) -> float:
    r"""Return the peak-to-median ratio up to which a peak is taken for noise.

    Sound that comes from all horizontal directions alike is the noise of a street whose spectrum is least
    flat. After the phase transform the power of a beam in a frame and bin is about exponentially distributed,
    so that the mean over T frames and K bins scatters by epsilon:

    .. math:: D(\theta) = \frac{1}{K} \sum_k d_k(\theta), \qquad
              d_k(\theta) = \Big\langle \frac{|a_k(\theta)^H a_k(\phi)|^2}{M^2} \Big\rangle_\phi, \qquad
              \epsilon = \max_\theta \frac{\sqrt{\sum_k d_k^2(\theta)}}{\sqrt{T} \sum_k d_k(\theta)},

    .. math:: \rho_0 = 1 + 0.6 \Big( (1 + 3 \epsilon)\, \frac{\max_\theta D}{\mathrm{med}_\theta D} - 1 \Big)
    """
    horizon = array.steering(frequencies_hz, _ALL_ROUND_RAD).astype(np.complex64)
    by_row = np.array([_heard(row, horizon) for row in rows])
    diffuse = by_row.mean(axis=1).max(axis=0)
    # Of the last row: rows differ little in how their bins share the power.
    scatter = np.linalg.norm(by_row[-1], axis=0) / (np.sqrt(n_frames) * by_row[-1].sum(axis=0))
    reached = diffuse.max() / np.median(diffuse) * (1.0 + _DEVIATIONS * scatter.max())
    return float(1.0 + _SHARE * (reached - 1.0))


def _heard(row: Steering, waves: Complex64Array) -> FloatArray:
    """Return the mean power per bin and beam of plane waves (bins, M, waves), up to a factor."""
    return np.asarray(row.power_within(waves) / waves.shape[2])
