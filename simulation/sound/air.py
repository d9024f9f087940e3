"""What air and ground take from and give to a path, per octave band."""

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.typing import FloatArray
from worldstate.simulation.scene.octave_bands import OCTAVES_HZ

from .diffraction import SPEED_OF_SOUND_MPS

REFERENCE_KELVIN, TRIPLE_POINT_KELVIN = 293.15, 273.16
STREET_KELVIN, STREET_HUMIDITY = 283.15, 70.0
ROAD_REFLECTION = 0.9  # pressure; dense asphalt and paving
SMALLEST_LENGTH_M = 0.1


def absorption_db_per_m(
    frequency_hz: ArrayLike, kelvin: float = STREET_KELVIN, humidity_percent: float = STREET_HUMIDITY
) -> FloatArray:
    r"""Atmospheric absorption of pure tones at sea level.

    .. math:: \alpha = 8.686 f^2 \Big[1.84 \cdot 10^{-11} \tau^{1/2} + \tau^{-5/2} \Big(
              \frac{0.01275\, e^{-2239.1 / T}}{f_{rO} + f^2 / f_{rO}} +
              \frac{0.1068\, e^{-3352 / T}}{f_{rN} + f^2 / f_{rN}}\Big)\Big], \qquad \tau = T / T_{20}

    References
    ----------
    ISO 9613-1:1993, equations (3) to (5) and annex B.
    """
    f2 = np.asarray(frequency_hz, dtype=np.float64) ** 2
    tau = kelvin / REFERENCE_KELVIN
    saturation = 10.0 ** (-6.8346 * (TRIPLE_POINT_KELVIN / kelvin) ** 1.261 + 4.6151)
    water = humidity_percent * saturation  # molar concentration of water vapour, per cent
    oxygen_hz = 24.0 + 4.04e4 * water * (0.02 + water) / (0.391 + water)
    nitrogen_hz = tau**-0.5 * (9.0 + 280.0 * water * np.exp(-4.170 * (tau ** (-1.0 / 3.0) - 1.0)))
    relaxed = 0.01275 * np.exp(-2239.1 / kelvin) / (oxygen_hz + f2 / oxygen_hz)
    relaxed = relaxed + 0.1068 * np.exp(-3352.0 / kelvin) / (nitrogen_hz + f2 / nitrogen_hz)
    return np.asarray(8.686 * f2 * (1.84e-11 * tau**0.5 + tau**-2.5 * relaxed))


OCTAVE_DB_PER_M = absorption_db_per_m(OCTAVES_HZ)


def air_gain(length_m: FloatArray) -> FloatArray:
    """Amplitude that is left after `length_m` (T,) through air, shape (T, 8)."""
    return np.asarray(10.0 ** (-length_m[:, None] * OCTAVE_DB_PER_M / 20.0))


def ground_gain(length_m: FloatArray, source_m: float, receiver_m: float) -> FloatArray:
    r"""Amplitude by the road's reflection per octave, against the energetic sum of both ways, shape (T, 8).

    .. math:: g^2 = 1 + \frac{2 \rho}{1 + \rho^2} \overline{\cos k \Delta}, \qquad
              \Delta \approx 2 h_s h_r / r

    with the mean over the octave's band. The source levels already stand over hard ground, which doubles the
    energy; what is left is the interference: +3 dB where both ways agree, 0 dB far above.

    Shapes: length_m (T,).
    """
    detour = 2.0 * source_m * receiver_m / np.maximum(length_m, SMALLEST_LENGTH_M)
    phase = 2.0 * np.pi * detour[:, None] * OCTAVES_HZ / SPEED_OF_SOUND_MPS
    low, high = phase / np.sqrt(2.0), phase * np.sqrt(2.0)
    mean_cosine = (np.sin(high) - np.sin(low)) / np.maximum(high - low, 1e-9)
    share = 2.0 * ROAD_REFLECTION / (1.0 + ROAD_REFLECTION**2)
    return np.asarray(np.sqrt(1.0 + share * mean_cosine))
