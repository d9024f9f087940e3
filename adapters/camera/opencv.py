"""OpenCV where it is installed; it comes with the extra `vision`."""

from typing import Any

from worldstate.ground.errors import MissingExtraError


def opencv() -> Any:
    """Return the module `cv2`.

    Examples
    --------
    >>> opencv().__name__
    'cv2'
    """
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError("opencv-python-headless", "vision") from error
    return cv2
