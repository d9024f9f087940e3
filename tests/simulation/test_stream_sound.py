"""Sound of a stream: sum of events, levels, seams, determinism and bounded memory."""

import csv
import json
import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import coherence, welch
from simulated_sound import PAIR, made, refusal

from worldstate.adapters.datasets.ovad import Recording, choose_array, read_true_tracks
from worldstate.commissioning.heard_stream import junction_named
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import Float32Array
from worldstate.simulation import preset, site
from worldstate.simulation.scene.junction import drawn_site
from worldstate.simulation.scene.kinds import LIGHT
from worldstate.simulation.scene.presets import site_ambience
from worldstate.simulation.scene.settings import SoundSettings
from worldstate.simulation.stream.arrivals import Event, SoundEvent, VehicleEvent
from worldstate.simulation.stream.manoeuvres import MANOEUVRES, Driver
from worldstate.simulation.stream.rendering import (
    EVENT,
    OVERLAP_S,
    EventSound,
    StreamScene,
    draw_microphones,
    event_sound,
    loudness_db,
    render_blocks,
    row_times,
)
from worldstate.simulation.stream.settings import StreamSettings, Traffic
from worldstate.simulation.stream.truth import visible_s
from worldstate.simulation.stream.writing import draw_stream

# No source changes its level, so the rest is stationary.
STILL = replace(preset(), name="still", far_rate=0.0, wave_fluctuation_db=0.0, ambient_waves=8)


def scene_of(minutes: float, rate_hz: float = 6000.0) -> StreamScene:
    settings = StreamSettings(site("SB1"), minutes, preset=STILL, sample_rate_hz=rate_hz)
    microphones = draw_microphones(settings, PAIR, np.random.default_rng(3))
    return StreamScene(settings, site_ambience(settings.site, STILL), microphones)


def event_at(start_s: float, flow: str = "left", reach_m: float = 20.0) -> VehicleEvent:
    driver = Driver(site("SB1"), LIGHT, "left", 9.0, 0.0, reach_m)
    return VehicleEvent(flow, MANOEUVRES[flow](driver, np.random.default_rng(1)), start_s)


def alone_in(scene: StreamScene, event: Event, rng: np.random.Generator | None = None) -> EventSound:
    rng = rng or np.random.default_rng(2)
    return event_sound(event, site("SB1"), scene.settings.preset, scene.microphones, rng)


def sound_of(scene: StreamScene, events: Sequence[Event]) -> Float32Array:
    return np.concatenate([block.pressure_pa for block in render_blocks(scene, events)], axis=1)


def test_a_stream_is_the_sum_of_background_and_events() -> None:
    scene = scene_of(36.0 / 60.0, rate_hz=3000.0)
    # The first begins before the stream, the second and third overlap the edge of a piece (30 s), the
    # last ends after the stream.
    early, late = event_at(-1.0, reach_m=8.0), event_at(34.5, reach_m=8.0)
    steps = SoundEvent(SoundSettings("steps", 2.0, 3.0, (3.0, 2.0)), 27.0)
    events = [early, event_at(28.5, reach_m=8.0), event_at(29.5, "turns_away", 10.0), late, steps]
    # The two pieces of 30 s do not depend on the number of processes that render them.
    blocks = list(render_blocks(scene, events, jobs=2))
    added = np.concatenate([block.pressure_pa for block in blocks], axis=1) - sound_of(scene, ())
    told_db = {number: levels[0] for block in blocks for number, levels in block.loudness_db.items()}
    expected = np.zeros((2, 36 * 3000))
    for number, event in enumerate(events):
        alone = alone_in(scene, event, scene.settings.generator(EVENT, number))
        begin, end = max(alone.first, 0), min(alone.first + alone.pressure_pa.shape[1], expected.shape[1])
        expected[:, begin:end] += alone.pressure_pa[:, begin - alone.first : end - alone.first]
        rows_s = row_times(event, scene.settings)
        levels = [loudness_db(alone, rows_s, 3000.0, banded=banded) for banded in (False, True)]
        np.testing.assert_allclose(told_db[number], levels, atol=1e-6)
    assert np.abs(expected).max() > 0.05
    np.testing.assert_allclose(added, expected, atol=1e-6)


@pytest.mark.parametrize("where", ["SB1", "TA1"])
@pytest.mark.parametrize("level_db", [-17.0, 5.0])
def test_the_background_level_scales_the_background(where: str, level_db: float) -> None:
    """Electronic noise does not follow the level of the street."""
    silent = replace(preset(), self_noise_db=0.0, ambient_waves=8)
    traffic = Traffic("test", {}, background_db=(level_db, level_db))
    usual = StreamSettings(junction_named(where), 0.2, 5, replace(traffic, background_db=(0.0, 0.0)), silent)
    heard = [
        sound_of(draw_stream(replace(one, sample_rate_hz=3000.0), PAIR).scene, ())
        for one in (usual, replace(usual, traffic=traffic))
    ]
    factor = 10.0 ** (level_db / 20.0)
    np.testing.assert_allclose(heard[1], factor * heard[0], rtol=2e-3, atol=1e-4 * np.abs(heard[1]).max())


def test_rain_of_a_stream_is_continuous_and_incoherent() -> None:
    dry = StreamSettings(site("SB1"), 1.2, 4, Traffic("test", {}), STILL, 3000.0)
    showers = [replace(dry, seed=seed, traffic=Traffic("test", {}, rain_share=1.0)) for seed in (1, 7)]
    rain_db, rain = [one.rain_db for one in showers], []
    assert None not in rain_db
    for one in showers:
        wet, alone = (draw_stream(stream, PAIR).scene for stream in (one, replace(dry, seed=one.seed)))
        rain.append(sound_of(wet, ()) - sound_of(alone, ()))
    # Pieces of 30 s join at 30 and 60 s. Two seconds of two channels have 160 drops of exponential strength.
    seconds_db = 10.0 * np.log10(np.square(rain[0]).reshape(2, -1, 6000).mean(axis=(0, 2)))
    assert np.abs(seconds_db - np.median(seconds_db)).max() < 4.0
    frequencies, between = coherence(*rain[0], 3000.0, nperseg=256)
    assert between[frequencies > 500.0].mean() < 0.1
    found_db = 10.0 * np.log10([np.square(one).mean() for one in rain])
    assert np.diff(rain_db)[0] > 10.0
    np.testing.assert_allclose(np.diff(found_db), np.diff(rain_db), atol=1.0)


def test_events_rise_to_line_of_sight_from_silence_to_silence() -> None:
    scene, event = scene_of(0.5, rate_hz=3000.0), event_at(2.0, reach_m=42.0)
    alone, rows = alone_in(scene, event), row_times(event, scene.settings)
    levels, t0_s = loudness_db(alone, rows, 3000.0), visible_s(event, site("SB1"))
    assert t0_s is not None
    seconds = [levels[(rows > t0_s - i - 1) & (rows <= t0_s - i)].mean() for i in range(5)]
    assert all(later > earlier for later, earlier in pairwise(seconds))
    assert seconds[0] > seconds[4] + 6.0
    assert levels.argmax() == pytest.approx(np.searchsorted(rows, t0_s) + 4, abs=8)
    edge = np.abs(alone.pressure_pa[:, [0, -1]]).max()
    assert edge < 1e-4 * np.abs(alone.pressure_pa).max()
    # Independent oracle: the level of the samples of one microphone about one row.
    at = round((rows[50] - 2.0) * 3000)
    around = alone.pressure_pa[:, at - 150 : at + 150].astype(float)
    assert levels[50] == pytest.approx(10 * np.log10((around**2).mean() / 4e-10), abs=0.02)


def test_a_signal_is_added_to_the_unchanged_vehicle() -> None:
    scene, event = scene_of(0.5, rate_hz=3000.0), event_at(2.0, reach_m=20.0)
    plain, warning = (alone_in(scene, one).pressure_pa for one in (event, replace(event, signal="siren")))
    frequency, power = welch((warning - plain)[0], 3000.0, nperseg=1024)
    # The vehicle approaches in the hidden arm, so both tones are up to 3 % higher.
    tones = [(frequency > tone) & (frequency < 1.04 * tone) for tone in (400.0, 535.0)]
    assert sum(power[tone].sum() for tone in tones) > 0.5 * power[frequency < 700.0].sum()
    assert (warning - plain).std() > 3 * plain.std()


def test_pieces_of_background_join_without_a_seam() -> None:
    scene = scene_of(2.0, rate_hz=2000.0)
    sound = sound_of(scene, ())
    edges, overlap = [scene.piece * i for i in range(1, 4)], round(OVERLAP_S * 2000)
    seam = np.zeros(sound.shape[1], bool)
    for edge in edges:
        seam[edge : edge + overlap] = True
    spectra = [
        np.mean([welch(channel[part], 2000.0, nperseg=256)[1] for channel in sound], axis=0)
        for part in (seam, ~seam)
    ]
    ratio_db = 10.0 * np.log10(spectra[0] / spectra[1])[8:]  # from 60 Hz
    assert abs(ratio_db.mean()) < 0.3
    assert np.abs(ratio_db).max() < 2.0
    # A click is a sample that its neighbours do not predict.
    jump = np.abs(np.diff(sound, n=3)).max(axis=0)
    near = max(jump[edge - 20 : edge + overlap + 20].max() for edge in edges)
    assert near < 1.2 * jump.max() and near < 8.0 * jump.std() + jump.mean()


@pytest.mark.parametrize("place", ["SB1", "TA101", "DB102"])
@given(seed=st.integers(0, 10_000), microphones=st.lists(st.integers(1, 5), min_size=2, max_size=2))
@settings(max_examples=2, deadline=None)
def test_an_array_is_independent_of_other_arrays(place: str, seed: int, microphones: list[int]) -> None:
    """Wind, drops and gusts of each array are those it has alone."""
    traffic = Traffic("all", {"left": 1200, "joins": 600}, sounds={"gusts": 1200, "rain": 600, "voice": 600})
    moment = StreamSettings(drawn_site(place), 0.08, seed, traffic, sample_rate_hz=2000.0)
    draw = np.random.default_rng(seed)
    arrays = [MicrophoneArray(draw.uniform(-0.3, 0.3, (number + 1, 3))) for number in microphones]
    beside = draw_stream(moment, *arrays)
    blocks = list(beside.blocks())
    together = np.concatenate([beside.recorded(block) for block in blocks])
    for number, (array, channels) in enumerate(zip(arrays, beside.scene.microphones.slices, strict=True)):
        alone = draw_stream(moment, array)
        heard = list(alone.blocks())
        expected = np.concatenate([alone.recorded(block) for block in heard])
        assert expected.std() > 0.0
        np.testing.assert_allclose(together[:, channels], expected, atol=1e-5 * np.abs(expected).max())
        for mine, every in zip(heard, blocks, strict=True):
            for event, levels in mine.loudness_db.items():
                np.testing.assert_allclose(every.loudness_db[event][number], levels[0], atol=1e-3)


def test_memory_does_not_grow_with_the_length_of_a_stream() -> None:
    def peak(minutes: float) -> int:
        tracemalloc.start()
        for block in render_blocks(scene_of(minutes, rate_hz=2000.0), ()):
            del block
        reached = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return reached

    assert peak(3.0) < 1.05 * peak(1.5)


def test_a_stream_on_disk_reads_as_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    positions = tmp_path / "pair.json"
    positions.write_text(json.dumps(PAIR.positions_m.tolist()))
    words = "--minutes 0.25 --site SB1 --seed 33 --traffic busy --bandwidth 700 --array"
    told = made(capsys, tmp_path, f"{words} {positions}")
    folder = tmp_path / "SB1-busy-33"
    assert told["out"] == str(folder) and (folder / "stream.png").stat().st_size > 20_000
    recording = Recording.open(folder)
    with recording.open_audio() as audio:
        assert (audio.channels, audio.sample_rate_hz) == (2, round(told["sample_rate_hz"]))
        assert audio.duration_s == pytest.approx(15.0, abs=0.01)
    log = recording.read_detections()
    assert log is not None and len(log.frames) == 150
    np.testing.assert_allclose(choose_array(folder).positions_m, PAIR.positions_m, atol=1e-6)
    events = json.loads((folder / "events.json").read_text())["vehicles"]
    tracks = read_true_tracks(folder)
    with (folder / "vehicles.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(events) == told["vehicles"] == len(tracks) > 0
    for event, track in zip(events, tracks, strict=True):
        own = [row for row in rows if int(row["vehicle"]) == event["vehicle"]]
        np.testing.assert_allclose([float(row["time_s"]) for row in own], track.time_s)
        np.testing.assert_array_equal([row["in_view"] == "1" for row in own], track.in_view)
        assert all((row["time_to_visible_s"] == "") == (event["t0_s"] is None) for row in own)


def test_the_stream_command_offers_all_traffic_and_reports_bad_options(tmp_path, capsys):
    refused = {
        "--minutes 1 --site DA1": "drives are heard",
        "--minutes 1 --static 2": "--static",
        "--static 2 --bandwidth 3": "bandwidth_hz",
        "--minutes 1 --bandwidth 3": "--bandwidth",
    }
    for words, problem in refused.items():
        assert problem in refusal(capsys, tmp_path, words)
    (tmp_path / "SB1-empty-1").mkdir()
    assert "something else" in refusal(capsys, tmp_path, "--minutes 1 --site SB1 --traffic empty")
