"""`worldstate live` on a played recording."""

import io
import json
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import soundfile
from camera_boxes import LENS
from rich.console import Console
from stand_ins import free_port, played, sending, wall

from worldstate.adapters.audio.sound_file import open_sound
from worldstate.adapters.live.live_listening import live_steps
from worldstate.adapters.live.live_sound import LiveSound, Playback
from worldstate.adapters.source import ListenSettings, open_source
from worldstate.cli.common.live_view import view_of
from worldstate.cli.main import main

NO_BOXES = json.dumps({"boxes": [], "scores": [], "classes_str": [], "age_s": 0.02}).encode()


def snapshots(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def looked_at(path):
    return {view["sensor"] for snapshot in snapshots(path) for view in snapshot["searched"]}


def report_of(words, capsys):
    assert main([*words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_live_has_the_states_of_run_and_keeps_sound_on_request_only(street, tmp_path, capsys, refused):
    live, run, kept = tmp_path / "live" / "states.jsonl", tmp_path / "run.jsonl", tmp_path / "kept.wav"
    live.parent.mkdir()
    report = report_of(played(street, "--speed", 4, "--out", live), capsys)
    assert main(["run", *played(street)[2:], "--out", str(run)]) == 0
    assert live.read_text() == run.read_text()
    assert [path.name for path in live.parent.iterdir()] == ["states.jsonl"]
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
    monkeypatch.setattr(slow, lambda live: time.sleep(0.05) or view_of(live))
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
    script = [sys.executable, "-m", "worldstate", *played(street, "--duration", 60, "--out", out, "--json")]
    with subprocess.Popen(script, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
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
