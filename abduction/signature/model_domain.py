"""What a model was made for: the array, the sample rates, the feature and the ego's motion of its data."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from worldstate.ground.checks import freeze_arrays, in_range
from worldstate.ground.typing import FloatArray

EgoMotion = Literal["standing", "moving", "any"]


@dataclass(frozen=True, slots=True, eq=False)
class ModelDomain:
    """Of what the windows were made that a model was trained on, or that a table holds.

    Parameters
    ----------
    array : str
        Name of the microphone array.
    positions_m : ndarray, shape (M, 3)
        Its microphones in the order of the channels, `base_link` axes, metres.
    sample_rate_hz : (float, float)
        Lowest and highest rate with frames of 512; lower ones with frames shorter by as much count as these.
    band_hz : (float, float)
        Band of the feature.
    feature : str
        Name and version of the feature.
    ego_motion : {"standing", "moving", "any"}
        What the ego vehicle did.

    Raises
    ------
    InvalidArgumentError
        If the positions are no (M, 3) array of finite numbers or an interval is empty.

    Examples
    --------
    >>> ModelDomain("pair", [[0, 0.1, 0], [0, -0.1, 0]], (47e3, 49e3), (50, 1500), "f 1", "standing").extent_m
    (0.0, 0.2, 0.0)
    """

    array: str
    positions_m: FloatArray
    sample_rate_hz: tuple[float, float]
    band_hz: tuple[float, float]
    feature: str
    ego_motion: EgoMotion

    def __post_init__(self) -> None:
        freeze_arrays(self, positions_m=(None, 3))
        for name in ("sample_rate_hz", "band_hz"):
            low, high = getattr(self, name)
            in_range(name, low, 0.0, high)

    @property
    def extent_m(self) -> tuple[float, float, float]:
        """Extent of the array along x, y and z, metres."""
        x, y, z = np.ptp(self.positions_m, axis=0).tolist()
        return x, y, z
