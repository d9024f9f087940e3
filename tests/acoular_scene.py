"""Moving white sources in a free field, rendered by Acoular, and their positions at emission."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import brentq

from worldstate.frontend.array.microphone_array import MicrophoneArray

acoular = pytest.importorskip("acoular")

RATE = 47_998
SPEED_OF_SOUND_M_S = 343.0
Path = Callable[[float], np.ndarray]


def pass_by(time_s: float) -> np.ndarray:
    return np.array([10.0, 10.0 - 10.0 * time_s, 0.0])


def direct(time_s: float) -> np.ndarray:
    return np.array([40.0 - 10.0 * time_s, 0.0, 0.0])


def heard_at(path: Path, time_s: float) -> np.ndarray:
    """Return the position of the source at the emission of the sound that arrives now."""

    def late(emitted_s: float) -> float:
        return emitted_s + float(np.linalg.norm(path(emitted_s))) / SPEED_OF_SOUND_M_S - time_s

    return path(brentq(late, time_s - 1.0, time_s))


def render(array: MicrophoneArray, path: Path, seconds: float, seed: int) -> np.ndarray:
    """Return the sound at the microphones, shape (n, M)."""
    acoular.config.global_caching = "none"
    n = round(seconds * RATE)
    source = acoular.MovingPointSource(
        signal=acoular.WNoiseGenerator(sample_freq=RATE, num_samples=n, seed=seed),
        mics=acoular.MicGeom(pos_total=array.positions_m.T),
        trajectory=acoular.Trajectory(
            points={t: tuple(path(t)) for t in np.arange(-1.0, seconds + 1.1, 0.5)}
        ),
    )
    return np.concatenate(list(source.result(8192)))
