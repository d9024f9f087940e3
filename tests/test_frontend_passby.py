"""Moving sources rendered by acoular: a pass-by for the bearing, a direct approach for looming."""

from collections.abc import Callable

import acoular
import numpy as np
import pytest
from scipy.optimize import brentq

from worldstate.frontend.array import MicrophoneArray, roof_array_56
from worldstate.frontend.looming import Looming
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.stream import FrontEnd

RATE = 47_998
SPEED_OF_SOUND_M_S = 343.0
Path = Callable[[float], np.ndarray]


def pass_by(time_s: float) -> np.ndarray:
    return np.array([10.0, 10.0 - 10.0 * time_s, 0.0])


def direct(time_s: float) -> np.ndarray:
    return np.array([40.0 - 10.0 * time_s, 0.0, 0.0])


def heard_at(path: Path, time_s: float) -> np.ndarray:
    """Place where the source was when it emitted what arrives now."""

    def late(emitted_s: float) -> float:
        return emitted_s + float(np.linalg.norm(path(emitted_s))) / SPEED_OF_SOUND_M_S - time_s

    return path(brentq(late, time_s - 1.0, time_s))


def render(array: MicrophoneArray, path: Path, seconds: float, seed: int) -> np.ndarray:
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


def test_bearing_of_a_pass_by() -> None:
    array = MicrophoneArray(roof_array_56().positions_m[::4])
    sound = render(array, pass_by, 2.0, seed=1)
    sound += 0.02 * np.random.default_rng(0).standard_normal(sound.shape)
    middle = array.positions_m.mean(axis=0)
    frames = FrontEnd(array, RATE).process(sound)
    assert len(frames) >= 10
    errors = []
    for frame in frames:
        x, y, _ = heard_at(pass_by, frame.sample_index / RATE - frame.bearing_age_s) - middle
        errors.append(np.degrees(frame.bearing_rad - np.arctan2(y, x)))
    print(
        f"bearing rms {np.sqrt(np.mean(np.square(errors))):.2f}, median {np.median(np.abs(errors)):.2f} deg"
    )
    assert np.sqrt(np.mean(np.square(errors))) < 0.5
    assert np.median(np.abs(errors)) < 0.3


def looming_errors(sound: np.ndarray, array: MicrophoneArray, hops: int) -> tuple[np.ndarray, np.ndarray]:
    """Relative errors of TTA on the receiver's clock, and the same in reported standard errors of 1/TTA."""
    # All of the band that a car fills: the scatter of the energy falls with the bandwidth.
    settings = FrontEndSettings(looming_band_hz=(300.0, 20_000.0), looming_hops=hops)
    errors, scores = [], []
    for frame in FrontEnd(array, RATE, settings).process(sound):
        if frame.sample_index < hops * RATE / 10:
            continue
        assert isinstance(frame.looming, Looming)
        range_m = np.linalg.norm(heard_at(direct, frame.sample_index / RATE))
        truth = 10.0 / (1.0 - 10.0 / SPEED_OF_SOUND_M_S) / range_m
        errors.append(truth / frame.looming.inverse_tta_hz - 1.0)
        scores.append((frame.looming.inverse_tta_hz - truth) / frame.looming.std_hz)
    return np.array(errors), np.array(scores)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_looming_of_a_direct_approach(seed: int) -> None:
    array = MicrophoneArray(roof_array_56().positions_m[::20])
    sound = render(array, direct, 3.0, seed)
    errors, scores = looming_errors(sound, array, hops=20)
    print(f"time to arrival from 2 s: mean {errors.mean():+.3f}, worst {np.abs(errors).max():.3f}")
    assert len(errors) == 11
    assert np.abs(errors).max() < 0.05
    assert np.abs(scores).max() < 3.0
    # Half the window tells less and says so: still unbiased, within what its own standard error allows.
    errors, scores = looming_errors(sound, array, hops=10)
    assert abs(errors.mean()) < 0.05
    assert np.abs(scores).max() < 3.0
