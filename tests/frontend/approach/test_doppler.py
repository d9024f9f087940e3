"""Engine line and Doppler: acoular's moving source as the oracle, and engines of varying speed."""

import numpy as np
import pytest
from acoular_scene import Samples, heard_at, render
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import cumulative_trapezoid

from worldstate.frontend.approach.doppler import radial_speed, radial_speed_m_s
from worldstate.frontend.approach.engine_line import track_fundamental
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.values import NotUsable

RATE = 8000.0
PAIR = MicrophoneArray([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def engine(f0, seconds, wander=np.zeros_like, teeth=12):
    """Return harmonics of f0 (1 + wander(t)) whose level falls by 4 dB per octave."""
    t = np.arange(round(seconds * RATE)) / RATE
    phase = 2 * np.pi * f0 * cumulative_trapezoid(1 + wander(t), t, initial=0)
    return sum(h**-0.7 * np.cos(h * phase + h * h) for h in range(1, teeth + 1))


def noisy(sound, snr, seed):
    return sound + np.random.default_rng(seed).normal(size=len(sound)) * sound.std() / np.sqrt(snr)


def straight(speed, distance, closest_s):
    """Return the path of a source along x = distance."""
    return lambda time_s: np.array([distance, speed * (time_s - closest_s), 0.0])


def pass_by(sound, path, snr=10.0, seed=3):
    """Return the sound that acoular renders at the origin of a source that moves along a path, in noise."""
    signal = Samples(sample_freq=RATE, num_samples=len(sound), samples=sound)
    return noisy(render(PAIR, path, len(sound) / RATE, signal=signal)[:, 0], snr, seed)


def emission_truth(times, speed, path):
    """Radial speed at emission by root finding."""
    places = np.array([heard_at(path, time_s) for time_s in times])
    return speed * places[:, 1] / np.linalg.norm(places, axis=1)


def speed_of(sound, **options):
    return radial_speed(track_fundamental(sound, RATE), **options)


@pytest.mark.parametrize(("speed", "distance"), [(8.3, 4.0), (13.9, 8.0)])
def test_the_radial_speed_of_a_pass_by_rendered_by_acoular_is_found(speed, distance):
    path = straight(speed, distance, 2.6)
    found = speed_of(pass_by(engine(47.0, 5.2), path))
    truth = emission_truth(found.time_s, speed, path)
    assert np.abs(found.radial_speed_m_s - truth).max() < 0.5
    assert found.rest_frequency_hz == pytest.approx(47.0, rel=1e-3)
    assert found.speed_m_s == pytest.approx(speed, abs=0.3)


SWINGS = [lambda t, p=period_s: 0.05 * np.sin(2 * np.pi * t / p + 1.0) for period_s in (2.0, 3.5, 8.0)]
DECAYS = [lambda t, w=width_s: -0.05 * np.tanh((t - 2.5) / w) for width_s in (0.4, 0.8, 1.2, 2.0)]


@pytest.mark.parametrize(("speed", "wander"), [*((13.9, one) for one in SWINGS), *((0.0, d) for d in DECAYS)])
def test_an_engine_of_varying_speed_is_no_pass_by_in_motion_or_at_the_kerb(speed, wander):
    sound = pass_by(engine(47.0, 5.2, wander), straight(speed, 8.0, 2.6))
    assert isinstance(speed_of(sound), NotUsable)


@pytest.mark.long
def test_the_stated_variance_covers_the_error():
    squares = []
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        f0, speed, path = rng.uniform(30, 90), rng.uniform(7, 16), (rng.uniform(3, 10), rng.uniform(1.5, 3.5))
        found = speed_of(pass_by(engine(f0, 5.0), straight(speed, *path), snr=1.0, seed=seed))
        error = found.radial_speed_m_s - emission_truth(found.time_s, speed, straight(speed, *path))
        assert np.sqrt(np.mean(error**2)) < 0.5
        squares.append(np.mean(error**2 / found.variance_m2_s2))
    assert 0.05 < np.mean(squares) < 2.0


def test_an_unusable_radial_speed_has_its_reason():
    t = np.arange(5 * RATE) / RATE
    mixture = sum(np.cos(2 * np.pi * f * t) for f in (60.0, 121.3, 178.4))
    noise = np.random.default_rng(0).normal(size=t.size)
    passing = pass_by(engine(60.0, 5.0), straight(12.0, 6.0, 2.5))
    coming = pass_by(engine(60.0, 3.0), straight(15.0, 3.0, 5.5))
    assert "no stable line" in speed_of(noise).reason
    assert "does not move" in speed_of(noisy(engine(60.0, 5.0), 4.0, 1)).reason
    assert "fewer than 100" in speed_of(passing, min_partials=100).reason
    assert "the harmonics disagree" in speed_of(noisy(mixture, 6.0, 2)).reason
    assert isinstance(speed_of(coming), NotUsable)


@pytest.mark.parametrize("wander", [0.0, 0.05])
def test_track_follows_the_fundamental_with_honest_variance(wander):
    def swing(t):
        return wander * np.sin(2 * np.pi * t / 3)

    sound = engine(43.0, 10.0, swing, 14)
    track = track_fundamental(noisy(sound / sound.std(), 2.8, 3), RATE)
    error = track.frequency_hz - 43.0 * (1 + swing(track.time_s))
    assert len(track.time_s) == track.windows
    assert 0.6 < np.sqrt(np.mean(error**2 / track.variance_hz2)) < 1.6
    assert np.abs(track.level_db + 0.0).max() < 1.5
    assert np.median(track.misfit) < 2


def test_sample_rate_and_gain_do_not_matter():
    t = np.arange(3 * 47_998) / 47_998
    sound = noisy(sum(np.cos(2 * np.pi * 55.0 * h * t + h) / h for h in range(1, 9)), 10.0, 4)
    one, loud = track_fundamental(sound, 47_998.0), track_fundamental(1000 * sound, 47_998.0)
    np.testing.assert_allclose(one.frequency_hz, loud.frequency_hz, rtol=1e-9)
    np.testing.assert_allclose(one.frequency_hz, 55.0, atol=0.05)


@settings(max_examples=40, deadline=None)
@given(time=st.floats(-5, 5), speed=st.floats(0.5, 50), closest=st.floats(-2, 2), distance=st.floats(0.5, 50))
def test_closed_form_emission_time_equals_root_finding(time, speed, closest, distance):
    expected = emission_truth([time], speed, straight(speed, distance, closest))
    got = radial_speed_m_s(np.array([time]), speed, closest, distance)
    assert got == pytest.approx(expected, abs=1e-6 * speed)
