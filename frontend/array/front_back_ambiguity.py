r"""The other direction that an array cannot tell from a bearing: said, not hidden.

A planar array hears u and its mirror image in the array plane alike, u' = u - 2 (u . n) n with the unit
normal n; a linear one with axis a hears the whole cone around it, which meets the horizontal plane again at
u' = 2 (u . a) a - u if the axis is level.
"""

import math

import numpy as np

from worldstate.ground.typing import FloatArray
from worldstate.ground.values import NotUsable

from .microphone_array import MicrophoneArray

# Horizontal part of an axis below which a cone holds every azimuth.
_LEVEL = 1e-6


def mirror_reflection(array: MicrophoneArray) -> FloatArray | NotUsable:
    r"""Matrix that turns a horizontal direction into its twin, shape (3, 3).

    .. math:: T = I - 2 n n^T \text{ (planar)}, \qquad T = 2 a a^T - I \text{ (linear, level)}

    References
    ----------
    A. S. Householder, "Unitary triangularization of a nonsymmetric matrix", J. ACM 5, 1958 (the reflection).
    Derived here: delays hold u in the products p . u only, which T leaves alone.

    Examples
    --------
    >>> array = MicrophoneArray([[0, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    >>> mirror_reflection(array).round(3) + 0.0
    array([[-1.,  0.,  0.],
           [ 0.,  1.,  0.],
           [ 0.,  0.,  1.]])
    """
    # Not usable where there is none in another azimuth, or where every azimuth is one.
    if array.ambiguity == "none":
        return NotUsable("a three-dimensional array has no twin directions")
    if array.ambiguity == "up-down":
        return NotUsable("the twin is up or down, at the same azimuth")
    axes = np.linalg.svd(array.centred_m, full_matrices=True)[2]
    if array.ambiguity != "cone":
        normal = axes[2]
        return np.asarray(np.eye(3) - 2.0 * np.outer(normal, normal))
    axis = axes[0]
    if math.hypot(axis[0], axis[1]) < _LEVEL:
        return NotUsable("a vertical line of microphones hears every azimuth alike")
    return np.asarray(2.0 * np.outer(axis, axis) - np.eye(3))


def mirror_azimuth_rad(reflection: FloatArray | NotUsable, azimuth_rad: float) -> float | NotUsable:
    r"""Azimuth that sounds the same as this one, in (-pi, pi].

    .. math:: \theta' = \mathrm{atan2}(u'_y, u'_x), \qquad u' = T\, (\cos\theta, \sin\theta, 0)^T

    Shapes: reflection (3, 3).

    Examples
    --------
    >>> front_back = np.diag([-1.0, 1.0, 1.0])
    >>> round(math.degrees(mirror_azimuth_rad(front_back, math.radians(30.0))), 6)
    150.0
    """
    if isinstance(reflection, NotUsable):
        return reflection
    x, y, _ = reflection @ (math.cos(azimuth_rad), math.sin(azimuth_rad), 0.0)
    return math.atan2(y, x)
