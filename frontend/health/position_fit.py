r"""The position in the array that the sound of a channel fits.

In any field of plane waves the sound at one position follows from that at the positions around it. The best
linear prediction in a diffuse field, whose coherence over a distance d is sin(kd) / (kd), from all other
microphones is

.. math:: \hat x_p = -\sum_{j \ne p} \frac{(\Gamma + \Lambda)^{-1}_{pj}}{(\Gamma + \Lambda)^{-1}_{pp}}\, x_j

and the score of channel m at position p is the coherence of x_m with that prediction, m itself left out,

.. math:: S_{mp} = \frac{\sum_k \mathrm{Re}\, E[x_{k,m} \overline{\hat x_{k,p}}]}
                        {\sqrt{K \sum_k E|\hat x_{k,p}|^2}}

over K bins of whitened spectra. A usable channel fits its own position best, an incoherent one fits none, one
with crossed leads fits with the opposite sign, one in the wrong socket fits another position. Microphones
that differ only in a direction in which no wave travels cannot be distinguished, and need not be.

References
----------
The prediction is kriging, or Gaussian process regression, with leave-one-out weights: C. Rasmussen and C.
Williams, Gaussian Processes for Machine Learning, 2006, section 5.4.2. Coherence: R. Cook et al., J. Acoust.
Soc. Am., 1955.
"""

import numpy as np

from worldstate.frontend.array.geometry import SPEED_OF_SOUND_M_S
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import BoolArray, Float32Array, FloatArray

# Incoherent power of a usable channel against the field's: delay mismatch and self-noise of real arrays.
_NOISE = 0.2
# The same for a channel that is not used to predict others: its weight becomes negligible.
_UNUSABLE = 1e3


def position_weights(
    array: MicrophoneArray,
    frequencies_hz: FloatArray,
    usable: BoolArray,
    speed_of_sound_m_s: float = SPEED_OF_SOUND_M_S,
) -> Float32Array:
    r"""Weights of all other microphones in the prediction at every position.

    .. math:: w_{pj} = -\frac{(\Gamma + \Lambda)^{-1}_{pj}}{(\Gamma + \Lambda)^{-1}_{pp}}, \qquad
              \Gamma_{ij} = \frac{\sin(k d_{ij})}{k d_{ij}}

    Shapes: frequencies_hz (K,), usable (M,).
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
    r"""Score every channel at every position, between -1 and 1.

    .. math:: S_{mp} = \frac{\sum_k \sum_{j \ne m} w_{k,pj} R_{k,jm}}
              {\sqrt{K \sum_k w_{k,p}^T R_k\, w_{k,p}}}

    Shapes: coherence (K, M, M), weights (K, M, M).
    """
    predicted = weights @ coherence
    power = (predicted * weights).sum(axis=(0, 2), dtype=np.float64)
    # A channel that took part in the prediction would agree with itself.
    predicted -= np.einsum("kmm->km", coherence)[:, None, :] * weights
    agreement = predicted.sum(axis=0, dtype=np.float64).T
    floor = np.finfo(np.float32).tiny
    return np.asarray(agreement / np.sqrt(np.maximum(power, floor) * len(coherence)))
