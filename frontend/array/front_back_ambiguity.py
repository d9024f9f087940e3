r"""Mirror direction of a planar or linear array (front-back ambiguity).

A planar array has the same delays for u and for its mirror image in the array plane, u' = u - 2 (u . n) n
with the unit normal n; a linear one with axis a has the same delays on the whole cone around it, which meets
the horizontal plane again at u' = 2 (u . a) a - u if the axis is level.
"""

import math

import numpy as np

from worldstate.ground.typing import FloatArray
from worldstate.ground.values import NotUsable

from .microphone_array import MicrophoneArray

# Horizontal part of a unit axis below which it is vertical and its cone holds every azimuth: rounding of the
# SVD.
_LEVEL = 1e-6


def mirror_reflection(array: MicrophoneArray) -> FloatArray | NotUsable:
    r"""Return the matrix that maps a horizontal direction to its mirror direction, shape (3, 3).

    .. math:: T = I - 2 n n^T \text{ (planar)}, \qquad T = 2 a a^T - I \text{ (linear, level)}
    """
    # Delays depend on u through the products p . u only, which T preserves.
    if array.ambiguity == "none":
        return NotUsable("a three-dimensional array has no mirror direction")
    if array.ambiguity == "up-down":
        return NotUsable("the mirror direction is up or down, at the same azimuth")
    axes = np.linalg.svd(array.centred_m, full_matrices=True)[2]
    if array.ambiguity != "cone":
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
