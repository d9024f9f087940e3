"""Geometry of microphones and far-field directions, in `base_link` axes (x forward, y left, z up)."""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground import FloatArray

SPEED_OF_SOUND_M_S = 343.0
"""Speed of sound in dry air at 20 degrees Celsius."""

Ambiguity = Literal["cone", "front-back", "up-down", "mirror", "none"]

# Extent along a principal axis, relative to the largest, below which an array is flat: a millimetre in a
# metre, the accuracy of mounting.
_FLAT = 1e-3
# Direction cosine, 10 degrees, above which a normal points along an axis of the vehicle.
_ALONG_AXIS = 0.985


def direction_vectors(azimuths_rad: ArrayLike, elevations_rad: ArrayLike = 0.0) -> FloatArray:
    r"""Return unit vectors towards far-field sources, shape (..., 3).

    .. math:: u = (\cos\phi\cos\theta,\; \cos\phi\sin\theta,\; \sin\phi)
    """
    azimuth, elevation = np.broadcast_arrays(
        np.asarray(azimuths_rad, dtype=np.float64), np.asarray(elevations_rad, dtype=np.float64)
    )
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


def nearest_spacings_m(positions_m: FloatArray) -> FloatArray:
    r"""Return the distance from every microphone to its nearest neighbour, metres.

    .. math:: d_m = \min_{j \ne m} \|p_m - p_j\|

    Shapes: positions_m (M, 3).

    Examples
    --------
    >>> nearest_spacings_m(np.array([[0, 0, 0], [0, 0.1, 0], [0, 0.3, 0]])).round(3)
    array([0.1, 0.1, 0.2])
    """
    distance = np.linalg.norm(positions_m[:, None] - positions_m[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    return np.asarray(distance.min(axis=1))


def ambiguity(positions_m: FloatArray) -> Ambiguity:
    r"""Return which directions an array of this shape cannot distinguish, whatever the algorithm.

    With the singular values :math:`s_1 \ge s_2 \ge s_3` of the centred positions and n the direction of the
    last, an array is linear for :math:`s_2 < 10^{-3} s_1` and else planar for :math:`s_3 < 10^{-3} s_1`,
    across the road for :math:`|n_x| > 0.985` and flat for :math:`|n_z| > 0.985`.

    Shapes: positions_m (M, 3).

    Examples
    --------
    >>> ambiguity(np.array([[0, 0, 0], [0, 1, 0], [0, 0, 1.0]]))
    'front-back'
    """
    # A linear array measures the angle to its axis only (`cone`). A planar one does not distinguish a
    # direction from its mirror image in the array plane: `front-back` if the plane is across the road,
    # `up-down` if it is horizontal, `mirror` if it is tilted or faces sideways. A three-dimensional array
    # has no mirror direction.
    spread, axes = np.linalg.svd(positions_m - positions_m.mean(axis=0), full_matrices=True)[1:]
    thickness = np.pad(spread, (0, 3 - len(spread)))
    if thickness[1] < _FLAT * thickness[0]:
        return "cone"
    if thickness[2] >= _FLAT * thickness[0]:
        return "none"
    normal = np.abs(axes[2])
    if normal[0] > _ALONG_AXIS:
        return "front-back"
    return "up-down" if normal[2] > _ALONG_AXIS else "mirror"
