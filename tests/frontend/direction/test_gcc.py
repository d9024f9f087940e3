"""Pair delays: exact between samples, and at the bound."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import ShortTimeFFT

from worldstate.frontend.bounds.cramer_rao import delay_crb_s2
from worldstate.frontend.direction.gcc_phat import all_pairs, gcc_delays

FREQUENCIES = np.arange(300.0, 1800.0, 50.0)


def circular(rng, *shape):
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)


def delayed(delays, rng, frames=40, noise=0.0, level=None):
    """One wave at microphones with these arrival times: spectra (frames, bins, M)."""
    wave = circular(rng, frames, len(FREQUENCIES), 1) * (1.0 if level is None else level[:, None])
    shift = np.exp(-2j * np.pi * FREQUENCIES[:, None] * np.asarray(delays))
    return wave * shift + noise * circular(rng, frames, len(FREQUENCIES), len(delays))


@settings(max_examples=50, deadline=None)
@given(arrivals=st.lists(st.floats(-1e-3, 1e-3), min_size=2, max_size=5))
def test_noiseless_delays_are_exact_between_samples(arrivals):
    X = delayed(arrivals, np.random.default_rng(0))
    got = gcc_delays(X, FREQUENCIES, 2.5e-3)
    i, j = all_pairs(len(arrivals)).T
    np.testing.assert_allclose(got.delay_s, np.subtract(arrivals, 0)[i] - np.array(arrivals)[j], atol=1e-12)
    np.testing.assert_allclose(got.peak, 1.0, atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("snr", [1.0, 10.0, 100.0])
def test_variance_meets_the_bound(snr):
    rng = np.random.default_rng(int(snr))
    frames, truth, trials = 60, 1.37e-4, 600
    errors = []
    for _ in range(trials):
        X = delayed([truth, 0.0], rng, frames=frames, noise=snr**-0.5)
        errors.append(gcc_delays(X, FREQUENCIES, 3e-3).delay_s[0] - truth)
    coherence = (snr / (1 + snr)) ** 2
    spacing = FREQUENCIES[1] - FREQUENCIES[0]
    # The sum over bins as an integral: frames of 1 / spacing seconds each, half a bin added at either end.
    edges = np.array([FREQUENCIES[0] - spacing / 2, FREQUENCIES[-1] + spacing / 2])
    fine = np.linspace(*edges, 2000)
    bound = delay_crb_s2(fine, np.full(fine.size, coherence), frames / spacing)
    ratio_db = 10 * np.log10(np.var(errors) / bound)
    sampling_db = 10 * np.log10(1 - 3.0 * np.sqrt(2 / trials))
    assert sampling_db < ratio_db < 1.5
    assert abs(np.mean(errors)) < 4 * np.sqrt(bound / trials)


def test_delay_of_a_stream_through_a_windowed_stft():
    rng = np.random.default_rng(6)
    sound, rate = rng.normal(size=48_000), 48_000
    pair = np.stack([sound[100:-100], sound[93:-107]], axis=-1)  # the second hears everything 7 samples later
    stft = ShortTimeFFT(np.hanning(512), 256, rate)
    X = np.moveaxis(stft.stft(pair, axis=0), (0, 1, 2), (1, 2, 0))
    band = (stft.f > 300) & (stft.f < 1800)
    late = gcc_delays(X[:, band], stft.f[band], 1e-3)
    assert late.delay_s[0] == pytest.approx(-7 / rate, abs=0.02 / rate)


def test_a_dead_microphone_has_no_peak():
    X = delayed([0.0, 1e-4, 0.0], np.random.default_rng(2), frames=4000, noise=1.0)
    X[..., 2] = 0.0
    assert gcc_delays(X, FREQUENCIES, 1e-3).peak[1] == 0.0
