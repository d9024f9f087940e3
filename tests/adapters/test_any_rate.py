"""Sound of any rate from 8 kHz up gives the states of 48 kHz."""

import io
from dataclasses import replace
from fractions import Fraction
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import firwin, resample_poly

from worldstate.adapters import ListenSettings, Model, Step, listen_steps, open_source, read_array, read_model
from worldstate.adapters.audio.sound_file import RawPcm
from worldstate.frontend import AcousticFrame, FrontEnd, MicrophoneArray, ovad_array
from worldstate.ground import wrap_angle
from worldstate.ground.typing import Float32Array
from worldstate.measurement.measurement import Bearing
from worldstate.simulation import draw_settings, simulate_recording

FULL_HZ = 48_000
RATES = (8_000, 11_025, 16_000, 22_050, 32_000, 44_100, 96_000)
RING = read_array("uma-8")


class Heard(NamedTuple):
    """An array, a model of it, and a simulated approach at 48 kHz."""

    array: MicrophoneArray
    model: Model
    sound: Float32Array


def resampled(sound: Float32Array, rate: int) -> Float32Array:
    """Return sound resampled by scipy, whose default filter changes decisions of the trees."""
    up, down = Fraction(rate, FULL_HZ).as_integer_ratio()
    longest = max(up, down)
    taps = firwin(400 * longest + 1, 0.98 / longest, window=("kaiser", 14.0))
    return resample_poly(sound, up, down, window=taps).astype(np.float32)


def steps(heard: Heard, rate: int) -> list[Step]:
    samples = io.BytesIO(resampled(heard.sound, rate).tobytes())
    pipe = RawPcm(samples, rate, heard.array.n_microphones, "f32")
    return list(listen_steps(open_source(pipe, array=heard.array, model=heard.model)))


@pytest.fixture(scope="module", params=["roof of 56", "ring of 7"])
def heard(request: pytest.FixtureRequest) -> Heard:
    array = RING if request.param == "ring of 7" else ovad_array()
    rng = np.random.default_rng(3)
    drawn = replace(draw_settings("SA1", "left", rng, duration_s=6.0), sample_rate_hz=float(FULL_HZ))
    return Heard(array, read_model(array=array), simulate_recording(drawn, rng, array).audio)


@pytest.fixture(scope="module")
def at_full_rate(heard: Heard) -> list[Step]:
    return steps(heard, FULL_HZ)


@pytest.mark.long
@pytest.mark.parametrize("rate", RATES)
def test_states_do_not_depend_on_the_sample_rate(heard: Heard, at_full_rate: list[Step], rate: int) -> None:
    if heard.array is not RING and rate not in (16_000, 44_100):
        pytest.skip("eight times the microphones take eight times as long")
    found = steps(heard, rate)
    assert [one.state.stamp_ns for one in found] == [one.state.stamp_ns for one in at_full_rate]
    assert [one.frame.sample_index for one in found][-1] == pytest.approx(6 * rate, abs=1)
    pairs = list(zip(found, at_full_rate, strict=True))
    bearings = [(one.measurement.bearing, other.measurement.bearing) for one, other in pairs]
    both = [(a, b) for a, b in bearings if isinstance(a, Bearing) and isinstance(b, Bearing)]
    assert len(both) >= 0.9 * sum(isinstance(b, Bearing) for _, b in bearings) > 0
    off_deg = np.degrees([abs(wrap_angle(a.azimuth_rad - b.azimuth_rad)) for a, b in both])
    assert off_deg.max() < 0.5
    for one, other in pairs:
        for cue, expected in zip(one.state.cues, other.state.cues, strict=True):
            assert cue.risk == pytest.approx(expected.risk, abs=0.02)
            assert cue.within == (expected.within and pytest.approx(expected.within, abs=0.02))
        np.testing.assert_allclose(one.frame.feature, other.frame.feature, atol=1e-3)
        np.testing.assert_allclose(one.frame.band_log_energy, other.frame.band_log_energy, atol=0.01)


@pytest.mark.parametrize("rate", [44_056, 43_000, 47_000, 7_000])
def test_odd_sample_rates_keep_exact_stamps(rate: int) -> None:
    sound = np.random.default_rng(rate).standard_normal((round(1.25 * rate), 7)).astype(np.float32)
    front_end = FrontEnd(RING, rate, ListenSettings().front_end(RING, rate))
    frames = front_end.process(sound) + front_end.finish()
    assert [frame.stamp_ns for frame in frames] == pytest.approx([1.0e9, 1.1e9, 1.2e9], abs=1e9 / rate)
    assert [frame.sample_index for frame in frames] == [rate, round(1.1 * rate), round(1.2 * rate)]
    assert front_end.heard_rate_hz == pytest.approx(front_end.settings.heard_rate_hz, rel=4e-3)


@settings(deadline=None, max_examples=8)
@given(st.sampled_from([8_000, 11_025, 44_100]), st.lists(st.integers(1, 60_000), max_size=30))
def test_blocks_of_any_length_give_the_same_frames_to_the_bit(rate: int, cuts: list[int]) -> None:
    sound = np.random.default_rng(rate).standard_normal((round(1.3 * rate), 7)).astype(np.float32)
    whole, parted = (FrontEnd(RING, rate, ListenSettings().front_end(RING, rate)) for _ in range(2))
    blocks = np.split(sound, sorted({cut for cut in cuts if cut < len(sound)}))
    found = [frame for block in blocks for frame in parted.process(block)] + parted.finish()
    expected = whole.process(sound) + whole.finish()
    assert len(found) == len(expected) == 4
    for one, other in zip(found, expected, strict=True):
        told = [(frame.stamp_ns, frame.sample_index, frame.bearing_rad) for frame in (one, other)]
        assert told[0] == told[1]
        np.testing.assert_array_equal(one.feature, other.feature)
        np.testing.assert_array_equal(one.band_log_energy, other.band_log_energy)


def frames_of(heard: Heard, sound: Float32Array, rate: int) -> list[AcousticFrame]:
    return FrontEnd(heard.array, rate, ListenSettings().front_end(heard.array, rate)).process(sound)


@pytest.mark.long
def test_faults_are_detected_before_resampling(heard: Heard) -> None:
    # Resampling hides clipping and repeated samples.
    rate = 44_100
    sound = 0.5 * resampled(heard.sound, rate) / np.abs(heard.sound).max()
    clipped = [one.health.clipped for one in frames_of(heard, np.clip(sound, -0.1, 0.1), rate)]
    at_full = np.clip(0.5 * heard.sound / np.abs(heard.sound).max(), -0.1, 0.1)
    expected = [one.health.clipped for one in frames_of(heard, at_full, FULL_HZ)]
    assert np.mean(clipped) == pytest.approx(np.mean(expected), rel=0.1) and max(clipped) > 0.001
    # A quarter of a second is repeated.
    sound[2 * rate :][: rate // 4] = sound[: 2 * rate][-(rate // 4) :]
    frames = frames_of(heard, sound, rate)
    assert max(one.lost for one in frames) == pytest.approx(0.25, abs=0.02)
    assert "repeat" in {one.kind for one in frames[-1].health.dropouts}
