"""A stream at another rate: against scipy's offline resampling, in blocks of any length, without delay."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from worldstate.frontend.spectra.resampling import Resampler
from worldstate.ground.typing import Float32Array

# Sample rates of converters and of some sound cards.
RATES = ((8_000, 12_000), (11_025, 12_000), (16_000, 24_000), (22_050, 24_000), (32_000, 48_000))
RATES += ((44_100, 48_000), (44_056, 48_000), (88_200, 48_000), (96_000, 48_000), (192_000, 48_000))
SEEDS = st.integers(0, 2**32 - 1)


def whole(resampler: Resampler, sound: Float32Array) -> Float32Array:
    """Return the sound at the other rate, up to its end."""
    return np.concatenate([resampler.push(sound), resampler.flush()])


@pytest.mark.parametrize(("rate", "wanted"), RATES)
def test_resampling_equals_scipy_on_the_whole_sound(rate: int, wanted: int) -> None:
    highest = 0.45 * min(rate, wanted)
    low_pass = signal.firwin(801, 0.9 * highest, fs=rate, window=("kaiser", 9.0))
    noise = np.random.default_rng(rate).standard_normal((rate, 2))
    sound = signal.lfilter(low_pass, 1.0, noise, axis=0).astype(np.float32)
    resampler = Resampler(2, rate, wanted)
    found = whole(resampler, sound)
    ratio = resampler.rate_hz / rate
    up = next(n for n in range(1, 161) if abs(n / ratio - round(n / ratio)) < 1e-9)
    down = round(up / ratio)
    assert abs(resampler.rate_hz / wanted - 1.0) < 1e-3
    # A filter much longer than that of the resampler.
    sharp = signal.firwin(200 * max(up, down) + 1, 1.0 / max(up, down), window=("kaiser", 12.0))
    expected = signal.resample_poly(sound.astype(np.float64), up, down, window=sharp)
    # The cut at the end is not band-limited.
    inner = slice(0, len(expected) - round(0.05 * wanted))
    assert len(found) == len(expected)
    error = found[inner] - expected[inner]
    assert 20.0 * np.log10(error.std() / expected[inner].std()) < -85.0


@settings(deadline=None, max_examples=40)
@given(st.sampled_from(RATES), st.lists(st.integers(1, 3_000), max_size=20), st.integers(1, 9), SEEDS)
def test_resampling_in_blocks_is_identical_bit_for_bit(
    rates: tuple[int, int], cuts: list[int], channels: int, seed: int
) -> None:
    sound = np.random.default_rng(seed).standard_normal((3_000, channels), dtype=np.float32)
    at_once, in_blocks = Resampler(channels, *rates), Resampler(channels, *rates)
    edges = [0, *sorted(set(cuts)), len(sound)]
    parts = [in_blocks.push(sound[start:end]) for start, end in pairwise(edges)]
    np.testing.assert_array_equal(np.concatenate(parts), at_once.push(sound))


@pytest.mark.parametrize(("rate", "wanted"), RATES)
def test_a_click_stays_at_its_time(rate: int, wanted: int) -> None:
    sound = np.zeros((rate // 2, 1), np.float32)
    sound[rate // 4] = 1.0
    resampler = Resampler(1, rate, wanted)
    power = whole(resampler, sound)[:, 0].astype(np.float64) ** 2
    centre_s = (power @ np.arange(len(power))) / power.sum() / resampler.rate_hz
    assert centre_s == pytest.approx((rate // 4) / rate, abs=2e-6)


@pytest.mark.parametrize(("rate", "wanted"), RATES)
def test_silence_stays_silence_and_is_as_long(rate: int, wanted: int) -> None:
    resampler = Resampler(3, rate, wanted)
    for seconds in range(1, 4):
        resampler.push(np.zeros((rate, 3), np.float32))
        assert len(resampler._waiting) < 0.03 * rate, seconds
    fresh = Resampler(3, rate, wanted)
    assert not (found := whole(fresh, np.zeros((rate, 3), np.float32))).any()
    assert len(found) == math.ceil(fresh.rate_hz)
