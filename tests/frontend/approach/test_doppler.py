"""Engine line and Doppler: acoular's moving source as the oracle, and engines of varying speed."""

from dataclasses import replace

import numpy as np
import pytest
from acoular_scene import Samples, heard_at, render
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import cumulative_trapezoid

from worldstate.frontend.approach.doppler import RadialSpeed, radial_speed, radial_speed_m_s
from worldstate.frontend.approach.engine_line import track_fundamental
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.values import NotUsable

SOUND_M_S, RATE = 343.0, 4000.0


def engine(phase, teeth=12):
    """Return harmonics of this phase whose level falls by 4 dB per octave."""
    return sum(h**-0.7 * np.cos(h * phase + h * h) for h in range(1, teeth + 1))


def wandering_phase(f0, wander, t):
    """Phase of an engine at f0 (1 + wander(t)), on any increasing times."""
    fine = np.linspace(t[0] - 0.1, t[-1] + 0.1, 40_001)
    phase = 2 * np.pi * f0 * cumulative_trapezoid(1 + wander(fine), fine, initial=0)
    return np.interp(t, fine, phase)


def pass_by(rng, f0, speed, closest, distance, wander=np.zeros_like, snr=10.0, duration=5.0):
    """Return samples, times and radial speed of a pass-by; a fixed point gives the emission time."""
    t = np.arange(int(duration * RATE)) / RATE
    emission = t.copy()
    for _ in range(60):
        range_m = np.hypot(distance, speed * (emission - closest))
        emission = t - range_m / SOUND_M_S
    x = engine(wandering_phase(f0, wander, emission)) / range_m
    x += rng.normal(size=t.size) * x.std() / np.sqrt(snr)
    return x, t, speed**2 * (emission - closest) / range_m


def straight(speed, distance, start_m):
    """Return the path of a source along x = distance."""
    return lambda time_s: np.array([distance, start_m + speed * time_s, 0.0])


def acoular_pass_by(samples, rate, path):
    """Return the sound that acoular renders at the origin of a source that moves along a path."""
    pair = MicrophoneArray([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    signal = Samples(sample_freq=rate, num_samples=len(samples), samples=samples)
    return render(pair, path, len(samples) / rate, signal=signal)[:, 0]


def emission_truth(times, speed, path):
    """Radial speed at emission by root finding."""
    places = np.array([heard_at(path, time_s) for time_s in times])
    return speed * places[:, 1] / np.linalg.norm(places, axis=1)


@pytest.mark.parametrize(("speed", "distance"), [(8.3, 4.0), (13.9, 8.0)])
def test_radial_speed_of_a_pass_by_rendered_by_acoular(speed, distance):
    rate = 8000.0
    t = np.arange(int(5.2 * rate)) / rate
    path = straight(speed, distance, -2.6 * speed)
    x = acoular_pass_by(engine(2 * np.pi * 47.0 * t), rate, path)
    x = x + np.random.default_rng(3).normal(size=len(x)) * x.std() * 0.3
    found = radial_speed(track_fundamental(x, rate))
    truth = emission_truth(found.time_s, speed, path)
    assert np.abs(found.radial_speed_m_s - truth).max() < 0.5
    assert found.rest_frequency_hz == pytest.approx(47.0, rel=1e-3)
    assert found.speed_m_s == pytest.approx(speed, abs=0.3)


@pytest.mark.parametrize("period_s", [2.0, 3.5, 8.0])
def test_wandering_engine_in_acoulars_pass_by_is_not_usable(period_s):
    rate, speed = 8000.0, 13.9
    t = np.arange(int(5.2 * rate)) / rate
    phase = wandering_phase(47.0, lambda s: 0.05 * np.sin(2 * np.pi * s / period_s + 1.0), t)
    x = acoular_pass_by(engine(phase), rate, straight(speed, 8.0, -2.6 * speed))
    x = x + np.random.default_rng(4).normal(size=len(x)) * x.std() * 0.3
    assert isinstance(radial_speed(track_fundamental(x, rate)), NotUsable)


def test_an_engine_that_runs_down_at_the_kerb_is_not_a_pass_by():
    for seed, width in enumerate((0.4, 0.8, 1.2, 2.0)):
        rng = np.random.default_rng(seed)
        x, _, _ = pass_by(rng, 60.0, 0.0, 0.0, 6.0, lambda t, w=width: -0.05 * np.tanh((t - 2.5) / w))
        assert isinstance(radial_speed(track_fundamental(x, RATE)), NotUsable)


@pytest.mark.long
def test_the_stated_variance_covers_the_error():
    squares = []
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        x, t, truth = pass_by(
            rng, rng.uniform(30, 90), rng.uniform(7, 16), rng.uniform(1.5, 3.5), rng.uniform(3, 10), snr=1.0
        )
        found = radial_speed(track_fundamental(x, RATE))
        error = found.radial_speed_m_s - np.interp(found.time_s, t, truth)
        assert np.sqrt(np.mean(error**2)) < 0.5
        squares.append(np.mean(error**2 / found.variance_m2_s2))
    assert 0.05 < np.mean(squares) < 2.0


def test_an_unusable_radial_speed_has_its_reason():
    rng = np.random.default_rng(0)
    noise = rng.normal(size=20_000)
    t = np.arange(20_000) / RATE
    standing = engine(2 * np.pi * 60 * t) + noise
    assert "no stable line" in radial_speed(track_fundamental(noise, RATE)).reason
    assert "does not move" in radial_speed(track_fundamental(standing, RATE)).reason
    x, _, _ = pass_by(rng, 60.0, 12.0, 2.5, 6.0)
    lines = radial_speed(track_fundamental(x, RATE), min_partials=100)
    assert "fewer than 100" in lines.reason
    x, _, _ = pass_by(rng, 60.0, 15.0, 5.5, 3.0, duration=3.0)
    only_coming = radial_speed(track_fundamental(x, RATE))
    assert isinstance(only_coming, NotUsable)


def test_disagreeing_harmonics_are_refused():
    x, _, _ = pass_by(np.random.default_rng(1), 60.0, 12.0, 2.5, 6.0)
    track = track_fundamental(x, RATE)
    inharmonic = replace(track, misfit=track.misfit + 9)
    assert isinstance(radial_speed(track), RadialSpeed)
    assert "disagree" in radial_speed(inharmonic).reason


def test_harmonic_misfit_separates_a_comb_from_a_mixture():
    rng, t = np.random.default_rng(2), np.arange(16_000) / RATE
    comb = engine(2 * np.pi * 60 * t, 5) + 0.5 * rng.normal(size=t.size)
    mixture = sum(np.cos(2 * np.pi * f * t) for f in (60.0, 121.3, 178.4)) + 0.5 * rng.normal(size=t.size)
    assert np.median(track_fundamental(comb, RATE).misfit) < 2
    assert np.median(track_fundamental(mixture, RATE).misfit) > 20


@pytest.mark.parametrize("wander", [0.0, 0.05])
def test_track_follows_the_fundamental_with_honest_variance(wander):
    rng, t = np.random.default_rng(3), np.arange(40_000) / RATE
    f = 43.0 * (1 + wander * np.sin(2 * np.pi * t / 3))
    x = engine(wandering_phase(43.0, lambda s: wander * np.sin(2 * np.pi * s / 3), t), 14)
    track = track_fundamental(x / x.std() + 0.6 * rng.normal(size=t.size), RATE)
    error = track.frequency_hz - np.interp(track.time_s, t, f)
    assert len(track.time_s) == track.windows
    assert 0.6 < np.sqrt(np.mean(error**2 / track.variance_hz2)) < 1.6
    assert np.abs(track.level_db + 0.0).max() < 1.5


def test_sample_rate_and_gain_do_not_matter():
    rng = np.random.default_rng(4)
    t = np.arange(3 * 47_998) / 47_998
    x = engine(2 * np.pi * 55.0 * t) + 0.3 * rng.normal(size=t.size)
    one, loud = track_fundamental(x, 47_998.0), track_fundamental(1000 * x, 47_998.0)
    np.testing.assert_allclose(one.frequency_hz, loud.frequency_hz, rtol=1e-9)
    np.testing.assert_allclose(one.frequency_hz, 55.0, atol=0.05)


@settings(max_examples=40, deadline=None)
@given(time=st.floats(-5, 5), speed=st.floats(0.5, 50), closest=st.floats(-2, 2), distance=st.floats(0.5, 50))
def test_closed_form_emission_time_equals_root_finding(time, speed, closest, distance):
    expected = emission_truth([time], speed, straight(speed, distance, -speed * closest))
    got = radial_speed_m_s(np.array([time]), speed, closest, distance)
    assert got == pytest.approx(expected, abs=1e-6 * speed)
