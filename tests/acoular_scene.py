"""Moving sources in a free field, rendered by Acoular, and their positions at emission."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import brentq
from traits.api import Any

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

    return path(brentq(late, time_s - 2.0, time_s))


class Samples(acoular.SignalGenerator):
    """A given signal."""

    samples = Any()

    def _get_digest(self) -> str:
        return str(hash(self.samples.tobytes()))

    def signal(self) -> np.ndarray:
        return self.samples


def render(
    array: MicrophoneArray, path: Path, seconds: float, seed: int = 0, signal: Samples | None = None
) -> np.ndarray:
    """Return the sound of a signal or of white noise at the microphones, shape (n, M)."""
    acoular.config.global_caching = "none"
    noise = acoular.WNoiseGenerator(sample_freq=RATE, num_samples=round(seconds * RATE), seed=seed)
    # The trajectory is a spline, so it needs knots before the start and after the end.
    points = {t: tuple(path(t)) for t in np.arange(-1.0, seconds + 1.1, 0.5)}
    geometry, trajectory = acoular.MicGeom(pos_total=array.positions_m.T), acoular.Trajectory(points=points)
    source = acoular.MovingPointSource(signal=signal or noise, mics=geometry, trajectory=trajectory)
    return np.concatenate(list(source.result(8192)))
