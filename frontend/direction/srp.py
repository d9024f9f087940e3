r"""Steered response power with the phase transform (SRP-PHAT).

.. math:: P(\theta) = \frac{1}{T K M^2} \sum_{t,k}
          \Big| \sum_m \overline{a_{k,m}(\theta)}\, \frac{X_{t,k,m}}{|X_{t,k,m}|} \Big|^2

over T frames, K bins and M microphones: 1 for a single plane wave from theta, 1/M for noise that is
independent between microphones. The SRP of pyroomacoustics is M^2 / pairs = 2 M / (M - 1) times as large.
"""

import numpy as np

from worldstate.frontend.array.steering import Steering
from worldstate.frontend.spectra.phat import whiten
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
