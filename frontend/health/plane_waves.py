"""Plane waves from all round, against which the channels of a stream are compared."""

import numpy as np

from worldstate.frontend.array.geometry import SPEED_OF_SOUND_M_S
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import Complex64Array, Float32Array, FloatArray

# Sound of the own vehicle comes from below and is no fault of a microphone: with level waves alone, swaps
# were reported in every second recording of a moving ego.
_ELEVATIONS_DEG = (-60.0, -40.0, -20.0, 0.0, 20.0, 40.0)
# A third of the beam of 0.8 m at 1400 Hz.
_STEP_DEG = 7.5
# From here on the source is near, most often the own vehicle, and its wave is no plane one.
_STEEP = np.radians(30.0)
# Directions whose delays agree to this are one to the array: front and back, or a whole cone.
_SAME_S = 2e-6
# Sharpness of no agreement at all, far below that of one pair in one bin; keeps the logarithm finite.
SILENCE = 1e-12


class PlaneWaves:
    """Steering vectors of the directions that an array can tell apart."""

    def __init__(
        self,
        array: MicrophoneArray,
        frequencies_hz: FloatArray,
        speed_of_sound_m_s: float = SPEED_OF_SOUND_M_S,
    ) -> None:
        azimuth, elevation = _directions()
        delays = MicrophoneArray(array.centred_m).delays_s(azimuth, elevation, speed_of_sound_m_s)
        kept = np.unique(np.round(delays / _SAME_S), axis=0, return_index=True)[1]
        self.is_steep = np.abs(elevation[kept]) > _STEEP
        phase = -2j * np.pi * frequencies_hz[:, None, None] * delays[kept].T
        self.beams: Complex64Array = np.exp(phase).astype(np.complex64)

    def agreement(self, coherence: Complex64Array) -> Complex64Array:
        r"""Agreement of every channel with all others for a wave from every direction, (K, M, D).

        .. math:: g_{kmd} = \overline{a_{kmd}} \sum_{j \ne m} R_{kmj}\, a_{kjd}

        Shapes: coherence (K, M, M), its diagonal zero.
        """
        return np.asarray(self.beams.conj() * (coherence @ self.beams))


def direction_weights(agreement: Complex64Array) -> Float32Array:
    r"""Share of every direction in the sound, (D,): the square of its beam power, which sharpens the beams.

    .. math:: w_d \propto \max\Big(\sum_{km} \mathrm{Re}\, g_{kmd},\; 0\Big)^2
    """
    power = np.square(np.maximum(agreement.real.sum(axis=(0, 1)), 0.0))
    return np.asarray(power / max(float(power.sum()), np.finfo(np.float32).tiny))


def log_sharpness(agreement: Complex64Array) -> float:
    r"""Return how much the sound is concentrated in few directions, nats.

    .. math:: \ln \sum_d \max\Big(\frac12 \sum_{km} \mathrm{Re}\, g_{kmd},\; 0\Big)^2
    """
    power = 0.5 * np.maximum(agreement.real.sum(axis=(0, 1)), 0.0)
    return float(np.log(max(float(np.square(power).sum(dtype=np.float64)), SILENCE)))


def _directions() -> tuple[FloatArray, FloatArray]:
    """Azimuths and elevations about one step apart, (D,) each, mirrored about the x and y axes alike."""
    rows = []
    for elevation in np.radians(_ELEVATIONS_DEG):
        quarter = np.linspace(0.0, np.pi / 2, round(90.0 / _STEP_DEG * np.cos(elevation)) + 1)
        half = np.concatenate([quarter, np.pi - quarter[:-1]])
        azimuth = np.concatenate([half, -half[(half > 0.0) & (half < np.pi)]])
        rows.append(np.stack([azimuth, np.full(len(azimuth), elevation)]))
    azimuths, elevations = np.concatenate(rows, axis=1)
    return azimuths, elevations
