r"""Split a spatial covariance into below-horizon and above-horizon diffuse fields.

The own vehicle is below its microphones, the street at their height and above. The part of each bin's
covariance between different microphones is fitted by two isotropic fields (B. F. Cron and C. H. Sherman, J.
Acoust. Soc. Am. 34, 1962),

.. math:: \hat p = \arg\min_p \sum_{i \ne j} |R_{ij} - p_b\, \Gamma^b_{ij} - p_s\, \Gamma^s_{ij}|^2,
          \qquad q = \frac{\sum_k \Delta_k\, p_{b,k}}{\sum_k \Delta_k\, (p_{b,k} + p_{s,k})},

plane waves from all azimuths and from elevations well under the horizon (b) or from the horizon upwards (s).
Bins are weighted by the determinant of their normal equations: where the array is small against the
wavelength the two fields are alike. Wind and sensor noise are on the diagonal only and have no effect.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.frontend.array.geometry import SPEED_OF_SOUND_M_S
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import Complex64Array, Float32Array, FloatArray

# Elevations of the two fields: the body of the vehicle is well below a roof array, sources and facades are at
# its height and above.
_BELOW_DEG, _STREET_DEG = (-60.0, -50.0, -40.0, -30.0, -20.0), (0.0, 10.0, 20.0, 30.0)
_AZIMUTHS_RAD = np.radians(np.arange(-180.0, 180.0, 5.0))
# Least 1 - cos^2 of the angle between the fields at which they can be separated: 0.95 for the roof array, 0.1
# for a horizontal line.
_LEAST_CONTRAST = 0.2
_TINY = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class ElevationSplit:
    """Separate the noise of the own vehicle from that of the street by elevation."""

    # shape (bins, 2 M^2): Combinations of the model fields, real and imaginary parts in turn, that give the
    # power of one field times the determinant.
    below: Float32Array
    street: Float32Array
    is_separable: bool  # Whether the array has the vertical extent for it

    @classmethod
    def of(
        cls,
        array: MicrophoneArray,
        frequencies_hz: ArrayLike,
        speed_of_sound_m_s: float = SPEED_OF_SOUND_M_S,
    ) -> "ElevationSplit":
        r"""Build the model fields of an array at the frequencies of its bins.

        .. math:: \Gamma = \langle a a^H \rangle \text{ off the diagonal}, \qquad
                  w_b = G_{ss} \Gamma^b - G_{bs} \Gamma^s, \quad w_s = G_{bb} \Gamma^s - G_{bs} \Gamma^b
        """
        # Means over the directions of each field, with G their inner products: the inner product of w with R
        # is the power times the determinant.
        b, s = (_field(array, frequencies_hz, el, speed_of_sound_m_s) for el in (_BELOW_DEG, _STREET_DEG))
        bb, ss, bs = (np.einsum("kn,kn->k", x, y)[:, None] for x, y in ((b, b), (s, s), (b, s)))
        contrast = float((bb * ss - bs**2).sum() / max(float((bb * ss).sum()), _TINY))
        below, street = ss * b - bs * s, bb * s - bs * b
        scale = 1.0 / max(float(np.abs(below).max()), _TINY)
        below, street = (np.ascontiguousarray(scale * x, np.float32) for x in (below, street))
        return cls(below, street, is_separable=contrast >= _LEAST_CONTRAST)

    def powers(self, covariance: Complex64Array) -> FloatArray:
        r"""Return the powers below and above the horizon; below only, if the array cannot separate them.

        .. math:: P_b = \sum_k \Delta_k\, \hat p_{b,k}, \qquad P_s = \sum_k \Delta_k\, \hat p_{s,k}
        """
        if not self.is_separable:
            return np.array([1.0, 0.0])
        parts = covariance.reshape(len(covariance), -1).view(np.float32)
        return np.array([np.vdot(parts, self.below), np.vdot(parts, self.street)], np.float64)


def share_of(below: float, street: float) -> float:
    r"""Return the share of the first power; negative estimates count as zero.

    .. math:: q = \frac{\max(P_b, 0)}{\max(P_b, 0) + \max(P_s, 0)}

    Examples
    --------
    >>> share_of(3.0, 1.0), share_of(-1.0, 2.0), share_of(1.0, -0.1), share_of(0.0, 0.0)
    (0.75, 0.0, 1.0, 0.0)
    """
    return float(below / (below + max(street, 0.0))) if below > 0.0 else 0.0


def _field(
    array: MicrophoneArray, frequencies_hz: ArrayLike, elevations_deg: tuple[float, ...], speed: float
) -> FloatArray:
    """Covariance between different microphones of plane waves at some elevations, (bins, 2 M^2)."""
    azimuths, elevations = np.meshgrid(_AZIMUTHS_RAD, np.radians(elevations_deg))
    A = array.steering(frequencies_hz, azimuths.ravel(), elevations.ravel(), speed)
    field = A @ A.conj().transpose(0, 2, 1) / A.shape[2]
    field[:, np.arange(array.n_microphones), np.arange(array.n_microphones)] = 0.0
    return np.asarray(np.ascontiguousarray(field.reshape(len(field), -1)).view(np.float64))
