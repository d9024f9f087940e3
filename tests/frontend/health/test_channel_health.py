"""Faulty microphones are found, classified and left out; healthy arrays raise no fault."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.frontend.health.channel_health import ArrayHealth
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.values import NotUsable
from worldstate.simulation import draw_settings, simulate_recording

RATE = 16_000
ROOF = roof_array_56()
HALF = MicrophoneArray(ROOF.positions_m[::2])
SECONDS = 3.5


def street(
    array: MicrophoneArray, seed: int, seconds: float = SECONDS, waves: int = 10, slope: float = 1.0
) -> np.ndarray:
    """Red noise from many directions of the half circle ahead, and each microphone's own noise, (n, M)."""
    rng, n = np.random.default_rng(seed), round(seconds * RATE)
    frequencies = np.fft.rfftfreq(n, 1 / RATE)
    colour = (1.0 + frequencies / 300.0) ** -slope
    colour[frequencies > 0.45 * RATE] = 0.0
    sound = np.zeros((len(frequencies), array.n_microphones), complex)
    for azimuth in rng.uniform(-1.5, 1.5, waves):
        wave = np.fft.rfft(rng.standard_normal(n) * rng.uniform(0.3, 1.0)) * colour
        sound += wave[:, None] * array.steering(frequencies, azimuth, rng.normal(0, 0.2))[:, :, 0]
    heard = np.fft.irfft(sound, n, axis=0)
    own = 0.03**slope * heard.std() * rng.standard_normal(heard.shape)
    return np.asarray((heard + own) / heard.std(), np.float32)


def healths(array: MicrophoneArray, sound: np.ndarray, rate: float = RATE) -> list[ArrayHealth]:
    found = [frame.health for frame in FrontEnd(array, rate).process(sound)]
    return [health for health in found if isinstance(health, ArrayHealth)]


def named(health: ArrayHealth) -> dict[str, list[int]]:
    kinds: dict[str, list[int]] = {}
    for fault in health.faults:
        kinds.setdefault(fault.fault.value, []).append(fault.channel)
    return kinds


def spoil(x: np.ndarray, kind: str, rng: np.random.Generator) -> None:
    """Give some of 28 channels a fault, in place."""
    match kind:
        case "constant":
            x[:, [3, 17]] = [0.0, 0.4]
        case "nearly dead":
            x[:, 5] = 1e-3 * rng.standard_normal(len(x))
        case "interrupted":
            for start in (20_000, 33_000, 41_000):
                x[start : start + 1200, 9] = 0.0
        case "crackling":
            for start in range(17_000, 55_000, 7000):
                x[start : start + 20, 11] += 40 * rng.standard_normal(20)
        case "noise":
            x[:, [2, 20]] = rng.standard_normal((len(x), 2))
        case "inverted":
            x[:, 13] *= -1
        case "swapped":
            x[:, [1, 22]] = x[:, [22, 1]]
        case "clipped":
            x[:, 6] = x[:, 6].clip(-1.5, 1.5)
            x[:, 25] = x[:, 25].clip(-9.0, 1.2)
        case "offset":
            x[:, 8] += 2.0
        case "gain":
            x[:, [0, 27]] *= [8.0, 0.1]


FAULTS = {
    "constant": ({"dead": [3, 17]}, True),
    "nearly dead": ({"dead": [5]}, True),
    "interrupted": ({"intermittent": [9]}, True),
    "crackling": ({"intermittent": [11]}, True),
    "noise": ({"noisy": [2, 20]}, True),
    "inverted": ({"inverted": [13]}, True),
    "swapped": ({"swapped": [1, 22]}, True),
    "clipped": ({"clipped": [6, 25]}, False),
    "offset": ({"offset": [8]}, False),
    "gain": ({"level": [0, 27]}, False),
}


@pytest.mark.long
@pytest.mark.parametrize("kind", FAULTS)
@pytest.mark.parametrize("seed", [1, 2])
def test_exactly_the_faults_present_are_found(kind: str, seed: int) -> None:
    expected, masked = FAULTS[kind]
    # It takes six seconds to distinguish a gain from a gust.
    sound = street(HALF, seed, seconds=6.5 if kind == "gain" else SECONDS)
    spoil(sound, kind, np.random.default_rng(50 + seed))
    last = healths(HALF, sound)[-1]
    assert named(last) == expected
    left_out = np.flatnonzero(~last.mask.keep).tolist()
    assert left_out == (next(iter(expected.values())) if masked else [])
    assert last.n_dropouts == 0


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "levels"), [*((seed, None) for seed in range(100, 104)), *((8, levels) for levels in (2, 5, 30))]
)
def test_a_clean_street_raises_no_alarm(seed: int, levels: int | None) -> None:
    """Coarse quantisation is no clipping."""
    array = (HALF, ROOF)[seed % 2]
    sound = street(array, seed)
    if levels is not None:
        sound = np.round(sound * levels).astype(np.float32)
    assert all(health.is_healthy for health in healths(array, sound))


@pytest.mark.long
@pytest.mark.parametrize(("approach", "seed"), [("left", 5), ("none", 6)])
def test_simulated_junctions_raise_no_alarm_and_show_a_swap(approach: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    recording = simulate_recording(draw_settings("SB1", approach, rng, duration_s=2.2), rng, ROOF)
    found = healths(ROOF, recording.audio, recording.sample_rate_hz)
    assert all(health.is_healthy for health in found)
    assert isinstance(found[-1].coherence, float)
    swapped = recording.audio.copy()
    swapped[:, [3, 40]] = recording.audio[:, [40, 3]]
    assert named(healths(ROOF, swapped, recording.sample_rate_hz)[-1]) == {"swapped": [3, 40]}


def test_independent_noise_is_not_classified() -> None:
    sound = np.random.default_rng(0).standard_normal((3 * RATE, 8))
    last = healths(MicrophoneArray(ROOF.positions_m[:8]), sound)[-1]
    assert last.is_healthy
    assert isinstance(last.coherence, NotUsable)


def test_silence_is_dead_after_a_second() -> None:
    array = MicrophoneArray(ROOF.positions_m[:4])
    last = healths(array, np.zeros((3 * RATE, 4)))[-1]
    assert named(last) == {"dead": [0, 1, 2, 3]}
    assert last.n_dropouts == 0


@pytest.mark.long
def test_a_dead_channel_is_masked_at_once_and_returns() -> None:
    sound = street(HALF, 9, seconds=9.0)
    sound[: 2 * RATE, 4] = 0.0
    found = healths(HALF, sound)
    assert named(found[0]) == {"dead": [4]}
    assert not found[0].mask.keep[4]
    assert named(found[12]) == {"intermittent": [4]}
    assert found[-1].is_healthy
    assert found[-1].mask.is_whole


@pytest.mark.long
@settings(deadline=None, max_examples=5)
@given(dead=st.sets(st.integers(0, 27), max_size=20), seed=st.integers(0, 99))
def test_a_mask_equals_the_array_without_those_channels(dead: set[int], seed: int) -> None:
    sound = street(HALF, seed, seconds=1.3)
    rest = np.setdiff1d(np.arange(28), list(dead))
    sound[:, list(dead)] = 0.0
    ours = FrontEnd(HALF, RATE).process(sound)[-1]
    theirs = FrontEnd(MicrophoneArray(HALF.positions_m[rest]), RATE).process(sound[:, rest])[-1]
    np.testing.assert_allclose(ours.srp, theirs.srp, rtol=1e-4)
    np.testing.assert_allclose(ours.feature, theirs.feature, rtol=1e-3)
    assert ours.bearing_rad == pytest.approx(theirs.bearing_rad, abs=1e-4)


def test_a_dying_channel_causes_no_step_in_looming_and_levels() -> None:
    array = MicrophoneArray(ROOF.positions_m[::8])
    time = np.arange(2 * RATE) / RATE
    sound = street(array, 11, seconds=2.0, waves=1) / (30.0 - 10.0 * time)[:, None].astype(np.float32)
    broken = sound.copy()
    broken[round(1.55 * RATE) :, 1:4] = 0.0
    frames = (FrontEnd(array, RATE).process(one) for one in (sound, broken))
    for well, ill in zip(*frames, strict=True):
        assert abs(well.looming.inverse_tta_hz - ill.looming.inverse_tta_hz) < 2 * well.looming.std_hz
        np.testing.assert_allclose(well.band_log_energy, ill.band_log_energy, atol=0.8)


def test_dropouts_are_found_at_their_samples() -> None:
    sound = street(HALF, 14, seconds=6.0, slope=2.0)
    cut = np.delete(sound, np.arange(30_000, 30_777), axis=0)
    cut[50_000:50_300] = cut[49_999]
    cut[70_000:70_800] = cut[69_200:70_000]
    last = healths(HALF, cut)[-1]
    assert last.faults == ()
    splices = [dropout.sample for dropout in last.dropouts if dropout.kind == "splice"]
    assert splices[0] == pytest.approx(30_000, abs=1)
    # Both ends of a repeat are splices as well.
    assert all(min(abs(s - 70_000), abs(s - 70_800)) <= 1 for s in splices[1:])
    assert [(dropout.sample, dropout.n_samples) for dropout in last.dropouts if dropout.kind == "still"] == [
        (49_999, 301)
    ]
    (repeat,) = (dropout for dropout in last.dropouts if dropout.kind == "repeat")
    assert 70_000 <= repeat.sample < 70_800


def test_lost_packets_are_no_microphone_faults():
    rng = np.random.default_rng(5)
    sound = rng.standard_normal((40_000, 1)) + 0.3 * rng.standard_normal((40_000, 3))
    for first in (9_900, 13_300, 17_750):
        sound[first : first + 400] = 0.0  # 50 ms of every channel, across the ends of hops
    array = MicrophoneArray([[0, 0.2, 0], [0, 0.0, 0], [0, -0.3, 0]])
    frames = FrontEnd(array, 8_000).process(sound)
    assert frames[-1].health.n_dropouts == 3
    assert all(frame.health.mask.keep.all() for frame in frames)
    assert not any(frame.health.faults for frame in frames)
