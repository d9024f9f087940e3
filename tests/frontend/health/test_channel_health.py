"""Faulty microphones, cards and clocks are found, classified and left out; healthy arrays raise no fault."""

import re
from collections import Counter
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st
from plane_waves import array_check, position_check
from scipy.ndimage import map_coordinates

from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array, roof_array_56
from worldstate.frontend.health.channel_health import ArrayHealth, ChannelFault
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.values import NotUsable
from worldstate.operations.recordings.channel_report import ChannelVerdict, HealthLog
from worldstate.simulation import site
from worldstate.simulation.stream.settings import StreamSettings, traffic_named
from worldstate.simulation.stream.writing import write_stream

RATE = 16_000
ROOF = roof_array_56()
HALF = MicrophoneArray(ROOF.positions_m[::2])


def street(
    array: MicrophoneArray, seed: int, seconds: float = 3.5, waves: int = 10, slope: float = 1.0, rate=RATE
) -> np.ndarray:
    """Red noise of changing level from many directions, every microphone 0.3 dB and 0.02 ms off, (n, M)."""
    rng, n = np.random.default_rng(seed), round(seconds * rate)
    frequencies, ends = np.fft.rfftfreq(n, 1 / rate), np.arange(0, n + rate, rate)
    colour = (1.0 + frequencies / 300.0) ** -slope * (frequencies < 0.45 * rate)
    own_delay = 2e-5 * rng.standard_normal(array.n_microphones)
    sound = np.zeros((len(frequencies), array.n_microphones), np.complex64)
    for azimuth in rng.uniform(-np.pi, np.pi, waves):
        level = np.exp(np.interp(np.arange(n), ends, rng.normal(0, 0.5, len(ends))))
        wave = np.fft.rfft(rng.standard_normal(n) * level) * colour
        late = array.delays_s(azimuth, abs(rng.normal(0, 0.1))) + own_delay
        sound += wave[:, None] * np.exp(-2j * np.pi * frequencies[:, None] * late)
    heard = np.fft.irfft(sound, n, axis=0) * 10.0 ** (0.3 * rng.standard_normal(array.n_microphones) / 20.0)
    heard += 0.03**slope * heard.std() * rng.standard_normal(heard.shape)
    return np.asarray(heard / heard.std(), np.float32)


def healths(array: MicrophoneArray, sound: np.ndarray, rate: float = RATE) -> list[ArrayHealth]:
    found = [frame.health for frame in FrontEnd(array, rate).process(sound)]
    return [health for health in found if isinstance(health, ArrayHealth)]


def named(faults: Iterable[ChannelFault | ChannelVerdict]) -> dict[str, set[int]]:
    kinds: dict[str, set[int]] = {}
    for one in faults:
        kinds.setdefault(one.fault.value, set()).add(one.channel)
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
    "constant": ({"dead": {3, 17}}, True),
    "nearly dead": ({"dead": {5}}, True),
    "interrupted": ({"intermittent": {9}}, True),
    "crackling": ({"intermittent": {11}}, True),
    "noise": ({"noisy": {2, 20}}, True),
    "inverted": ({"inverted": {13}}, True),
    "swapped": ({"swapped": {1, 22}}, True),
    "clipped": ({"clipped": {6, 25}}, False),
    "offset": ({"offset": {8}}, False),
    "gain": ({"level": {0, 27}}, False),
}


@pytest.mark.long
@pytest.mark.parametrize("kind", FAULTS)
@pytest.mark.parametrize("seed", [1, 2])
def test_exactly_the_faults_present_are_found(kind: str, seed: int) -> None:
    expected, masked = FAULTS[kind]
    # It takes six seconds to distinguish a gain from a gust.
    sound = street(HALF, seed, seconds=6.5 if kind == "gain" else 3.5)
    spoil(sound, kind, np.random.default_rng(50 + seed))
    last = healths(HALF, sound)[-1]
    assert named(last.faults) == expected
    left_out = set(np.flatnonzero(~last.mask.keep).tolist())
    assert left_out == (next(iter(expected.values())) if masked else set())
    assert last.n_dropouts == 0


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "levels"), [*((seed, None) for seed in range(100, 104)), *((8, levels) for levels in (2, 5, 30))]
)
def test_a_clean_street_raises_no_alarm(seed: int, levels: int | None) -> None:
    """Coarse quantisation is not reported as clipping."""
    array = (HALF, ROOF)[seed % 2]
    sound = street(array, seed)
    if levels is not None:
        sound = np.round(sound * levels).astype(np.float32)
    assert all(health.is_healthy for health in healths(array, sound))


def test_independent_noise_is_not_classified() -> None:
    sound = np.random.default_rng(0).standard_normal((3 * RATE, 8))
    last = healths(MicrophoneArray(ROOF.positions_m[:8]), sound)[-1]
    assert last.is_healthy
    assert isinstance(last.coherence, NotUsable)


def test_silence_is_dead_after_a_second() -> None:
    array = MicrophoneArray(ROOF.positions_m[:4])
    last = healths(array, np.zeros((3 * RATE, 4)))[-1]
    assert named(last.faults) == {"dead": {0, 1, 2, 3}}
    assert last.n_dropouts == 0


@pytest.mark.long
def test_a_dead_channel_is_masked_at_once_and_returns() -> None:
    sound = street(HALF, 9, seconds=9.0)
    sound[: 2 * RATE, 4] = 0.0
    found = healths(HALF, sound)
    assert named(found[0].faults) == {"dead": {4}}
    assert not found[0].mask.keep[4]
    assert named(found[12].faults) == {"intermittent": {4}}
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
    sound = street(HALF, 12, seconds=6.0, slope=2.0)
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


# Cards and clocks at a low sample rate, in a large and in a small array. A second clock is found after 10 s
# among many channels and after 15 to 30 s among eight.
LOW = 6000
ARRAYS = {56 // step: MicrophoneArray(ovad_array().positions_m[::step]) for step in (2, 7)}
CARD = {28: slice(8, 16), 8: slice(4, 8)}
SECONDS_OF = {28: 11.0, 8: 20.0}
STREAMS = (("SA1", "calm"), ("SA2", "busy"), ("SB1", "empty"), ("SB3", "no-hazard"))

Spoil = Callable[[np.ndarray, int, np.random.Generator], dict[str, set[int]]]


@cache
def low_street(n_channels: int) -> np.ndarray:
    return street(ARRAYS[n_channels], 7, SECONDS_OF[n_channels], rate=LOW)


def gain(x: np.ndarray, m: int, rng: np.random.Generator) -> dict[str, set[int]]:
    x[:, m - 2] *= 2.0
    return {"level": {m - 2}}


def gusts(x: np.ndarray, m: int, rng: np.random.Generator) -> dict[str, set[int]]:
    hit = rng.choice(m, 3, replace=False)
    for channel in hit:
        for start in rng.integers(0, len(x) - LOW, 3):
            x[start : start + LOW, channel] += 4.0 * rng.standard_normal(LOW)
    return {"gusts": set(hit.tolist())}


def offset(x: np.ndarray, m: int, rng: np.random.Generator) -> dict[str, set[int]]:
    return {"delayed": resampled(x, m, 3e-4 * LOW * np.ones(len(x)))}


def drift(x: np.ndarray, m: int, rng: np.random.Generator) -> dict[str, set[int]]:
    return {"drifting": resampled(x, m, 5e-5 * np.arange(len(x)))}


def resampled(x: np.ndarray, m: int, late_samples: np.ndarray) -> set[int]:
    places, channels = [np.arange(len(x)) - late_samples], range(m)[CARD[m]]
    for channel in channels:
        x[:, channel] = map_coordinates(x[:, channel].astype(float), places, order=5, mode="nearest")
    return set(channels)


def exchange(x: np.ndarray, m: int, rng: np.random.Generator) -> dict[str, set[int]]:
    pair = [1, m // 2]
    x[:, pair] = x[:, pair[::-1]]
    return {"swapped": set(pair)}


def heard(array: MicrophoneArray, sound: np.ndarray) -> tuple[dict[str, set[int]], list[ChannelFault]]:
    """Return the faults of the whole recording and those of the last hop."""
    log, frames = HealthLog(), FrontEnd(array, LOW).process(sound)
    for frame in frames:
        log.add(frame)
    return named(log.summary().verdicts), list(frames[-1].health.faults)


@pytest.mark.parametrize("n_channels", ARRAYS)
def test_a_healthy_array_is_silent(n_channels: int) -> None:
    assert heard(ARRAYS[n_channels], low_street(n_channels)) == ({}, [])


@pytest.mark.long
@pytest.mark.parametrize(
    ("spoil", "n_channels"),
    [(exchange, 28), *((spoil, n) for spoil in (gain, gusts, offset, drift) for n in ARRAYS)],
)
def test_each_timing_fault_is_found_alone(spoil: Spoil, n_channels: int) -> None:
    sound = low_street(n_channels).copy()
    expected = spoil(sound, n_channels, np.random.default_rng(3))
    kinds, latest = heard(ARRAYS[n_channels], sound)
    assert kinds == expected
    if spoil is gusts:
        return
    assert {fault.channel for fault in latest} == next(iter(expected.values()))
    size = {"level": 6.0, "delayed": 3e-4, "drifting": 5e-5}.get(latest[0].fault.value)
    if size is not None:
        assert latest[0].value == pytest.approx(size, rel=0.25)
    # The stated error must be small relative to the value.
    assert latest[0].std is None or latest[0].std < 0.2 * abs(latest[0].value)


def order_of(sound: np.ndarray) -> tuple[int, ...] | None:
    """Return the order of eight channels that fits better than the claimed one."""
    return position_check(ARRAYS[8], sound, LOW).verdict(np.ones(8, bool)).order


@pytest.mark.parametrize(("a", "b"), [(0, 7), (1, 4), (2, 6), (5, 7)])
def test_an_exchange_of_eight_is_found_by_the_positions_alone(a: int, b: int) -> None:
    expected, sound = np.arange(8), low_street(8).copy()
    expected[[a, b]], sound[:, [a, b]] = [b, a], sound[:, [b, a]]
    assert order_of(sound) == tuple(expected)


@pytest.mark.slow
def test_twenty_recordings_of_eight_microphones(tmp_path: Path) -> None:
    """Four simulated streams of 150 s: no false fault, and each fault found in 18 of 20 pieces of 30 s."""
    found: Counter[str] = Counter()
    n_false, rng = 0, np.random.default_rng(31)
    for seed, (place, traffic) in enumerate(STREAMS, start=81):
        plan = StreamSettings(site(place), 2.5, seed, traffic_named(traffic), sample_rate_hz=float(LOW))
        folder = write_stream(tmp_path, plan, array=ARRAYS[8]).folder
        sound = soundfile.read(folder / "out_multi.wav", dtype="float32")[0]
        n_false += len(heard(ARRAYS[8], sound)[0])
        for piece in np.split(sound, 5):
            for fault in (gain, gusts, offset, drift, exchange):
                spoilt = piece / piece.std()
                ((kind, channels),) = fault(spoilt, 8, rng).items()
                if fault is exchange:
                    found[kind] += order_of(spoilt) is not None
                else:
                    found[kind] += heard(ARRAYS[8], spoilt)[0].get(kind, set()) >= channels
    print(dict(found), "of 20,", n_false, "false in ten minutes")
    assert n_false == 0
    assert min(found[kind] for kind in ("level", "gusts", "delayed", "drifting", "swapped")) >= 18


def test_array_check_prints_the_delay_of_a_late_card(tmp_path, capsys):
    sound = low_street(8)[: 12 * LOW].copy()
    offset(sound, 8, np.random.default_rng(0))
    assert array_check(tmp_path, ARRAYS[8], 0.1 * sound, LOW) == 1
    lines = capsys.readouterr().out.splitlines()
    (row,) = (line for line in lines if "delayed" in line and "%" in line)
    assert row.split()[:2] == ["5-8", "delayed"]
    assert re.search(r"0\.(2[5-9]|3[0-5]) \+- 0\.0\d ms later than the others", row)
    assert lines[-1] == "not healthy: delayed 5, 6, 7, 8; 4 excluded by the front-end"
