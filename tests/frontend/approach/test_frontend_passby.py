"""Moving sources rendered by acoular: a pass-by for the bearing, a direct approach for looming."""

import numpy as np
import pytest
from acoular_scene import RATE, SPEED_OF_SOUND_M_S, direct, heard_at, pass_by, render

from worldstate.frontend.approach.looming import Looming
from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.frontend.stream import FrontEnd


def bearing_errors_deg(array: MicrophoneArray, seconds: float, seed: int) -> np.ndarray:
    """Errors against where the source was when what is heard now left it."""
    sound = render(array, pass_by, seconds, seed)
    sound += 0.02 * np.random.default_rng(0).standard_normal(sound.shape)
    middle = array.positions_m.mean(axis=0)
    errors = []
    for frame in FrontEnd(array, RATE).process(sound):
        x, y, _ = heard_at(pass_by, frame.sample_index / RATE - frame.bearing_age_s) - middle
        errors.append(np.degrees(frame.bearing_rad - np.arctan2(y, x)))
    rms, median = np.sqrt(np.mean(np.square(errors))), np.median(np.abs(errors))
    print(f"{array.n_microphones} microphones: bearing rms {rms:.2f}, median {median:.2f} deg")
    return np.array(errors)


@pytest.mark.parametrize(
    ("step", "seconds", "seed"),
    [
        pytest.param(4, 2.0, 1, id="14"),
        pytest.param(2, 3.0, 2, id="28", marks=pytest.mark.slow),
        pytest.param(1, 3.0, 3, id="all 56", marks=pytest.mark.slow),
    ],
)
def test_bearing_of_a_pass_by(step: int, seconds: float, seed: int) -> None:
    array = MicrophoneArray(roof_array_56().positions_m[::step])
    errors = bearing_errors_deg(array, seconds, seed)
    assert len(errors) >= 10 * (seconds - 1.0)
    assert np.sqrt(np.mean(errors**2)) <= 0.5
    assert np.median(np.abs(errors)) <= 0.3


def looming_errors(sound: np.ndarray, array: MicrophoneArray) -> tuple[np.ndarray, np.ndarray]:
    """Relative errors of TTA on the receiver's clock, and the same in reported standard errors of 1/TTA."""
    errors, scores = [], []
    for frame in FrontEnd(array, RATE).process(sound):
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
    errors, scores = looming_errors(sound, array)
    print(f"time to arrival from 1 s: mean {errors.mean():+.3f}, worst {np.abs(errors).max():.3f}")
    assert abs(errors.mean()) < 0.05
    assert np.abs(scores).max() < 3.0
