"""`worldstate live` on a played recording."""

import io
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile
from rich.console import Console

from worldstate.adapters.audio.sound_file import open_sound
from worldstate.adapters.live.live_listening import live_steps
from worldstate.adapters.live.live_sound import LiveSound, Playback
from worldstate.adapters.source import ListenSettings, open_source
from worldstate.cli.common.live_view import view_of
from worldstate.cli.main import main

RATE = 8_000


def command(street, *more):
    play = "--play", str(street / "street.wav"), "--array", str(street / "mics.csv"), "--uncalibrated"
    return ["live", *play, *map(str, more)]


def test_live_has_the_states_of_run_and_keeps_no_sound(street, tmp_path, capsys):
    live, run = tmp_path / "live" / "states.jsonl", tmp_path / "run.jsonl"
    live.parent.mkdir()
    assert main(command(street, "--speed", 4, "--out", live, "--json")) == 0
    report = json.loads(capsys.readouterr().out)
    assert main(["run", *command(street)[2:], "--out", str(run)]) == 0
    assert live.read_text() == run.read_text()
    assert [path.name for path in live.parent.iterdir()] == ["states.jsonl"]
    assert report["states"] == 11
    assert report["calibration"] == "uncalibrated"
    assert report["overruns"] == report["lost_s"] == 0
    assert 0.0 < report["latency_median_s"] <= report["latency_p99_s"] <= report["latency_largest_s"]
    assert report["cpu_s"] > 0.0


def test_sound_is_kept_on_request(street, tmp_path):
    kept = tmp_path / "kept.wav"
    assert main(command(street, "--speed", 20, "--keep-sound", kept)) == 0
    heard, rate_hz = soundfile.read(kept)
    assert rate_hz == RATE
    np.testing.assert_array_equal(heard, soundfile.read(street / "street.wav")[0])


def test_kept_sound_does_not_replace_its_source(street, capsys):
    assert main(command(street, "--keep-sound", street / "street.wav")) == 2
    assert "this one is an input" in capsys.readouterr().err


def test_losses_are_reported_when_they_happen(street, capsys, monkeypatch):
    slow = "worldstate.cli.common.live_view.view_of"
    monkeypatch.setattr(slow, lambda live: time.sleep(0.05) or view_of(live))
    assert main(command(street, "--speed", 100, "--duration", 8, "--view", "--json")) == 0
    said = capsys.readouterr()
    assert "overruns" in said.err
    assert "s of sound lost" in said.err
    assert json.loads(said.out)["overruns"] > 0


def test_the_view_shows_bearing_risk_and_losses(street):
    source = open_source(
        LiveSound(Playback(open_sound(street / "street.wav"), speed=20.0)),
        array=street / "mics.csv",
        settings=ListenSettings(uncalibrated=True),
    )
    console = Console(record=True, width=100, file=io.StringIO())
    console.print(view_of(replace(list(live_steps(source))[-1], overruns=3, lost_s=0.075)))
    shown = console.export_text()
    assert "2.0 s   latency" in shown
    assert "3 overruns, 0.07 s lost" in shown or "3 overruns, 0.08 s lost" in shown
    assert [line.split()[0] for line in shown.splitlines() if "risk" in line] == ["left", "right"]
    assert "not usable: uncalibrated" in shown


@pytest.mark.long
def test_a_signal_ends_the_run_with_complete_files(street, tmp_path):
    out = tmp_path / "states.jsonl"
    words = command(street, "--duration", 60, "--out", out, "--json")
    script = [sys.executable, "-m", "worldstate", *words]
    with subprocess.Popen(script, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=os.environ) as process:
        until_s = time.monotonic() + 60.0
        # The file has its name only at the end, so wait for content in the temporary one beside it.
        while not any(one.stat().st_size for one in tmp_path.iterdir()) and time.monotonic() < until_s:
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        printed, _ = process.communicate(timeout=60.0)
    assert process.returncode == 0
    assert json.loads(printed)["states"] == len(out.read_text().splitlines()) > 0


class Capture:
    """Stand-in for VideoCapture of OpenCV: a grey wall at 10 Hz."""

    def __init__(self, device: int) -> None:
        self._opened = True

    def isOpened(self) -> bool:  # noqa: N802 - its name there
        return self._opened

    def read(self):
        time.sleep(0.1)
        return True, np.full((480, 640, 3), 90, np.uint8)

    def release(self) -> None:
        self._opened = False


def looked_at(states):
    snapshots = map(json.loads, states.read_text().splitlines())
    return [view["sensor"] for snapshot in snapshots for view in snapshot["searched"]]


def test_a_local_camera_is_queried(street, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        "worldstate.adapters.live.live_sensors.optional", lambda module: SimpleNamespace(VideoCapture=Capture)
    )
    lens, states = tmp_path / "lens.json", tmp_path / "states.jsonl"
    camera = {"width_px": 640, "height_px": 480, "horizontal_fov_deg": 70, "position_m": [0, 0, 0]}
    lens.write_text(json.dumps(camera))
    asked = "--camera-device", 0, "--camera", lens, "--out", states, "--json"
    assert main(command(street, *asked)) == 0
    # Every image is processed before the next block of sound.
    assert json.loads(capsys.readouterr().out)["images_dropped"] < 15
    assert "camera" in looked_at(states)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


@contextmanager
def sending(port: int, *datagrams: bytes):
    """Send these datagrams repeatedly while the block runs."""
    stopped = threading.Event()

    def send():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not stopped.wait(0.05):
                for datagram in datagrams:
                    sender.sendto(datagram, ("127.0.0.1", port))

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopped.set()
        thread.join()


def test_a_separate_detector_is_queried(street, tmp_path, capsys):
    states, port = tmp_path / "states.jsonl", free_port()
    empty = json.dumps({"boxes": [], "scores": [], "classes_str": [], "age_s": 0.02}).encode()
    with sending(port, empty, b"nonsense"):
        asked = "--detections", f"127.0.0.1:{port}", "--out", states, "--json"
        assert main(command(street, *asked)) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["detections_refused"] > 0
    assert "expected" in report["last_refusal"] or "JSON" in report["last_refusal"]
    assert "camera" in looked_at(states)


def test_several_cameras_are_queried(street, tmp_path, capsys):
    lens = {"width_px": 640, "height_px": 480, "horizontal_fov_deg": 70, "position_m": [0, 0, 0]}
    cameras = [{"name": name, **lens, "yaw_deg": yaw} for name, yaw in (("front", 0.0), ("aside", 60.0))]
    car, states = tmp_path / "car.json", tmp_path / "states.jsonl"
    positions_m = np.loadtxt(street / "mics.csv", delimiter=",").tolist()
    car.write_text(json.dumps({"array": {"positions_m": positions_m}, "cameras": cameras}))
    ports = [free_port(), free_port()]
    empty = json.dumps({"boxes": [], "scores": [], "classes_str": []}).encode()
    outside = {"boxes": [[5000, 100, 5120, 300]], "scores": [0.9], "classes_str": ["car"]}
    told = [word for name, port in zip(("front", "aside"), ports, strict=True)
            for word in ("--detections", f"{name}=127.0.0.1:{port}")]  # fmt: skip
    words = ["live", "--play", street / "street.wav", "--car", car, "--uncalibrated", *told, "--out", states]
    with sending(ports[0], empty), sending(ports[1], empty, json.dumps(outside).encode()):
        assert main([*map(str, words), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["detections_refused"] > 0
    assert "640 x 480 px" in report["last_refusal"]
    assert {"front", "aside"} == {*looked_at(states)}
    assert main([*map(str, words), "--detections", "back=127.0.0.1:0"]) == 2
    assert "camera: expected one of front, aside" in capsys.readouterr().err


@pytest.mark.parametrize("command_name", ["live", "run"])
def test_odometry_selects_the_model_of_a_moving_ego(street, tmp_path, caplog, command_name):
    positions_m = np.loadtxt(street / "mics.csv", delimiter=",").tolist()
    (tmp_path / "odometry.csv").write_text("time_s,speed_mps\n0,4\n")
    play = ["--speed", "20", "--play"] if command_name == "live" else []
    for moves in (False, True):
        car = {"array": {"positions_m": positions_m}} | ({"odometry": "odometry.csv"} if moves else {})
        (tmp_path / "car.json").write_text(json.dumps(car))
        states = tmp_path / "states.jsonl"
        sound, given = str(street / "street.wav"), ["--car", str(tmp_path / "car.json"), "--uncalibrated"]
        assert main([command_name, *play, sound, *given, "--out", str(states)]) == 0
        assert ("model of a moving ego" in caplog.text) == moves
        last = json.loads(states.read_text().splitlines()[-1])
        assert last["context"]["ego_speed_mps"] == (4.0 if moves else None)


def test_datagrams_of_odometry_move_the_ego(street, tmp_path, capsys):
    states, port = tmp_path / "states.jsonl", free_port()
    driving = json.dumps({"speed_mps": 5.0, "yaw_rate_rad_s": 0.1, "age_s": 0.01}).encode()
    with sending(port, driving, b'{"speed_mps": 900}', b'{"speed_mps": 1, "x_m": 3}'):
        asked = "--odometry", f"127.0.0.1:{port}", "--out", states, "--json"
        assert main(command(street, *asked)) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["odometry_refused"] > 0
    assert "speed_mps" in report["last_odometry_refusal"] or "together" in report["last_odometry_refusal"]
    ego = json.loads(states.read_text().splitlines()[-1])["ego"]
    assert ego["speed_mps"] == pytest.approx(5.0, abs=0.2)
    assert ego["position_m"][0] > 1.0


def test_live_resumes_from_a_checkpoint_as_run_does(street, tmp_path):
    """Both commands have the same options and states, and the clock continues."""
    saved = {}
    for name in ("live", "run"):
        state, half, rest = (tmp_path / f"{name}{end}" for end in (".json", "1.jsonl", "2.jsonl"))
        words = command(street, "--speed", 20) if name == "live" else ["run", *command(street)[2:]]
        assert main([*words, "--save-state", str(state), "--out", str(half)]) == 0
        start = [] if name == "live" else ["--start", "2"]
        assert main([*words, "--resume", str(state), *start, "--out", str(rest)]) == 0
        saved[name] = state.read_text(), half.read_text(), rest.read_text()
    assert saved["live"] == saved["run"]
    stamps = [json.loads(line)["stamp_ns"] for text in saved["live"][1:] for line in text.splitlines()]
    assert stamps[0] == 10**9 and stamps[-1] == 4 * 10**9
    assert stamps == sorted(stamps)
