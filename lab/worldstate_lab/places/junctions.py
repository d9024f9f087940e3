"""The two junctions and the array of M. Jeon et al., and both junctions as they are simulated.

"Non-Line-of-Sight Vehicle Localization Based on Sound", IEEE Transactions on Intelligent Transportation
Systems, 2025: facts of the publication's maps. How far ahead vehicles cross follows from where they come into
view, 4.5 m and 4.0 m aside.
"""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import FloatArray
from worldstate.simulation.scene.junction import Site

from .spatial_spectra import AZIMUTHS_RAD
from .spectrum_model import SpectrumModel
from .street_walls import StreetWalls

_ASIDE_M, _AHEAD_M = (0.338, 0.162, -0.162, -0.338), (-0.192, -0.06, 0.06, 0.192)
ROOF_ARRAY = MicrophoneArray(np.array([[x, y, 0.0] for x in _AHEAD_M for y in _ASIDE_M]), "roof array of 16")
# 50 to 2000 Hz of frames of 512 samples at 48 kHz, and of 64 at 6 kHz, at which passes are simulated.
RATE_HZ, NFFT, BINS = 6000.0, 64, range(1, 22)
FREQUENCIES_HZ: FloatArray = np.array(BINS) * RATE_HZ / NFFT
WALLS: Mapping[str, StreetWalls] = MappingProxyType(
    {
        "Site1": StreetWalls(4.45, 2.8, 2.8, 7.15, facing_m=9.9),
        "Site2": StreetWalls(4.5, 2.78, 2.78, 6.5),
    }
)
# Both lanes lie .75 m beside the middle that the model is given.
SIMULATED: Mapping[str, Site] = MappingProxyType(
    {
        "Site1": Site("Site1", 2.8, 2.8, 4.45, 9.9, 2.8, 2.8, 3.0, verge_m=1.2, side_order=8),
        "Site2": Site("Site2", 2.78, 2.78, 4.5, None, 2.78, 2.78, 3.0, verge_m=0.5, side_order=8),
    }
)


def place_models() -> dict[str, SpectrumModel]:
    """Return what is expected at both junctions."""
    return {
        name: SpectrumModel.of(walls, ROOF_ARRAY, AZIMUTHS_RAD, FREQUENCIES_HZ)
        for name, walls in WALLS.items()
    }
