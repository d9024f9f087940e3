"""Geometry of microphones and far-field directions, in `base_link` axes (x forward, y left, z up)."""

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground import FloatArray, NotUsable

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


# Horizontal part of a unit axis below which it is vertical and its cone holds every azimuth: rounding of the
# SVD.
_LEVEL = 1e-6


def mirror_reflection(positions_m: FloatArray) -> FloatArray | NotUsable:
    r"""Return the matrix that maps a horizontal direction to its mirror direction, shape (3, 3).

    .. math:: T = I - 2 n n^T \text{ (planar)}, \qquad T = 2 a a^T - I \text{ (linear, level)}

    A planar array has the same delays for u and for its mirror image in the array plane, with the unit normal
    n (front-back ambiguity); a linear one with axis a has the same delays on the whole cone around it, which
    meets the horizontal plane again if the axis is level.

    Shapes: positions_m (M, 3).
    """
    # Delays depend on u through the products p . u only, which T preserves.
    kind = ambiguity(positions_m)
    if kind == "none":
        return NotUsable("a three-dimensional array has no mirror direction")
    if kind == "up-down":
        return NotUsable("the mirror direction is up or down, at the same azimuth")
    axes = np.linalg.svd(positions_m - positions_m.mean(axis=0), full_matrices=True)[2]
    if kind != "cone":
        normal = axes[2]
        return np.asarray(np.eye(3) - 2.0 * np.outer(normal, normal))
    axis = axes[0]
    if math.hypot(axis[0], axis[1]) < _LEVEL:
        return NotUsable("a vertical line of microphones cannot distinguish azimuths")
    return np.asarray(2.0 * np.outer(axis, axis) - np.eye(3))


def mirror_azimuth_rad(reflection: FloatArray | NotUsable, azimuth_rad: float) -> float | NotUsable:
    r"""Return the azimuth of the mirror direction, in (-pi, pi].

    .. math:: \theta' = \mathrm{atan2}(u'_y, u'_x), \qquad u' = T\, (\cos\theta, \sin\theta, 0)^T

    Shapes: reflection (3, 3).
    """
    if isinstance(reflection, NotUsable):
        return reflection
    x, y, _ = reflection @ (math.cos(azimuth_rad), math.sin(azimuth_rad), 0.0)
    return math.atan2(y, x)
