"""Recordings and data sets: truth and sight at every place, arrays, layout, determinism, lower rates."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Outline
from simulated_sound import PAIR, QUIET, apart_deg, made, refusal, srp_spectrum

from worldstate.adapters.camera.detections import read_detections
from worldstate.adapters.datasets.feature_table import read_features
from worldstate.adapters.datasets.ovad import OvadDataset
from worldstate.adapters.files.acoustic_domain import check_tables, feature_order
from worldstate.adapters.files.model_file import read_model
from worldstate.adapters.listener import measure_steps
from worldstate.adapters.source import ListenSettings, open_source
from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.frontend.direction.feature import feature_nfft
from worldstate.frontend.settings import FrontEndSettings
from worldstate.ground.errors import InputFileError, OutOfDomainError
from worldstate.simulation import (
    PLACES,
    DatasetSettings,
    VehicleSettings,
    place,
    preset,
    simulate_recording,
    site,
    write_dataset,
    write_recording,
)
from worldstate.simulation.camera.simulated_detector import line_of_sight
from worldstate.simulation.dataset.recording import describe
from worldstate.simulation.scene.driving import CAMERA, trajectories
from worldstate.simulation.scene.junction import SITES, place_of
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
        level_db, seen, hidden = 10 * np.log10(energy), np.abs(y) < 1.0, np.abs(y) > 10.0
        assert np.abs(np.diff(level_db, axis=0)).max() < 0.1
        assert level_db[seen].mean() > level_db[hidden].mean() + 5.0  # hard walls opposite each other


@given(st.floats(0.0, 8.0), st.floats(1.0, 30.0), st.sampled_from([-5.0, 5.0]), st.floats(-6.0, 14.0))
def test_a_drive_enters_sight_at_the_given_time_and_never_turns(braking, speed, entry_y, entry_s):
    """It brakes in the two seconds before, also if these are outside the recording."""
    time = np.linspace(-2.0, 10.0, 4501)
    path = drive(
        time, entry_s=entry_s, entry_y_m=entry_y, lane_x_m=6.0, speed_mps=speed, braking_mps2=braking
    )
    away, left_s, slowed = (path.front_y_m - entry_y) * -path.heading, entry_s - time, speed - 2.0 * braking
    assert np.interp(0.0, left_s[::-1], away[::-1], left=0.0, right=0.0) == pytest.approx(0.0, abs=1e-9)
    assert np.all(np.diff(away) < 0.0) and path.heading == -np.sign(entry_y)
    if slowed >= 0.25 * speed:
        last_m = slowed * left_s + 0.5 * braking * np.clip(left_s, 0.0, 2.0) ** 2
        before_m = 2.0 * slowed + 2.0 * braking + speed * (left_s - 2.0)
        np.testing.assert_allclose(away, np.where(left_s < 2.0, last_m, before_m), atol=1e-3)


@pytest.mark.long
@settings(max_examples=6, deadline=None)
@given(st.sampled_from(SITES), st.sampled_from(["left", "right"]), st.integers(0, 1000))
def test_detections_begin_at_line_of_sight_and_truth_agrees(name, approach, seed):
    rng = np.random.default_rng(seed)
    drawn = draw_settings(name, approach, rng, 5.0)
    # Mirror images do not affect the camera.
    bare = replace(drawn.site, side_order=0, facade_order=0)
    scene = replace(drawn, parked_car=False, sample_rate_hz=8_000.0, site=bare)
    recording = simulate_recording(scene, rng, PAIR)
    t0, frames = recording.t0_frame, recording.truth["frames"]
    assert all(not seen for seen in recording.detections[:t0])
    assert any(recording.detections[t0 : t0 + 10])
    assert abs(t0 / 10 - scene.entry_s) <= 0.1
    assert not frames[t0 - 1]["line_of_sight"]
    assert frames[t0]["line_of_sight"]
    assert frames[0]["azimuth_rad"] * (1 if approach == "left" else -1) > 0.3


@pytest.mark.long
def test_a_data_set_has_its_layout_for_any_number_of_jobs(tmp_path):
    """The ego stands in two recordings and moves in one, for which OVAD has no camera results."""
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
    # All lines are from 1.4 to 2.8 kHz: at a rate of 3 kHz those above 1.5 kHz would alias below 1.2 kHz.
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


TIME_S = np.arange(-2.0, 12.0, 0.05)
FRAMES_S = np.arange(0.0, 10.0, 0.1)


def pictured(x: float, y: float) -> bool:
    """Whether a point at the height of the camera is in its image."""
    depth = (x - CAMERA.position_m[0]) * np.cos(CAMERA.pitch_rad)
    focal = 0.5 * CAMERA.width_px / np.tan(CAMERA.half_angle_rad)
    return bool(depth > 0.0 and abs(focal * (y - CAMERA.position_m[1]) / depth) < 0.5 * CAMERA.width_px)


def seen_step_by_step(plan, x: float, y: float) -> bool:
    """Whether small steps from the camera to a point meet no body and no building beside the mouth."""
    share = np.linspace(0.0, 1.0, 1500)
    line = np.outer(1.0 - share, CAMERA.position_m[:2]) + np.outer(share, (x, y))
    for body in plan.occluders:
        outline = np.array(body.corners_m)
        if len(outline) == 2:  # a screen along x
            (low, wall), (high, _) = outline
            crossed = (np.diff(np.sign(line[:, 1] - wall)) != 0) & (line[1:, 0] > low) & (line[1:, 0] < high)
            if crossed.any():
                return False
        elif Outline(outline).contains_points(line).any():
            return False
    if not plan.is_open:
        first = np.argmax(line[:, 0] > plan.corner_ahead_m)
        if (
            line[first, 0] > plan.corner_ahead_m
            and not -plan.corner_right_m < line[first, 1] < plan.corner_left_m
        ):
            return False
    return pictured(x, y)


def told(scene: SimulationSettings) -> dict:
    """Return the truth of a recording without its sound."""
    seen = [path.at(FRAMES_S) for path in trajectories(scene, TIME_S)]
    sights = [line_of_sight(path, scene.site) for path in seen]
    return json.loads(json.dumps(describe(scene, FRAMES_S, seen, sights), allow_nan=False))


def check_sight(plan, frames: list[dict]) -> int:
    """Compare the frames that are over 10 cm from the edge of a shadow; return how many are in view."""
    in_view = 0
    for frame in frames[::4]:
        x, y = frame["position_m"]
        near = {seen_step_by_step(plan, x + dx, y + dy) for dx in (-0.1, 0.1) for dy in (-0.1, 0.1)}
        if len(near) == 1:
            assert near == {frame["line_of_sight"]}, (x, y)
            in_view += frame["line_of_sight"]
    return in_view


@pytest.mark.parametrize("name", PLACES)
@settings(max_examples=2, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_truth_has_sight_and_time_to_visible(name, seed):
    there, rng = place(name), np.random.default_rng(seed)
    for approach in there.approaches:
        scene = draw_settings(there.site.name, approach, rng)
        frames = told(scene)["frames"]
        assert check_sight(there.site, frames)
        first = [frame["line_of_sight"] for frame in frames].index(True)
        assert abs(frames[first]["time_s"] - scene.entry_s) <= 0.2
        left_s = scene.entry_s - frames[first]["time_s"]
        assert frames[first]["time_to_visible_s"] == pytest.approx(left_s, abs=1e-5)
        assert frames[first]["position_m"][1] * (1.0 if approach == "left" else -1.0) > 0.0
    for way in (way for way in there.ways if way.approach == "none"):
        plain = VehicleSettings("left", rng.uniform(5.0, 7.0), rng.uniform(5.0, 12.0), route_m=way.route_m)
        truth = told(SimulationSettings(there.site, "none", others=(plain,)))
        (frames,) = truth["others"]
        assert (truth["frames"], truth["entry_s"]) == ([], None)
        if check_sight(there.site, frames):
            assert frames[0]["line_of_sight"]
            assert [f["time_to_visible_s"] for f in frames] == pytest.approx([-f["time_s"] for f in frames])
        else:
            assert {frame["time_to_visible_s"] for frame in frames} == {None}


@settings(max_examples=12, deadline=None)
@given(
    st.sampled_from([*SITES, *(place(name).site.name for name in PLACES)]),
    st.lists(st.tuples(st.floats(-40.0, 40.0), st.floats(-40.0, 40.0)), min_size=2, max_size=4),
)
def test_sight_is_a_free_line_within_the_image(name, points):
    there = place_of(name)
    plan = site(name) if there is None else there.site
    assume(np.hypot(*np.diff(np.array(points), axis=0).T).min() >= 1.0)
    frames = told(SimulationSettings(plan, "left", route_m=tuple(points)))["frames"]
    street = plan.corner_ahead_m
    inside = [
        frame
        for frame in frames
        if plan.is_open or frame["position_m"][0] > street + 0.2 or abs(frame["position_m"][1]) < 2.0
    ]
    check_sight(plan, inside)


def test_a_data_set_of_all_places_has_every_approach_of_each():
    plans = DatasetSettings(n_static=4 * (len(SITES) + len(PLACES)), scene="all").plans()
    found = {(plan.environment, plan.approach) for plan in plans}
    wanted = {(name, side) for name in SITES for side in ("left", "none", "right")}
    wanted |= {(place(n).site.name, side) for n in PLACES for side in (*place(n).approaches, "none")}
    assert found == wanted


def test_half_of_the_hazard_free_recordings_have_a_vehicle():
    rng = np.random.default_rng(3)
    with_one = [len(draw_settings("SO1", "none", rng).traffic) for _ in range(200)]
    assert 70 <= sum(with_one) <= 130
    assert {len(draw_settings("SO1", side, rng).traffic) for side in ("left", "right")} == {1}


@pytest.mark.parametrize(("name", "has_late_sound"), [("open-road", False), ("wide-crossing", True)])
def test_late_sound_needs_walls(name, has_late_sound):
    scene = SimulationSettings(place(name).site, "left", 0.5, entry_s=0.4, sample_rate_hz=8e3, preset=QUIET)
    loud, none = (
        simulate_recording(
            replace(scene, preset=replace(QUIET, late_open_db=level)), np.random.default_rng(1), PAIR
        ).audio
        for level in (0.0, -90.0)
    )
    assert (loud.std() > 1.5 * none.std()) == has_late_sound
    assert np.array_equal(loud, none) != has_late_sound


FS = 12_000.0
GRID = np.stack(np.meshgrid(*[np.arange(4.0)] * 2), axis=-1).reshape(-1, 2)
ZERO = np.zeros((16, 1))
CUBE = np.stack(np.meshgrid(*[np.arange(2.0)] * 3), axis=-1).reshape(-1, 3)
# In metres; the cube is on a mast.
ARRAYS = {
    "pair": [[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]],
    "line across": np.outer(np.arange(5.0), [0.0, 0.09, 0.0]),
    "line along": np.outer(np.arange(8.0), [0.08, 0.0, 0.0]),
    "upright": 0.1 * np.concatenate([ZERO, GRID], axis=1),
    "lying": 0.1 * np.concatenate([GRID, ZERO], axis=1),
    "cube": 0.2 * CUBE + [0.0, 0.0, 3.0],
    "ball": np.random.default_rng(4).uniform(-0.4, 0.4, (64, 3)),
}
FRONT_AS_BACK, LEFT_AS_RIGHT = ("pair", "line across", "upright"), ("line along",)
AZIMUTHS_DEG = np.arange(-180.0, 180.0, 2.0)


@pytest.mark.parametrize("name", sorted(ARRAYS))
@pytest.mark.parametrize("azimuth_deg", [30.0, -124.0])
def test_bearings_are_right_up_to_the_symmetry_of_the_array(name, azimuth_deg):
    """A slow car 15 m away; the axles are behind the front, so both have the same azimuth."""
    array, radians = MicrophoneArray(ARRAYS[name]), np.radians(azimuth_deg)
    way = tuple((away_m * np.cos(radians), away_m * np.sin(radians)) for away_m in (30.0, 15.0))
    drawn = SimulationSettings(place("open-road").site, "left", 0.5, 0.3, 1.0, sample_rate_hz=FS, route_m=way)
    scene = replace(drawn, preset=replace(QUIET, ambient_waves=8, vehicle_spread_db=0.0))
    sound = simulate_recording(scene, np.random.default_rng(1), array).audio
    assert sound.shape == (6000, array.n_microphones)
    power = srp_spectrum(sound.T, array, FS, AZIMUTHS_DEG, (375.0, 1500.0))
    mirrored = 180.0 - azimuth_deg if name in FRONT_AS_BACK else -azimuth_deg
    here, there = (power[apart_deg(AZIMUTHS_DEG, at).argmin()] for at in (azimuth_deg, mirrored))
    found = AZIMUTHS_DEG[power.argmax()]
    if name in (*FRONT_AS_BACK, *LEFT_AS_RIGHT):
        assert min(apart_deg(found, azimuth_deg), apart_deg(found, mirrored)) <= 6.0
        assert there == pytest.approx(here, rel=0.02)
    else:
        assert apart_deg(found, azimuth_deg) <= 4.0
        assert there < 0.9 * here
