"""Spectra, other sample rates and the character of a sound: against scipy and on known modulation."""

from itertools import pairwise

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.frontend.spectra.resampling import Decimator, Resampler
from worldstate.frontend.spectra.sound_character import BANDS, MEASURES, SoundCharacter
from worldstate.frontend.spectra.stft import StreamingStft
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import NotUsable


@settings(deadline=None)
@given(
    lengths=st.lists(st.integers(0, 150), min_size=1, max_size=30),
    half=st.sampled_from([4, 16, 32]),
    seed=st.integers(0, 2**32 - 1),
)
def test_blocks_of_any_length_give_scipys_frames(lengths: list[int], half: int, seed: int) -> None:
    nfft = 2 * half
    samples = np.random.default_rng(seed).standard_normal((sum(lengths), 3)).astype(np.float32)
    stft = StreamingStft(3, nfft, range(0, half + 1))
    blocks = np.split(samples, np.cumsum(lengths)[:-1])
    frames = np.concatenate([stft.push(block) for block in blocks])
    if len(samples) < nfft:
        assert len(frames) == 0
    else:
        # On the scale of a plain windowed sum.
        peer = nfft / 2 * scipy.signal.stft(samples, nperseg=nfft, axis=0, boundary=None, padded=False)[2]
        np.testing.assert_allclose(frames, peer.transpose(2, 0, 1), atol=2e-5 * nfft**0.5)


def test_a_large_offset_does_not_leak_beyond_the_window() -> None:
    samples = np.full((2048, 1), 1000.0, np.float32)
    frames = StreamingStft(1, 512, range(2, 19)).push(samples)
    assert np.abs(frames).max() < 1e-6 * 1000 * 512


# Sample rates of converters and of some sound cards.
RATES = ((8_000, 12_000), (11_025, 12_000), (16_000, 24_000), (22_050, 24_000), (32_000, 48_000))
RATES += ((44_100, 48_000), (44_056, 48_000), (88_200, 48_000), (96_000, 48_000), (192_000, 48_000))
SEEDS = st.integers(0, 2**32 - 1)


@pytest.mark.parametrize(("rate", "wanted"), RATES)
def test_resampling_equals_scipy_on_the_whole_sound(rate: int, wanted: int) -> None:
    highest = 0.45 * min(rate, wanted)
    low_pass = scipy.signal.firwin(801, 0.9 * highest, fs=rate, window=("kaiser", 9.0))
    noise = np.random.default_rng(rate).standard_normal((rate, 2))
    sound = scipy.signal.lfilter(low_pass, 1.0, noise, axis=0).astype(np.float32)
    resampler = Resampler(2, rate, wanted)
    found = np.concatenate([resampler.push(sound), resampler.flush()])
    ratio = resampler.rate_hz / rate
    up = next(n for n in range(1, 161) if abs(n / ratio - round(n / ratio)) < 1e-9)
    down = round(up / ratio)
    assert abs(resampler.rate_hz / wanted - 1.0) < 1e-3
    # A filter much longer than that of the resampler.
    sharp = scipy.signal.firwin(200 * max(up, down) + 1, 1.0 / max(up, down), window=("kaiser", 12.0))
    expected = scipy.signal.resample_poly(sound.astype(np.float64), up, down, window=sharp)
    # The cut at the end is not band-limited.
    inner = slice(0, len(expected) - round(0.05 * wanted))
    assert len(found) == len(expected)
    error = found[inner] - expected[inner]
    assert 20.0 * np.log10(error.std() / expected[inner].std()) < -85.0


@settings(deadline=None, max_examples=40)
@given(st.sampled_from(RATES), st.lists(st.integers(1, 3_000), max_size=20), st.integers(1, 9), SEEDS)
def test_resampling_in_blocks_is_identical_bit_for_bit(rates, cuts, channels, seed):
    sound = np.random.default_rng(seed).standard_normal((3_000, channels), dtype=np.float32)
    at_once, in_blocks = Resampler(channels, *rates), Resampler(channels, *rates)
    edges = [0, *sorted(set(cuts)), len(sound)]
    parts = [in_blocks.push(sound[start:end]) for start, end in pairwise(edges)]
    np.testing.assert_array_equal(np.concatenate(parts), at_once.push(sound))


def tone(frequency_hz: float, n: int, rate: float) -> np.ndarray:
    return np.cos(2 * np.pi * frequency_hz / rate * np.arange(n) + 0.3)


@settings(deadline=None, max_examples=40)
@given(
    cuts=st.lists(st.integers(0, 6000), max_size=8),
    rate=st.sampled_from([1_000, 2_500.0, 8_000, 47_998]),
    share=st.floats(0.0, 1.0),
)
def test_decimation_keeps_the_band_where_it_was(cuts: list[int], rate: float, share: float) -> None:
    """A tone in the band is unchanged, sampled at the stated times, for blocks of any length."""
    decimator, frequency = Decimator(rate, 300.0), 300.0 * share
    sound = tone(frequency, 6000, rate)
    heard = np.concatenate([decimator.push(block) for block in np.split(sound, sorted(cuts))])
    assert len(heard) == (6000 - decimator.n_taps) // decimator.factor + 1
    instants = (np.arange(len(heard)) * decimator.factor + 0.5 * (decimator.n_taps - 1)) / rate
    np.testing.assert_allclose(heard, np.cos(2 * np.pi * frequency * instants + 0.3), atol=3e-4)


@pytest.mark.parametrize("frequency_hz", [835.0, 1230.0, 1500.0, 5000.0, 23_000.0])
def test_decimation_leaves_no_aliases_in_the_band(frequency_hz: float) -> None:
    decimator = Decimator(47_998, 400.0)
    assert decimator.rate_hz - 400.0 < 835.0
    assert np.abs(decimator.push(tone(frequency_hz, 24_000, 47_998))).max() < 2e-4


CHARACTER_HZ = 6000.0
TIME_S = np.arange(18_000) / CHARACTER_HZ


def heard(sound: FloatArray, rate_hz: float = CHARACTER_HZ) -> dict[str, float]:
    """Return the measures at the end of a sound, by name."""
    character, hop = SoundCharacter(rate_hz), round(rate_hz / 10)
    for first in range(0, len(sound) - hop + 1, hop):
        character.push(sound[first : first + hop])
    read = character.read()
    assert not isinstance(read, NotUsable)
    return dict(zip((*MEASURES, *BANDS), read.tolist(), strict=True))


def noise(seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).standard_normal(len(TIME_S))


@given(st.floats(-60.0, 40.0))
@settings(max_examples=8, deadline=None)
def test_no_measure_depends_on_the_level(gain_db: float) -> None:
    sound = noise() * (1.2 + np.sin(2.0 * np.pi * 4.0 * TIME_S))
    louder = heard(10.0 ** (gain_db / 20.0) * sound)
    assert louder == pytest.approx(heard(sound), abs=1e-5)


@pytest.mark.parametrize(
    ("rate_hz", "group", "shared"),
    [(2.0, "1.3", "0.4"), (4.0, "2.8", "2.2"), (12.5, "10.2", "8.2"), (22.0, "16.2", "16.2")],
)
def test_modulation_is_found_at_its_rate_and_across_bands(rate_hz: float, group: str, shared: str) -> None:
    found = heard(noise() * (1.05 + np.sin(2.0 * np.pi * rate_hz * TIME_S)))
    still = heard(noise())
    rises = {name: found[name] - still[name] for name in MEASURES if name.startswith("modulation high")}
    assert max(rises, key=lambda name: rises[name]) == f"modulation high {group}"
    # Eight bands with common modulation have eight times the share of independent ones.
    assert found[f"together {shared}"] > np.log(4.0)
    assert max(still[name] for name in MEASURES if name.startswith("together")) < np.log(2.5)


@given(st.floats(100.0, 2600.0), st.integers(0, 99))
@settings(max_examples=10, deadline=None)
def test_a_tone_is_a_line_at_its_pitch(pitch_hz: float, seed: int) -> None:
    found = heard(np.sin(2.0 * np.pi * pitch_hz * TIME_S) + 0.3 * noise(seed))
    assert np.exp(found["line"]) == pytest.approx(pitch_hz, abs=6.0)
    assert found["line holds"] > 0.7
    assert found["line varies"] < 0.1
    part = max((low for low in (80, 300, 900) if low <= pitch_hz), default=80)
    if min(abs(pitch_hz - edge) for edge in (300, 900)) > 20.0:
        others = [found[f"steady {low}"] for low in (80, 300, 900) if low != part]
        assert found[f"steady {part}"] > max(others) + 2.0


def test_a_comb_of_harmonics_exceeds_noise() -> None:
    pulses = np.zeros(len(TIME_S))
    pulses[:: int(CHARACTER_HZ / 150)] = 1.0
    assert heard(pulses + 0.05 * noise())["comb"] > heard(noise())["comb"] + 0.4


@pytest.mark.parametrize("rate_hz", [16_000.0, 48_000.0])
def test_another_sample_rate_measures_the_same(rate_hz: float) -> None:
    sound = noise() * (1.05 + np.sin(2.0 * np.pi * 4.0 * TIME_S)) + np.sin(2.0 * np.pi * 700.0 * TIME_S)
    there, here = heard(scipy.signal.resample_poly(sound, int(rate_hz / 1000), 6), rate_hz), heard(sound)
    # The band filter delays one of them, so their windows differ by some milliseconds.
    assert {name: value for name, value in there.items() if abs(value - here[name]) > 0.35} == {}


def test_band_levels_are_relative_to_their_mean() -> None:
    found = heard(noise() + 3.0 * np.sin(2.0 * np.pi * 650.0 * TIME_S))
    bands = {name: found[name] for name in BANDS}
    assert max(bands, key=lambda name: bands[name]) == "band 580"
    assert sum(bands.values()) == pytest.approx(0.0, abs=1e-9)


def test_two_seconds_are_needed() -> None:
    character = SoundCharacter(CHARACTER_HZ)
    for _ in range(20):
        character.push(np.ones(600))
        assert isinstance(character.read(), NotUsable)
    character.push(np.ones(600))
    assert not isinstance(character.read(), NotUsable)
