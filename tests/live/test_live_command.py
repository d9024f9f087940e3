"""`worldstate live` on a played recording, and its logs: their names, and readability after any end."""

import io
import json
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import soundfile
from camera_boxes import LENS
from rich.console import Console
from scripted_states import scripted_states
from stand_ins import free_port, played, sending, wall

from worldstate.adapters.audio.sound_file import open_sound
from worldstate.adapters.export.log_messages import mcap_file, state_messages
from worldstate.adapters.export.other_stacks import osi_trace
from worldstate.adapters.files.checkpoint_file import read_checkpoint
from worldstate.adapters.files.file_io import GrowingFile, line_writer
from worldstate.adapters.live.live_listening import live_steps
from worldstate.adapters.live.live_sound import LiveSound, Playback, kept_sound
from worldstate.adapters.source import ListenSettings, open_source
from worldstate.adapters.state_log import read_log
from worldstate.cli import live
from worldstate.cli.common.live_view import view_of
from worldstate.cli.main import main
from worldstate.ground.errors import InputFileError
from worldstate.state import WorldState

COMMAND = sys.executable, "-m", "worldstate"
NO_BOXES = json.dumps({"boxes": [], "scores": [], "classes_str": [], "age_s": 0.02}).encode()


def snapshots(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def looked_at(path):
    return {view["sensor"] for snapshot in snapshots(path) for view in snapshot["searched"]}


def report_of(words, capsys):
    assert main([*words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_live_has_the_states_of_run_and_keeps_sound_on_request_only(street, tmp_path, capsys, refused):
    out, run, kept = tmp_path / "live" / "states.jsonl", tmp_path / "run.jsonl", tmp_path / "kept.wav"
    out.parent.mkdir()
    report = report_of(played(street, "--speed", 4, "--out", out), capsys)
    assert main(["run", *played(street)[2:], "--out", str(run)]) == 0
    assert out.read_text() == run.read_text()
    assert [path.name for path in out.parent.iterdir()] == ["states.jsonl"]
    assert report["states"] == 11
    assert report["calibration"] == "uncalibrated"
    assert report["overruns"] == report["lost_s"] == 0
    assert 0.0 < report["latency_median_s"] <= report["latency_p99_s"] <= report["latency_largest_s"]
    assert report["cpu_s"] > 0.0
    assert main(played(street, "--speed", 20, "--keep-sound", kept)) == 0
    heard, rate_hz = soundfile.read(kept)
    assert rate_hz == 8000
    np.testing.assert_array_equal(heard, soundfile.read(street / "street.wav")[0])
    assert "this one is an input" in refused(played(street, "--keep-sound", street / "street.wav"))


def test_losses_are_reported_when_they_happen(street, capsys, monkeypatch):
    slow = "worldstate.cli.common.live_view.view_of"
    monkeypatch.setattr(slow, lambda step: time.sleep(0.05) or view_of(step))
    assert main(played(street, "--speed", 100, "--duration", 8, "--view", "--json")) == 0
    said = capsys.readouterr()
    assert "overruns" in said.err and "s of sound lost" in said.err
    assert json.loads(said.out)["overruns"] > 0


def test_the_view_shows_bearing_risk_and_losses(street):
    sound = LiveSound(Playback(open_sound(street / "street.wav"), speed=20.0))
    source = open_source(sound, array=street / "mics.csv", settings=ListenSettings(uncalibrated=True))
    console = Console(record=True, width=100, file=io.StringIO())
    console.print(view_of(replace(list(live_steps(source))[-1], overruns=3, lost_s=0.076)))
    shown = console.export_text()
    assert "2.0 s   latency" in shown
    assert "3 overruns, 0.08 s lost" in shown
    assert [line.split()[0] for line in shown.splitlines() if "risk" in line] == ["left", "right"]
    assert "not usable: uncalibrated" in shown


@pytest.mark.long
def test_a_signal_ends_the_run_with_complete_files(street, tmp_path):
    out = tmp_path / "states.jsonl"
    script = played(street, "--duration", 60, "--out", out, "--json")
    with subprocess.Popen([*COMMAND, *script], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        until_s = time.monotonic() + 60.0
        while not any(one.stat().st_size for one in tmp_path.iterdir()) and time.monotonic() < until_s:
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        printed, _ = process.communicate(timeout=60.0)
    assert process.returncode == 0
    assert json.loads(printed)["states"] == len(out.read_text().splitlines()) > 0


def test_a_local_camera_is_queried(street, tmp_path, monkeypatch, capsys):
    wall(monkeypatch)
    states = tmp_path / "states.jsonl"
    words = played(street, "--camera-device", 0, "--camera", street / "lens.json", "--out", states)
    # Every image is processed before the next block of sound.
    assert report_of(words, capsys)["images_dropped"] < 15
    assert looked_at(states) == {"camera"}


def car_file(folder, street, **more):
    positions_m = np.loadtxt(street / "mics.csv", delimiter=",").tolist()
    (folder / "car.json").write_text(json.dumps({"array": {"positions_m": positions_m}, **more}))
    return ["--car", str(folder / "car.json"), "--uncalibrated"]


def test_several_cameras_are_queried(street, tmp_path, capsys, refused):
    yaws = {"front": 0.0, "aside": 60.0}
    cameras = [{"name": name, **LENS, "yaw_deg": yaw} for name, yaw in yaws.items()]
    states, ports = tmp_path / "states.jsonl", [free_port(), free_port()]
    told = [f"--detections={name}=127.0.0.1:{port}" for name, port in zip(yaws, ports, strict=True)]
    car = car_file(tmp_path, street, cameras=cameras)
    words = ["live", "--play", str(street / "street.wav"), *car, *told]
    outside = {"boxes": [[5000, 100, 5120, 300]], "scores": [0.9], "classes_str": ["car"]}
    with sending(ports[0], NO_BOXES), sending(ports[1], NO_BOXES, json.dumps(outside).encode()):
        report = report_of([*words, "--out", str(states)], capsys)
    assert report["detections_refused"] > 0
    assert "640 x 480 px" in report["last_refusal"]
    assert looked_at(states) == {"front", "aside"}
    assert "camera: expected one of front, aside" in refused([*words, "--detections", "back=127.0.0.1:0"])


@pytest.mark.parametrize("command", [["live", "--speed", "20", "--play"], ["run"]])
@pytest.mark.parametrize("moves", [False, True])
def test_odometry_selects_the_model_of_a_moving_ego(street, tmp_path, caplog, command, moves):
    (tmp_path / "odometry.csv").write_text("time_s,speed_mps\n0,4\n")
    car, states = car_file(tmp_path, street, **{"odometry": "odometry.csv"} if moves else {}), tmp_path / "s"
    assert main([*command, str(street / "street.wav"), *car, "--out", str(states)]) == 0
    assert ("model of a moving ego" in caplog.text) == moves
    assert snapshots(states)[-1]["context"]["ego_speed_mps"] == (4.0 if moves else None)


def test_datagrams_of_odometry_move_the_ego(street, tmp_path, capsys):
    states, port = tmp_path / "states.jsonl", free_port()
    driving = json.dumps({"speed_mps": 5.0, "yaw_rate_rad_s": 0.1, "age_s": 0.01}).encode()
    with sending(port, driving, b'{"speed_mps": 900}', b'{"speed_mps": 1, "x_m": 3}'):
        report = report_of(played(street, "--odometry", f"127.0.0.1:{port}", "--out", states), capsys)
    assert report["odometry_refused"] > 0
    assert "speed_mps" in report["last_odometry_refusal"] or "together" in report["last_odometry_refusal"]
    ego = snapshots(states)[-1]["ego"]
    assert ego["speed_mps"] == pytest.approx(5.0, abs=0.2)
    assert ego["position_m"][0] > 1.0


def test_live_resumes_from_a_checkpoint_as_run_does(street, tmp_path):
    """Both commands have the same options and states, and the clock continues."""
    saved = {}
    for name in ("live", "run"):
        state, half, rest = (tmp_path / f"{name}{end}" for end in (".json", "1.jsonl", "2.jsonl"))
        words = played(street, "--speed", 20) if name == "live" else ["run", *played(street)[2:]]
        assert main([*words, "--save-state", str(state), "--out", str(half)]) == 0
        start = [] if name == "live" else ["--start", "2"]
        assert main([*words, "--resume", str(state), *start, "--out", str(rest)]) == 0
        saved[name] = state.read_text(), half.read_text(), rest.read_text()
    assert saved["live"] == saved["run"]
    stamps = [one["stamp_ns"] for path in (half, rest) for one in snapshots(path)]
    # A window of the later sound is full after a second of it.
    assert stamps == [*range(10**9, 2 * 10**9 + 1, 10**8), *range(3 * 10**9, 4 * 10**9 + 1, 10**8)]


RATE = 8_000
NAMES = "states.jsonl", "states.mcap", "kept.wav", "belief.json"
MOVED = "expected the file of this run, but it was moved or removed"


def words(street, folder, *more):
    states, mcap, sound, belief = (folder / name for name in NAMES)
    out = "--out", states, "--export", f"mcap={mcap}", "--keep-sound", sound, "--save-state", belief
    return played(street, *out, *more)


def stamps_s(path):
    return [state.stamp_ns / 1e9 for _, state in read_log(path)]


# Most of the runs are slow; every fourth is killed after its belief was saved once or twice.
KILLED = [
    pytest.param(seed, (15, 60) if seed % 4 else (650, 1300), marks=[pytest.mark.slow] * (seed not in (1, 2)))
    for seed in range(20)
]


@pytest.mark.long
@pytest.mark.parametrize(("seed", "hops"), KILLED)
def test_a_killed_run_leaves_readable_files(street, tmp_path, seed, hops):
    """A run is killed up to 0.1 s after one of its states."""
    rng = random.Random(seed)
    after_states, wait_s = rng.randint(*hops), rng.uniform(0.0, 0.1)
    endless = words(street, tmp_path, "--duration", 86_400, "--speed", 3 if after_states < 100 else 30)
    states, mcap, sound, belief = (tmp_path / name for name in NAMES)
    with subprocess.Popen([*COMMAND, *endless], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        until_s = time.monotonic() + 120.0
        while time.monotonic() < until_s and process.poll() is None:
            if states.exists() and states.read_bytes().count(b"\n") >= after_states:
                break
            time.sleep(0.01)
        time.sleep(wait_s)
        process.kill()
        assert process.wait() == -signal.SIGKILL, process.stderr.read()
    written_s = json.loads(states.read_bytes().split(b"\n")[-2])["stamp_ns"] / 1e9
    assert stamps_s(states)[-1] == written_s
    assert stamps_s(mcap)[-1] > written_s - 1.0
    assert len(soundfile.read(sound)[0]) / RATE > written_s - 1.0
    for log in (states, mcap):
        assert main(["log", "replay", str(log), "--out", str(tmp_path / "again.jsonl")]) == 0
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]
    if written_s > 62.0:
        assert 0.0 <= written_s - read_checkpoint(belief).world.stamp_ns / 1e9 <= 61.0


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "option", "room"),
    [
        ("states.jsonl", "--out=", 60_000),
        ("states.mcap", "--export=mcap=", 40_000),
        ("kept.wav", "--keep-sound=", 200_000),
    ],
)
def test_a_full_disk_gives_a_notice_and_readable_files(street, tmp_path, name, option, room):
    file = tmp_path / name
    done = subprocess.run(
        [*COMMAND, *played(street, f"{option}{file}", "--duration", "60", "--speed", "20", "--json")],
        # A limit of the file size; the kernel reports it like a full disk.
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (room, room)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert 1 <= done.stderr.count(name) <= 2, done.stderr
    assert "room to write" in done.stderr
    assert json.loads(done.stdout)["sound_s"] == pytest.approx(60.0, abs=2.0)
    if name == "kept.wav":
        assert 24 * 4 * len(soundfile.read(file)[0]) / 8 > 0.9 * room
    else:
        assert "records were lost" in done.stderr
        assert file.stat().st_size > 0.5 * room
        assert 1.0 < stamps_s(file)[-1] < 58.0


def test_the_belief_is_saved_every_minute_and_at_an_error(street, tmp_path, monkeypatch):
    belief = tmp_path / "belief.json"
    monkeypatch.setattr(live, "SAVED_EVERY_NS", 500_000_000)
    seen = []

    def show(step):
        if belief.exists():
            seen.append((step.step.state.stamp_ns, read_checkpoint(belief).world.stamp_ns))
        if step.step.state.stamp_ns >= 1_600_000_000:
            raise InputFileError("viewer", "full")

    monkeypatch.setattr("worldstate.cli.common.live_view.view_of", show)
    assert main(words(street, tmp_path, "--speed", 10, "--view")) == 2
    assert seen
    assert all(0 < now_ns - saved_ns <= 500_000_000 for now_ns, saved_ns in seen)
    assert read_checkpoint(belief).world.stamp_ns >= 1_500_000_000


def test_records_after_a_full_disk_follow_the_last_whole_one(tmp_path, caplog):
    unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
    with line_writer(path := tmp_path / "log.jsonl", GrowingFile) as write:
        write("first")
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (10, unlimited[1]))
            for _ in range(3):
                write("second")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
        write("third")
    assert path.read_bytes() == b"first\nthird\n"
    told = [message.removeprefix(f"{path}: ") for message in caplog.messages]
    assert told == ["expected room to write (File too large)", "3 records were lost"]


@pytest.mark.parametrize("removal", [Path.unlink, lambda path: path.rename(path.with_name("taken.jsonl"))])
def test_a_removed_log_gives_a_notice_and_restarts(tmp_path, caplog, removal):
    path = tmp_path / "log.jsonl"
    with line_writer(path, GrowingFile) as write:
        for round_ in range(3):
            write(f"before {round_}")
            removal(path)
            write(f"after {round_}")
            assert path.read_text() == f"after {round_}\n"
            assert caplog.messages == [f"{path}: {MOVED}"] * (round_ + 1)
    assert not (tmp_path / "log.1.jsonl").exists()


def test_a_removed_mcap_restarts(tmp_path, caplog):
    path, states = tmp_path / "a.mcap", [WorldState(0, number * 100_000_000) for number in range(60)]
    with mcap_file(path, GrowingFile) as write:
        for number, state in enumerate(states):
            if number == 30:
                path.unlink()
            for message in state_messages(state):
                write(message)
    assert stamps_s(path) == [state.stamp_ns / 1e9 for state in states[30:]]
    assert "moved or removed" in caplog.text


@pytest.mark.parametrize("name", ["trace.osi", "trace.mcap"])
def test_a_removed_trace_gives_a_notice(tmp_path, caplog, name):
    pytest.importorskip("osi3")
    state = scripted_states()[-1]
    with osi_trace(tmp_path / name, 9.0, GrowingFile) as write:
        write(state)
        (tmp_path / name).unlink()
        write(state)
    assert "moved or removed" in caplog.text
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["rosbag", "rosbag-sqlite3"])
@pytest.mark.parametrize("at_ns", [1_500_000_000, 2_000_000_000])
def test_a_removed_bag_does_not_end_the_run(street, tmp_path, monkeypatch, caplog, name, at_ns):
    def show(step):
        if step.step.state.stamp_ns == at_ns:
            shutil.rmtree(next(tmp_path.glob(".bag*")))

    monkeypatch.setattr("worldstate.cli.common.live_view.view_of", show)
    monkeypatch.setattr("worldstate.cli.common.live_view._SHOWN_EVERY_NS", 0)
    bag, states = tmp_path / "bag", tmp_path / "states.jsonl"
    assert main(played(street, "--out", states, "--export", f"{name}={bag}", "--speed", 10, "--view")) == 0
    assert stamps_s(states)[-1] == 2.0
    assert [message.partition(": ")[0] for message in caplog.messages] == [str(bag)]
    assert not bag.exists()


def test_a_removed_folder_does_not_end_the_run(tmp_path, caplog):
    (folder := tmp_path / "logs").mkdir()
    with line_writer(folder / "log.jsonl", GrowingFile) as write:
        write("one")
        shutil.rmtree(folder)
        for _ in range(5):
            write("two")
        folder.mkdir()
        write("three")
    assert (folder / "log.jsonl").read_text() == "three\n"
    assert len(caplog.records) == 3


def test_a_second_run_with_the_same_log_raises_an_error(tmp_path):
    path = tmp_path / "log.jsonl"
    with line_writer(path, GrowingFile) as write:
        for lines in range(3):
            with pytest.raises(InputFileError, match="another run writes to it"):
                GrowingFile(path)
            write(str(lines))
    assert path.read_text() == "0\n1\n2\n"
    assert [one.name for one in tmp_path.iterdir()] == ["log.jsonl"]


def test_files_of_others_are_not_overwritten(tmp_path):
    path = tmp_path / "log.jsonl"
    (tmp_path / "log.1.jsonl").write_text("of the user")
    path.write_text("of the run before")
    with line_writer(path, partial(GrowingFile, most_bytes=100)) as write:
        for number in range(80):
            write(f"{number:>10}")
            if number == 40:  # a user moves the full file and puts another one in its place
                (tmp_path / "log.3.jsonl").rename(tmp_path / "mine.jsonl")
                (tmp_path / "log.3.jsonl").write_text("mine, too")
    held = {one.name: one.read_text() for one in tmp_path.iterdir()}
    assert sorted(held) == [*(f"log.{number}.jsonl" for number in range(1, 5)), "log.jsonl", "mine.jsonl"]
    kept = [held[f"log.{number}.jsonl"] for number in (1, 2, 3)]
    assert kept == ["of the user", "of the run before", "mine, too"]


def test_removed_sound_gives_a_notice(tmp_path, caplog):
    path, block = tmp_path / "kept.wav", np.zeros((800, 2), np.float32)
    path.write_bytes(b"of the run before")
    with kept_sound(path, RATE, 2) as keep:
        for number in range(10):
            if number == 5:
                path.unlink()
            keep(block)
    assert caplog.messages == [f"{path}: nothing is kept after 0.5 s: it was moved or removed"]
    assert (tmp_path / "kept.1.wav").read_bytes() == b"of the run before"


def test_a_full_mcap_continues_in_a_new_file(street, tmp_path, monkeypatch):
    monkeypatch.setattr("worldstate.cli.common.exports.most_bytes", lambda arguments: 30_000)
    assert main(words(street, tmp_path, "--speed", 5, "--duration", 8)) == 0
    for suffix in ("mcap", "jsonl"):
        before, after = (stamps_s(tmp_path / f"states{part}.{suffix}") for part in (".1", ""))
        assert after[0] - before[-1] == pytest.approx(0.1)
        assert after[-1] == 8.0
