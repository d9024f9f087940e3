"""Recordings and data sets: continuity, layout and determinism; models at a lower rate."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated_sound import PAIR, made, refusal

from worldstate.adapters.camera.detections import read_detections
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.datasets.feature_table import read_features
from worldstate.adapters.datasets.ovad import OvadDataset
from worldstate.adapters.files.acoustic_domain import check_tables, feature_order
from worldstate.adapters.files.model_file import read_model
from worldstate.adapters.listener import measure_steps
from worldstate.adapters.source import ListenSettings, open_source
from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.frontend.direction.feature import feature_nfft
from worldstate.frontend.settings import FrontEndSettings
from worldstate.ground.errors import InputFileError, OutOfDomainError
from worldstate.simulation import (
    DatasetSettings,
    preset,
    simulate_recording,
    site,
    write_dataset,
    write_recording,
)
from worldstate.simulation.scene.junction import SITES
from worldstate.simulation.scene.octave_bands import REFERENCE_PA
from worldstate.simulation.scene.settings import SAMPLE_RATE_HZ, SimulationSettings, draw_settings, rate_for
from worldstate.simulation.scene.vehicle import LIGHT, drive, emit
from worldstate.simulation.sound.background import far_passages_s
from worldstate.simulation.sound.paths import trace_paths


@pytest.mark.long
@pytest.mark.parametrize("name", SITES)
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_energy_is_continuous_across_line_of_sight_entry(name, side):
    """The sum of path energies up to 2 kHz has no step between adjacent millimetres."""
    plan = site(name)
    y = side * np.arange(12.0, -12.0, -0.001)
    for lane in plan.lanes_m:
        energy = np.zeros((len(y), 6))
        for path in trace_paths(plan, lane, y, 1.4, 24.0):
            straight = np.hypot(np.hypot(path.source.x_m, y - path.receiver.offset_m), 1.4)
            length = path.lit * straight + (1.0 - path.lit) * path.bent_m
            energy += (path.gain[:, :6] / length[:, None]) ** 2
        level_db = 10 * np.log10(energy)
        assert np.abs(np.diff(level_db, axis=0)).max() < 0.1
        seen = np.abs(y) < 1.0
        hidden = np.abs(y) > 10.0
        assert level_db[seen].mean() > level_db[hidden].mean() + 5.0  # hard walls opposite each other


@given(st.floats(0.0, 8.0), st.floats(1.0, 30.0), st.sampled_from([-5.0, 5.0]))
def test_a_drive_enters_sight_at_the_given_time_and_never_turns(braking, speed, entry_y):
    time = np.linspace(-2.0, 10.0, 4501)
    path = drive(time, entry_s=7.0, entry_y_m=entry_y, lane_x_m=6.0, speed_mps=speed, braking_mps2=braking)
    assert np.interp(7.0, time, path.front_y_m) == pytest.approx(entry_y, abs=1e-9)
    assert np.all(np.diff(path.front_y_m) * path.heading > 0.0)
    assert path.heading == -np.sign(entry_y)


@pytest.mark.parametrize("entry_s", [-6.0, 14.0])
def test_passes_outside_the_recording_follow_the_drive(entry_s):
    time = np.linspace(-2.0, 10.0, 1201)
    path = drive(time, entry_s=entry_s, entry_y_m=5.0, lane_x_m=6.0, speed_mps=8.0, braking_mps2=1.0)
    # It brakes from 8 to 6 m/s in the two seconds before: 14 m.
    left_s = entry_s - time
    away = np.where(left_s < 0.0, 6.0 * left_s, 14.0 + 8.0 * (left_s - 2.0))
    assert path.front_y_m == pytest.approx(5.0 + away, abs=1e-3)


def quickly(scene: SimulationSettings) -> SimulationSettings:
    """Omit mirror images, which do not affect the camera."""
    return replace(scene, sample_rate_hz=8_000.0, site=replace(scene.site, side_order=0, facade_order=0))


@pytest.mark.long
@settings(max_examples=6, deadline=None)
@given(st.sampled_from(SITES), st.sampled_from(["left", "right"]), st.integers(0, 1000))
def test_detections_begin_at_line_of_sight_and_truth_agrees(name, approach, seed):
    rng = np.random.default_rng(seed)
    scene = quickly(replace(draw_settings(name, approach, rng, 5.0), parked_car=False))
    recording = simulate_recording(scene, rng, PAIR)
    t0, frames = recording.t0_frame, recording.truth["frames"]
    assert all(not seen for seen in recording.detections[:t0])
    assert any(recording.detections[t0 : t0 + 10])
    assert abs(t0 / 10 - scene.entry_s) <= 0.1
    assert not frames[t0 - 1]["line_of_sight"]
    assert frames[t0]["line_of_sight"]
    assert frames[0]["azimuth_rad"] * (1 if approach == "left" else -1) > 0.3


def test_boxes_agree_with_the_camera_adapter():
    scene = quickly(draw_settings("SB1", "left", np.random.default_rng(4), 10.0))
    scene = replace(scene, parked_car=False, braking_mps2=0.0, speed_mps=6.0)
    recording = simulate_recording(scene, np.random.default_rng(4), PAIR)
    camera, compared = PinholeCamera.ovad(), 0
    for frame, seen in zip(recording.truth["frames"], recording.detections, strict=True):
        x, front = frame["position_m"]
        if seen and abs(front) < 2.5 and abs(front + 4.3) < 2.5:
            left, _, right, _ = seen[0].box_px
            middle = np.arctan2(front + 4.3 / 2, x)
            assert float(camera.azimuth(0.5 * (left + right))) == pytest.approx(middle, abs=0.06)
            compared += 1
    assert compared


@pytest.mark.long
def test_a_data_set_has_its_layout_for_any_number_of_jobs(tmp_path):
    """Two of a standing ego, one of a moving one; OVAD has no camera results of the latter."""
    wanted = DatasetSettings(n_static=2, n_dynamic=1, seed=5, duration_s=0.5, kind="bicycle")
    rows = write_dataset(tmp_path / "one", wanted, array=PAIR)
    seen = []
    write_dataset(tmp_path / "two", wanted, array=PAIR, jobs=2, progress=seen.append)
    assert seen == rows
    shutil.rmtree(tmp_path / "two" / rows[-1].folder)  # as if interrupted
    seen.clear()
    again = write_dataset(tmp_path / "two", wanted, array=PAIR, go_on=True, progress=seen.append)
    assert (again, seen) == (rows[-1:], rows), "a share of all needs those that were there"
    write_dataset(tmp_path / "three", replace(wanted, seed=6), array=PAIR)
    assert write_dataset(tmp_path / "three", wanted, array=PAIR, go_on=True) == rows  # of another seed
    files = sorted(p.relative_to(tmp_path / "one") for p in (tmp_path / "one").rglob("*") if p.is_file())
    assert len(files) == 2 * 3 + 2 + 2  # and the log and the array
    for name in files:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()

    with (tmp_path / "one" / "DataLog.csv").open() as log:
        table = list(csv.DictReader(log))
    assert [list(row) for row in table] == [["ID", "Environment", "Class", "T0"]] * 3
    assert [(row["ID"], row["Environment"], row["Class"]) for row in table] == [
        ("1_00_0000", "SA1", "left"), ("2_00_0001", "SA1", "none"), ("1_05_0002", "DA1", "left"),
    ]  # fmt: skip
    folder = tmp_path / "one" / "SA1" / "left" / "1_00_0000"
    about = soundfile.info(folder / "out_multi.wav")
    assert (about.channels, about.samplerate, about.subtype) == (2, 47_998, "PCM_24")
    assert about.frames == round(0.5 * 47_998)
    assert len(read_detections(folder / "camera_baseline_results.json")) == 5
    truth = json.loads((folder / "truth.json").read_text())
    assert (truth["settings"]["approach"], truth["settings"]["kind"]) == ("left", "bicycle")
    assert len(truth["frames"]) == 5
    found = OvadDataset(tmp_path / "one").recordings
    assert [recording.moving_ego for recording in found] == [False, False, True]


def test_a_folder_of_other_files_is_not_replaced(tmp_path, monkeypatch):
    scene = SimulationSettings(site("SA1"), "none", duration_s=0.5, sample_rate_hz=8_000.0)
    recording = simulate_recording(scene, np.random.default_rng(1), PAIR)
    foreign = tmp_path / "SA1" / "none" / "2_00_0003"
    foreign.mkdir(parents=True)
    (foreign / "notes.txt").write_text("mine")
    with pytest.raises(InputFileError, match="2_00_0003"):
        write_recording(tmp_path, recording, 3)
    assert (foreign / "notes.txt").read_text() == "mine"
    row = write_recording(tmp_path, recording, 4)
    monkeypatch.setattr("worldstate.simulation.dataset.recording.WAV_LIMIT_BYTES", 3 * 2 * 4000 - 1)
    assert write_recording(tmp_path, recording, 4) == row  # its own kind
    assert soundfile.info(tmp_path / row.folder / "out_multi.wav").format == "RF64"


def test_the_sim_command_writes_and_reports(tmp_path, capsys):
    words = "--static 1 --duration 0.5 --scene merge --kind electric --preset street-7 --bandwidth 2000"
    summary = made(capsys, tmp_path / "d", words)
    assert (summary["approaches"], summary["folders"]) == (1, ["SM1/left/1_12_0000"])
    told = json.loads((tmp_path / "d" / summary["folders"][0] / "truth.json").read_text())["settings"]
    named = told["kind"], told["site"]["name"], told["preset"]["name"], told["sample_rate_hz"]
    assert named == ("electric", "SM1", "street-7", 6000.0)
    assert "n_static" in refusal(capsys, tmp_path / "e", "--static 0")


@pytest.mark.parametrize("duration_s", [2.0, 30.0])
def test_the_rate_of_distant_vehicles_does_not_depend_on_the_duration(duration_s):
    rng = np.random.default_rng(3)
    busy = replace(preset(), far_rate=1.2)
    found = np.concatenate([far_passages_s(busy, duration_s, rng) for _ in range(2000)])
    inside = ((found >= 0.0) & (found < duration_s)).sum() / 2000.0
    outside = (found < 0.0).sum() / 2000.0
    assert inside == pytest.approx(0.12 * duration_s, rel=0.1)
    assert outside == pytest.approx(0.12 * 8.0, rel=0.1)  # they are audible before and after their maximum


def test_engine_lines_above_half_the_rate_do_not_alias() -> None:
    # Lines from 1.4 to 2.8 kHz only: at 3 kHz those above 1.5 kHz would alias below 1.2 kHz.
    two_kilohertz = tuple(90.0 if octave == 5 else 0.0 for octave in range(8))
    kind = replace(LIGHT, harmonic_share=1.0, propulsion_a_db=two_kilohertz, propulsion_b_db=(0.0,) * 8)
    time = np.arange(0.0, 2.0, 0.05)
    path = drive(time, entry_s=4.0, entry_y_m=3.0, lane_x_m=8.0, speed_mps=5.5, kind=kind)
    for seed in range(4):
        engine = emit(path, 5700, 3_000.0, 0.0, np.random.default_rng(seed))[-1].signal
        spectrum = np.abs(np.fft.rfft(engine * np.hanning(5700))) ** 2
        below = spectrum[: round(1200.0 / 3_000.0 * 5700)].sum() / 5700**2
        assert below < 1e-4 * REFERENCE_PA**2 * 10.0**9


def test_the_shipped_model_reads_recordings_up_to_2_khz(tmp_path: Path) -> None:
    words = "sim make --static 2 --bandwidth 2000 --duration 1.6 --seed 3"
    assert main([*words.split(), "--out", str(tmp_path)]) == 0
    (folder,) = (tmp_path / "SA1" / "left").iterdir()
    source = open_source(folder)
    steps = list(measure_steps(source))
    assert (soundfile.info(source.audio_path).samplerate, len(steps)) == (6000, 7)
    assert main(["model", "features", str(tmp_path), "--out", str(tmp_path / "table.csv")]) == 0
    # A model of such windows also reads full-rate sound, because only the duration of frames matters.
    domain = read_features(tmp_path / "table.csv").domain
    shipped = read_model().signature.domain
    assert domain is not None and shipped is not None
    check_tables(shipped, domain)
    assert feature_order(domain, ovad_array(), SAMPLE_RATE_HZ, FrontEndSettings()) is None


def test_sound_without_the_bands_of_the_model_raises_an_error() -> None:
    shipped, array = read_model().signature.domain, ovad_array()
    assert shipped is not None
    for rate in (6_000, 8_000, 12_000, 16_000, 24_000):
        assert feature_order(shipped, array, rate, ListenSettings().front_end(array, rate)) is None
    for rate in (3_000, 5_800):
        with pytest.raises(OutOfDomainError, match=f"sample rate: .*got {rate} Hz: record at 8 kHz or more"):
            feature_order(shipped, array, rate, ListenSettings().front_end(array, rate))


@given(st.floats(700.0, 32_000.0))
def test_the_rate_covers_the_band_and_keeps_the_bins(bandwidth_hz: float) -> None:
    rate = rate_for(bandwidth_hz)
    assert rate == SAMPLE_RATE_HZ or 2.99 * bandwidth_hz <= rate <= 6.01 * bandwidth_hz
    if rate > 5_000.0:
        assert rate / feature_nfft(rate) == pytest.approx(SAMPLE_RATE_HZ / 512, rel=1e-4)
