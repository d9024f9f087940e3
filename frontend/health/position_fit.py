r"""The place of the array that the sound of a channel fits.

In any field of plane waves the sound at one place follows from that at the places around it. The best
linear guess under a diffuse field, whose coherence over a distance d is sin(kd) / (kd), from all other
microphones is

.. math:: \hat x_p = -\sum_{j \ne p} \frac{(\Gamma + \Lambda)^{-1}_{pj}}{(\Gamma + \Lambda)^{-1}_{pp}}\, x_j

and the score of channel m at place p is the coherence of x_m with that guess, m itself left out of it,

.. math:: S_{mp} = \frac{\sum_k \mathrm{Re}\, E[x_{k,m} \overline{\hat x_{k,p}}]}
                        {\sqrt{K \sum_k E|\hat x_{k,p}|^2}}

over K bins of whitened spectra. A healthy channel fits its own place best, an incoherent one fits nowhere,
one with crossed leads fits with the wrong sign, one in the wrong socket fits another place. Microphones that
are apart only in a direction in which no wave travels cannot be told apart, and need not be.

References
----------
The guess is kriging, or Gaussian process regression, with leave-one-out weights: C. Rasmussen and C.
Williams, Gaussian Processes for Machine Learning, 2006, section 5.4.2. Coherence: R. Cook et al., J. Acoust.
Soc. Am., 1955.
"""

import numpy as np

from worldstate.frontend.array.geometry import SPEED_OF_SOUND_M_S
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import BoolArray, Float32Array, FloatArray

# Incoherent power of a usable channel against the field's: delay mismatch and self-noise of real arrays.
_NOISE = 0.2
# The same for a channel that shall not be used to guess others.
_UNUSABLE = 1e3


def position_weights(
    array: MicrophoneArray,
    frequencies_hz: FloatArray,
    usable: BoolArray,
    speed_of_sound_m_s: float = SPEED_OF_SOUND_M_S,
) -> Float32Array:
    r"""Weights of all other microphones in the guess at every place.

    .. math:: w_{pj} = -\frac{(\Gamma + \Lambda)^{-1}_{pj}}{(\Gamma + \Lambda)^{-1}_{pp}}, \qquad
              \Gamma_{ij} = \frac{\sin(k d_{ij})}{k d_{ij}}

    Shapes: frequencies_hz (K,), usable (M,).

    Examples
    --------
    >>> array = MicrophoneArray([[0, 0.1, 0], [0, 0.0, 0], [0, -0.1, 0]])
    >>> position_weights(array, np.array([100.0]), np.ones(3, bool))[0, 1].round(2) + 0.0
    array([0.46, 0.  , 0.46], dtype=float32)
    """
    positions = array.positions_m
    distance = np.linalg.norm(positions[:, None] - positions, axis=-1)
    field = np.sinc(2.0 * frequencies_hz[:, None, None] * distance / speed_of_sound_m_s)
    inverse = np.linalg.inv(field + np.diag(np.where(usable, _NOISE, _UNUSABLE)))
    own = np.einsum("kmm->km", inverse)
    weights = -inverse / own[:, :, None]
    np.einsum("kmm->km", weights)[...] = 0.0
    return np.asarray(weights, np.float32)


def position_scores(coherence: Float32Array, weights: Float32Array) -> FloatArray:
    r"""Score every channel at every place, between -1 and 1.

    .. math:: S_{mp} = \frac{\sum_k \sum_{j \ne m} w_{k,pj} R_{k,jm}}
              {\sqrt{K \sum_k w_{k,p}^T R_k\, w_{k,p}}}

    Shapes: coherence (K, M, M), weights (K, M, M).

    Examples
    --------
    >>> array = MicrophoneArray([[0, 0.1, 0], [0, 0.0, 0], [0, -0.1, 0]])
    >>> weights = position_weights(array, np.array([100.0]), np.ones(3, bool))
    >>> position_scores(np.ones((1, 3, 3), np.float32), weights).diagonal().round(2)
    array([1., 1., 1.])
    """
    guessed = weights @ coherence
    power = (guessed * weights).sum(axis=(0, 2), dtype=np.float64)
    # A channel's own sound would always agree with itself.
    guessed -= np.einsum("kmm->km", coherence)[:, None, :] * weights
    agreement = guessed.sum(axis=0, dtype=np.float64).T
    floor = np.finfo(np.float32).tiny
    return np.asarray(agreement / np.sqrt(np.maximum(power, floor) * len(coherence)))
