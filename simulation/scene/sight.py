"""What a camera on the ego sees of the ground: between the edges of its image, with nothing in between."""

import numpy as np

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.ground.typing import BoolArray, FloatArray

from .junction import Site
from .occluders import hidden_by


def image_edges_rad(camera: PinholeCamera) -> tuple[float, float]:
    """Directions (right, left) of the edges of the image, seen from the camera.

    Examples
    --------
    >>> [round(float(edge), 3) for edge in image_edges_rad(PinholeCamera())]
    [-0.597, 0.597]
    """
    right, left = camera.off_axis(camera.azimuth([camera.width_px, 0.0])) + camera.yaw_rad
    return float(right), float(left)


def camera_sees(
    site: Site, camera: PinholeCamera, x_m: FloatArray, y_m: FloatArray, ego_x_m: float | FloatArray = 0.0
) -> BoolArray:
    """Tell when the camera sees a point that moves, shape (T,).

    Examples
    --------
    >>> from worldstate.simulation.scene.junction import site
    >>> x, y = np.array([8.0, 8.0, 2.0, -8.0]), np.array([3.0, 8.0, 2.5, 0.0])
    >>> camera_sees(site("SA1"), PinholeCamera(), x, y)
    array([ True, False, False, False])
    """
    eye = (ego_x_m + camera.position_m[0], camera.position_m[1])
    right_edge, left_edge = image_edges_rad(camera)
    direction = np.arctan2(y_m - eye[1], x_m - eye[0])
    pictured = (direction > right_edge) & (direction < left_edge)
    return np.asarray(
        pictured & _past_corners(site, x_m, y_m, eye) & ~hidden_by(site.occluders, x_m, y_m, eye)
    )


def _past_corners(
    site: Site, x_m: FloatArray, y_m: FloatArray, eye_m: tuple[float | FloatArray, float]
) -> BoolArray:
    """Tell when no corner stands before a point; in the open, and this side of the corners, none does."""
    right, left = site.sights_m(x_m, eye_m)
    return np.asarray(site.is_open | (x_m <= site.corner_ahead_m) | ((y_m > right) & (y_m < left)))
