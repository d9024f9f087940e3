"""Screen attenuation behind a corner: Maekawa's chart as Kurze and Anderson put it into a formula."""

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.typing import FloatArray

SPEED_OF_SOUND_MPS = 343.0


def screen_attenuation_db(detour_m: ArrayLike, frequency_hz: ArrayLike, cap_db: float = 40.0) -> FloatArray:
    r"""Attenuation by a thin screen beyond spherical spreading.

    .. math:: A = 5 + 20\log_{10}\frac{\sqrt{2\pi N}}{\tanh\sqrt{2\pi N}}, \qquad N = 2\delta f / c

    References
    ----------
    U. J. Kurze and G. S. Anderson, "Sound attenuation by barriers", Applied Acoustics 4 (1971), eq. (13).
    """
    # In the light (N < 0) tanh turns into tan and the attenuation falls to 0 dB at N about -0.2, so it is
    # continuous through the shadow boundary, where it is 5 dB.
    fresnel = 2.0 * np.asarray(detour_m) * np.asarray(frequency_hz) / SPEED_OF_SOUND_MPS
    root = np.sqrt(2.0 * np.pi * np.maximum(np.abs(fresnel), 1e-9))
    shadow = 20.0 * np.log10(root / np.tanh(root))
    # tan is only needed down to N = -0.2; clipping keeps its argument far from the pole.
    light = 20.0 * np.log10(root / np.tan(np.minimum(root, 1.2)))
    attenuation = 5.0 + np.where(fresnel >= 0.0, shadow, np.where(root < 1.2, light, -5.0))
    return np.asarray(np.clip(attenuation, 0.0, cap_db))
