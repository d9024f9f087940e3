"""Measures of the sound of one microphone, tested on signals of known modulation and tones."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import resample_poly

from worldstate.frontend.spectra.sound_character import BANDS, MEASURES, SoundCharacter
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import NotUsable

RATE = 6000.0
SECONDS = 3.0


def heard(sound: FloatArray, rate_hz: float = RATE) -> dict[str, float]:
    """Return the measures at the end of a sound, by name."""
    character, hop = SoundCharacter(rate_hz), round(rate_hz / 10)
    for first in range(0, len(sound) - hop + 1, hop):
        character.push(sound[first : first + hop])
    read = character.read()
    assert not isinstance(read, NotUsable)
    return dict(zip((*MEASURES, *BANDS), read.tolist(), strict=True))


def noise(rate_hz: float = RATE, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).standard_normal(int(SECONDS * rate_hz))


def time(rate_hz: float = RATE) -> FloatArray:
    return np.arange(int(SECONDS * rate_hz)) / rate_hz


@given(st.floats(-60.0, 40.0))
@settings(max_examples=8, deadline=None)
def test_no_measure_depends_on_the_level(gain_db: float) -> None:
    sound = noise() * (1.2 + np.sin(2.0 * np.pi * 4.0 * time()))
    louder = heard(10.0 ** (gain_db / 20.0) * sound)
    assert louder == pytest.approx(heard(sound), abs=1e-5)


@given(
    st.sampled_from([(2.0, "1.3", "0.4"), (4.0, "2.8", "2.2"), (12.5, "10.2", "8.2"), (22.0, "16.2", "16.2")])
)
@settings(max_examples=4, deadline=None)
def test_modulation_is_found_at_its_rate_and_across_bands(case: tuple[float, str, str]) -> None:
    rate_hz, group, shared = case
    found = heard(noise() * (1.05 + np.sin(2.0 * np.pi * rate_hz * time())))
    still = heard(noise())
    rises = {name: found[name] - still[name] for name in MEASURES if name.startswith("modulation high")}
    assert max(rises, key=lambda name: rises[name]) == f"modulation high {group}"
    # Eight bands with common modulation have eight times the share of independent ones.
    assert found[f"together {shared}"] > np.log(4.0)
    assert max(still[name] for name in MEASURES if name.startswith("together")) < np.log(2.5)


@given(st.floats(100.0, 2600.0), st.integers(0, 99))
@settings(max_examples=10, deadline=None)
def test_a_tone_is_a_line_at_its_pitch(pitch_hz: float, seed: int) -> None:
    found = heard(np.sin(2.0 * np.pi * pitch_hz * time()) + 0.3 * noise(seed=seed))
    assert np.exp(found["line"]) == pytest.approx(pitch_hz, abs=6.0)
    assert found["line holds"] > 0.7
    assert found["line varies"] < 0.1
    part = max((low for low in (80, 300, 900) if low <= pitch_hz), default=80)
    if min(abs(pitch_hz - edge) for edge in (300, 900)) > 20.0:
        others = [found[f"steady {low}"] for low in (80, 300, 900) if low != part]
        assert found[f"steady {part}"] > max(others) + 2.0


def test_a_comb_of_harmonics_exceeds_noise() -> None:
    pulses = np.zeros(int(SECONDS * RATE))
    pulses[:: int(RATE / 150)] = 1.0
    assert heard(pulses + 0.05 * noise())["comb"] > heard(noise())["comb"] + 0.4


@pytest.mark.parametrize("rate_hz", [16_000.0, 48_000.0])
def test_another_sample_rate_measures_the_same(rate_hz: float) -> None:
    sound = noise() * (1.05 + np.sin(2.0 * np.pi * 4.0 * time())) + np.sin(2.0 * np.pi * 700.0 * time())
    there, here = heard(resample_poly(sound, int(rate_hz / 1000), 6), rate_hz), heard(sound)
    # The band filter delays one of them, so their windows differ by some milliseconds.
    assert {name: value for name, value in there.items() if abs(value - here[name]) > 0.35} == {}


def test_band_levels_are_relative_to_their_mean() -> None:
    found = heard(noise() + 3.0 * np.sin(2.0 * np.pi * 650.0 * time()))
    bands = {name: found[name] for name in BANDS}
    assert max(bands, key=lambda name: bands[name]) == "band 580"
    assert sum(bands.values()) == pytest.approx(0.0, abs=1e-9)


def test_two_seconds_are_needed() -> None:
    character = SoundCharacter(RATE)
    for _ in range(20):
        character.push(np.ones(600))
        assert isinstance(character.read(), NotUsable)
    character.push(np.ones(600))
    assert not isinstance(character.read(), NotUsable)
