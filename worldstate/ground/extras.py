"""Optional packages, imported on use; the error for a missing package contains its extra."""

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from .errors import MissingExtraError

# Import name: name on the package index, and the extra that installs it.
EXTRAS = {
    "cv2": ("opencv-python-headless", "vision"),
    "distributed": ("distributed", "dask"),
    "filterpy": ("filterpy", "smoothing"),
    "foxglove": ("foxglove-sdk", "foxglove"),
    "gtsam": ("gtsam", "gtsam"),
    "lz4": ("lz4", "ros"),
    "matplotlib": ("matplotlib", "plot"),
    "mcap": ("mcap", "mcap"),
    "networkx": ("networkx", "graph"),
    "onnxruntime": ("onnxruntime", "onnx"),
    "osi3": ("osi-python", "osi"),
    "pandas": ("pandas", "pandas"),
    "pyarrow": ("pyarrow", "corpus"),
    "rerun": ("rerun-sdk", "rerun"),
    "rich": ("rich", "cli"),
    "rosbags": ("rosbags", "ros"),
    "shtab": ("shtab", "cli"),
    "sklearn": ("scikit-learn", "train"),
    "sounddevice": ("sounddevice", "live"),
    "websockets": ("websockets", "web"),
    "zstandard": ("zstandard", "ros"),
}


def optional(module: str) -> Any:
    """Return an optional module, such as `sklearn.isotonic`.

    Raises
    ------
    MissingExtraError
        If its package is not installed.

    Examples
    --------
    >>> optional("matplotlib.figure").Figure.__name__
    'Figure'
    """
    check_extra(module)
    return import_module(module)


def check_extra(*modules: str) -> None:
    """Raise an error before work begins if an optional package is missing; nothing is imported.

    Raises
    ------
    MissingExtraError
        If a package is not installed.

    Examples
    --------
    >>> check_extra("sklearn", "matplotlib")
    """
    for module in modules:
        if not has_extra(module):
            raise MissingExtraError(*EXTRAS[module.partition(".")[0]])


def has_extra(module: str) -> bool:
    """Return whether the package of an optional module is installed; nothing is imported.

    Examples
    --------
    >>> has_extra("sklearn.isotonic")
    True
    """
    return find_spec(module.partition(".")[0]) is not None
