"""Rife-Boorstyn: exact without noise, at the bound with it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from worldstate.frontend.approach.tone import estimate_tone
from worldstate.frontend.bounds.cramer_rao import tone_crb_hz2

RATE = 1000.0


@settings(max_examples=60, deadline=None)
@given(
    frequency=st.floats(10.0, 490.0),
    phase=st.floats(-3.1, 3.1),
    amplitude=st.floats(1e-4, 1e4),
    n=st.integers(200, 400),
)
def test_noiseless_real_tone_is_exact(frequency, phase, amplitude, n):
    t = np.arange(n) / RATE
    tone = estimate_tone(amplitude * np.cos(2 * np.pi * frequency * t + phase), RATE)
    assert tone.frequency_hz == pytest.approx(frequency, rel=1e-8)
    assert tone.amplitude == pytest.approx(amplitude, rel=1e-6)
    assert np.exp(1j * tone.phase_rad) == pytest.approx(np.exp(1j * phase), abs=1e-5)


@pytest.mark.long
@pytest.mark.parametrize("snr_db", [0.0, 10.0, 25.0])
def test_variance_meets_the_bound(snr_db):
    """Within 1.5 dB of eq. (9) of Rife and Boorstyn, never below it beyond three standard errors."""
    rng = np.random.default_rng(int(snr_db) + 4)
    n, trials, eta = 256, 800, 10 ** (snr_db / 10)
    t, errors, claimed, found = np.arange(n) / RATE, [], [], []
    for _ in range(trials):
        frequency, phase = rng.uniform(40, 460), rng.uniform(-np.pi, np.pi)
        wave = np.cos(2 * np.pi * frequency * t + phase)
        tone = estimate_tone(wave + rng.normal(size=n) * np.sqrt(1 / (2 * eta)), RATE)
        errors.append(tone.frequency_hz - frequency)
        claimed.append(tone.frequency_std_hz**2)
        found.append(tone.snr)
    bound = tone_crb_hz2(eta, n, RATE)
    ratio_db = 10 * np.log10(np.mean(np.square(errors)) / bound)
    assert 10 * np.log10(1 - 3 * np.sqrt(2 / trials)) < ratio_db < 1.5
    assert np.mean(claimed) == pytest.approx(bound, rel=0.05)
    assert np.median(found) == pytest.approx(eta, rel=0.05)


def test_real_estimate_is_the_least_squares_optimum():
    """Near 0 Hz the periodogram of a real tone is biased; the likelihood is what must be maximal."""
    rng = np.random.default_rng(5)
    t = np.arange(128) / RATE
    y = np.cos(2 * np.pi * 13.0 * t + 1.0) + 0.3 * rng.normal(size=128)

    def misfit(frequency):
        H = np.stack([np.cos(2 * np.pi * frequency * t), np.sin(2 * np.pi * frequency * t)], axis=1)
        return np.linalg.lstsq(H, y, rcond=None)[1][0]

    best = minimize_scalar(misfit, bounds=(11.0, 15.0), method="bounded", options={"xatol": 1e-9})
    assert estimate_tone(y, RATE).frequency_hz == pytest.approx(best.x, abs=1e-5)


def test_the_strongest_tone_is_found_and_an_offset_is_none():
    t = np.arange(500) / RATE
    y, other = np.cos(2 * np.pi * 80 * t), np.cos(2 * np.pi * 200.3 * t)
    assert estimate_tone(5 * y + other, RATE).frequency_hz == pytest.approx(80, abs=0.05)
    assert estimate_tone(0.1 + y, RATE).frequency_hz == pytest.approx(80, abs=0.01)
