"""Looming against closed forms, and looming and bearing of moving sources rendered by acoular."""

import numpy as np
import pytest
from acoular_scene import RATE, SPEED_OF_SOUND_M_S, direct, heard_at, pass_by, render
from hypothesis import assume, given
from hypothesis import strategies as st

from worldstate.frontend.approach.looming import EnergyFloor, Looming, looming
from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.values import NotUsable

TIMES_S = np.arange(-0.95, 0.0, 0.1)
# White noise in 300 to 1800 Hz, a tenth of a second.
SCATTER = 0.082


def direct_approach(range_m: float, closing_m_s: float) -> np.ndarray:
    """Log-energy of a point source that is `range_m` away at the end of the window."""
    return -2.0 * np.log(range_m - closing_m_s * TIMES_S)


@given(st.floats(2.0, 80.0), st.floats(-15.0, 15.0), st.floats(-30.0, 30.0))
def test_looming_is_exact_at_constant_speed_and_any_level(range_m, closing_m_s, level):
    assume(range_m + closing_m_s > 1.0)
    energies = direct_approach(range_m, closing_m_s) + level
    found = looming(TIMES_S, energies, floor_std=1e-4)
    assert found.inverse_tta_hz == pytest.approx(closing_m_s / range_m, rel=1e-6, abs=1e-9)
    assert found.log_slope_hz == pytest.approx(np.polyfit(TIMES_S, energies, 1)[0], abs=1e-9)


def test_standard_errors_match_the_errors() -> None:
    rng = np.random.default_rng(0)
    sigma = 0.08
    noisy = [direct_approach(30.0, 9.0) + sigma * rng.normal(size=10) for _ in range(1500)]
    found = [looming(TIMES_S, one, sigma) for one in noisy]
    assert all(isinstance(one, Looming) for one in found)
    z_range = np.array([(one.inverse_tta_hz - 0.3) / one.std_hz for one in found])
    assert abs(np.median(z_range)) < 0.1
    # The assumed scatter is never below the floor, so standard errors are slightly too wide.
    assert 0.75 < z_range.std() < 1.1


def test_the_standard_error_grows_with_the_scatter() -> None:
    steady = direct_approach(30.0, 9.0)
    jagged = steady + 0.3 * np.array([1, -1] * 5)
    smooth, rough = (looming(TIMES_S, one, floor_std=0.05) for one in (steady, jagged))
    assert rough.std_hz > 3 * smooth.std_hz


def test_wild_energy_and_range_zero_within_the_window_are_not_usable() -> None:
    assert isinstance(looming(TIMES_S, 2.0 * np.array([1, -1] * 5), floor_std=0.05), NotUsable)
    steep = np.linspace(0.0, 1.0, 10) ** 4 * 8.0
    assert "zero" in looming(TIMES_S, steep, floor_std=0.1).reason


def street(snr_db: float, tta_s: float, seconds: int, seed: int) -> np.ndarray:
    """Hop energies in steady noise; at the end a source is `tta_s` away and `snr_db` above it."""
    rng = np.random.default_rng(seed)
    ahead = tta_s + (np.arange(10 * seconds)[::-1] + 0.5) / 10
    scatter = 1.0 + SCATTER * rng.standard_normal((2, len(ahead)))
    return np.asarray(scatter[0] + 10 ** (snr_db / 10) * (tta_s / ahead) ** 2 * scatter[1])


def heard(energies: np.ndarray) -> Looming | NotUsable:
    """Return the looming that the front-end measures after these hops."""
    running = EnergyFloor()
    for energy in energies:
        running.push(float(energy))
    noise = running.read(float(energies[-10:].min()), SCATTER)
    return looming(TIMES_S, np.log(energies[-10:]), SCATTER, *noise)


@pytest.mark.parametrize("tta_s", [1.0, 2.0, 3.0])
@pytest.mark.parametrize("snr_db", [0.0, 4.0, 10.0, 20.0])
def test_looming_is_corrected_for_noise_or_not_usable(snr_db: float, tta_s: float) -> None:
    """Without the noise floor 1/TTA was 0.14 to 0.23 too small at 10 dB and 0.60 to 0.75 at 0 dB."""
    found = [heard(street(snr_db, tta_s, 20, seed)) for seed in range(60)]
    given = [one for one in found if isinstance(one, Looming)]
    if snr_db >= 10.0:
        assert len(given) >= 0.8 * len(found)
    if snr_db == 0.0:
        assert len(given) <= 0.1 * len(found)
        return
    errors = np.array([one.inverse_tta_hz * tta_s - 1.0 for one in given])
    assert abs(np.median(errors)) <= 0.1
    assert 0.4 < np.sqrt(np.mean(np.square(errors / [one.std_hz * tta_s for one in given]))) < 1.3


def test_noise_alone_does_not_loom() -> None:
    rng = np.random.default_rng(3)
    noise = np.exp(np.cumsum(0.02 * rng.standard_normal(600))) * (1.0 + SCATTER * rng.standard_normal(600))
    found = [heard(noise[:end]) for end in range(100, 600, 10)]
    assert sum(isinstance(one, NotUsable) for one in found) >= 0.8 * len(found)


def test_looming_has_a_larger_error_at_the_start_of_a_stream() -> None:
    cold, known = heard(street(10.0, 2.0, 2, 5)), heard(street(10.0, 2.0, 20, 5))
    assert cold.std_hz > 1.2 * known.std_hz
    assert abs(cold.inverse_tta_hz - 0.5) < 2.0 * cold.std_hz


def test_the_bearing_of_a_pass_by_is_accurate() -> None:
    """Errors relative to the place of the source at the emission of the sound that arrives now."""
    array, errors = MicrophoneArray(roof_array_56().positions_m[::4]), []
    sound = render(array, pass_by, 2.0, seed=1)
    sound += 0.02 * np.random.default_rng(0).standard_normal(sound.shape)
    for frame in FrontEnd(array, RATE).process(sound):
        place = heard_at(pass_by, frame.sample_index / RATE - frame.bearing_age_s)
        x, y, _ = place - array.positions_m.mean(axis=0)
        errors.append(np.degrees(frame.bearing_rad - np.arctan2(y, x)))
    assert len(errors) >= 10
    assert np.sqrt(np.mean(np.square(errors))) <= 0.5
    assert np.median(np.abs(errors)) <= 0.3


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_looming_of_a_direct_approach_is_accurate(seed: int) -> None:
    """Errors of TTA on the receiver's clock, and those of 1/TTA in reported standard errors."""
    array, errors, scores = MicrophoneArray(roof_array_56().positions_m[::20]), [], []
    for frame in FrontEnd(array, RATE).process(render(array, direct, 3.0, seed)):
        range_m = np.linalg.norm(heard_at(direct, frame.sample_index / RATE))
        truth = 10.0 / (1.0 - 10.0 / SPEED_OF_SOUND_M_S) / range_m
        errors.append(truth / frame.looming.inverse_tta_hz - 1.0)
        scores.append((frame.looming.inverse_tta_hz - truth) / frame.looming.std_hz)
    assert abs(np.mean(errors)) < 0.05
    assert np.abs(scores).max() < 3.0
