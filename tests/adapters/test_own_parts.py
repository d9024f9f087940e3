"""Plug-ins: the example package is installed and its parts are used on the command line."""

import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from scripted_states import scripted_states

from worldstate.adapters import AcousticAdapter, write_array_xml
from worldstate.adapters.live.live_sensors import ImageLooks, image_channel
from worldstate.adapters.own_parts import OwnDetector, installed, of_part
from worldstate.cli.main import main
from worldstate.ground.errors import OwnPartError
from worldstate.ground.values import nanoseconds

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "own_parts"


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """Install the example into an empty folder."""
    target, tree = tmp_path_factory.mktemp("site"), tmp_path_factory.mktemp("tree") / "own_parts"
    shutil.copytree(EXAMPLE, tree)
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--target", str(target)]
    done = subprocess.run(
        [sys.executable, "-m", "pip", "install", *options, str(tree)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return target


@pytest.fixture
def own_parts(package, monkeypatch):
    monkeypatch.syspath_prepend(package)
    monkeypatch.delitem(sys.modules, "own_parts", raising=False)
    import own_parts

    return own_parts


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "states.jsonl"
    path.write_text("".join(state.to_json() + "\n" for state in scripted_states()))
    return path


@pytest.mark.long
def test_an_exporter_gets_every_state(own_parts, log, tmp_path):
    assert main(["log", "replay", str(log), "--export", f"table={tmp_path / 'risk.csv'}"]) == 0
    with (tmp_path / "risk.csv").open() as file:
        rows = list(csv.DictReader(file))
    cues = [(state, cue) for state in scripted_states() for cue in state.cues]
    assert [(row["side"], row["risk"], row["advisory"]) for row in rows] == [
        (cue.direction, str(round(cue.risk, 4)), str(cue.advisory is not None)) for _, cue in cues
    ]


@pytest.mark.long
def test_an_own_sensor_gives_the_position_of_a_hidden_vehicle(own_parts, approach, tmp_path):
    """Messages from 2 s on place it on the left, 20 m away; the sound comes from the right."""
    messages = [
        {"stamp_ns": round(time_s * 1e9), "x_m": 9.0, "y_m": 30.0 - 5.0 * time_s}
        for time_s in np.arange(2.0, 4.0, 0.1)
    ]
    beacons, out = tmp_path / "v2x.jsonl", tmp_path / "states.jsonl"
    beacons.write_text("".join(json.dumps(one) + "\n" for one in messages))
    (tmp_path / "car.json").write_text('{"measurements": {"v2x": "v2x.jsonl"}}')
    assert main(["run", str(approach.folder), "--car", str(tmp_path / "car.json"), "--out", str(out)]) == 0
    after = [json.loads(line) for line in out.open()]
    at_3 = next(state for state in after if state["stamp_ns"] == 3_000_000_000)
    (placed,) = (one for one in at_3["entities"] if one["position_m"] is not None)
    assert placed["position_m"][:2] == pytest.approx([9.0, 15.0], abs=2.0)
    assert placed["existence_probability"] > 0.9
    told = [state["stamp_ns"] for state in after for one in state["entities"] if one["position_m"]]
    assert min(told) >= 2_000_000_000, "a message counts when its time has come"


@pytest.mark.long
def test_an_own_detector_processes_the_video(own_parts, approach, tmp_path):
    folder = tmp_path / "SB1" / "right" / "3_02_0000"
    folder.mkdir(parents=True)
    (folder / "out_multi.wav").symlink_to(approach.folder / "out_multi.wav")
    write_video(folder / "ueye_stereo_vid.mp4")
    options = ["run", str(folder), "--detector", "moving-columns", "--out", str(tmp_path / "s.jsonl")]
    assert main(options) == 0
    states = [json.loads(line) for line in (tmp_path / "s.jsonl").open()]
    found = {state["stamp_ns"]: one["found"] for state in states for one in state["searched"]}
    assert not any(seen for stamp_ns, seen in found.items() if stamp_ns < 5_000_000_000)
    assert sum(seen for stamp_ns, seen in found.items() if stamp_ns >= 5_200_000_000) > 20


def write_video(path, frames=100):
    """Write a grey street with a bright moving block of 300 pixels from image 50 on."""
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (968, 304))
    for number in range(frames):
        image = np.full((304, 968, 3), 90, np.uint8)
        if number >= 50:
            left = 12 * (number - 50)
            image[:, left : left + 300] = 220
        video.write(image)
    video.release()


def test_an_own_array_and_signature_give_measurements(own_parts, tmp_path):
    array = own_parts.my_array()
    write_array_xml(tmp_path / "roof.xml", array)
    adapter = AcousticAdapter(array, 16_000, own_parts.LoudSide())
    rng = np.random.default_rng(0)
    # A plane wave from 60 degrees to the left, in noise.
    wave = rng.normal(size=32_000 + 64)
    spectrum, frequency_hz = np.fft.rfft(wave), np.fft.rfftfreq(len(wave), 1 / 16_000)
    delays_s = array.delays_s(np.pi / 3).ravel()[:, None]
    late = np.fft.irfft(spectrum * np.exp(-2j * np.pi * frequency_hz * delays_s), len(wave)).T[:32_000]
    block = (late + 0.05 * rng.normal(size=late.shape)).astype(np.float32)
    measured = adapter.measure(block)
    assert len(measured) == 11
    left, right = measured[-1].signature.hidden
    assert left > right + 1.0
    assert measured[-1].bearing.azimuth_rad == pytest.approx(np.pi / 3, abs=0.1)


def test_only_selected_plug_ins_are_imported(package, log, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(package)
    monkeypatch.delitem(sys.modules, "own_parts", raising=False)
    assert main(["log", "replay", str(log), "--export", f"autoware={tmp_path / 'a.jsonl'}"]) == 0
    assert "own_parts" not in sys.modules
    assert installed("worldstate.exporters") == ["table"]


def test_an_unknown_plug_in_is_refused_with_the_known_ones(own_parts, log, approach, tmp_path, capsys):
    replay, run = ["log", "replay", str(log)], ["run", str(approach.folder)]
    for name in ("radar", "v2x"):
        (tmp_path / f"{name}.json").write_text(json.dumps({"measurements": {name: "none.jsonl"}}))
    for options, said in (
        ([*replay, "--export", "sheet=a.csv"], "rosbag-sqlite3, table), got 'sheet'"),
        ([*replay, "--export", "table"], "--export: expected NAME=TARGET, got 'table'"),
        ([*run, "--car", str(tmp_path / "radar.json")], "worldstate.measurements (v2x), got 'radar'"),
        (
            [*run, "--car", str(tmp_path / "v2x.json")],
            "v2x: expected a part that works, got FileNotFoundError",
        ),
        ([*run, "--detector", "yolo"], "worldstate.detectors (motion, knn, FILE.onnx, moving-columns), got"),
    ):
        assert main(options) == 2, options
        assert said in " ".join(capsys.readouterr().err.split()), options


def test_a_broken_plug_in_has_its_own_error(log, tmp_path, monkeypatch, capsys):
    for name, text in (("broken", "raise RuntimeError('no licence')"), ("number", "export = 7")):
        (tmp_path / f"{name}.py").write_text(text)
        info = tmp_path / f"{name}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[worldstate.exporters]\n{name} = {name}:export\n")
    monkeypatch.syspath_prepend(tmp_path)
    for name, said in (("broken", "(RuntimeError: no licence)"), ("number", "to be callable, got 7")):
        assert main(["log", "replay", str(log), "--export", f"{name}=x"]) == 2
        assert said in capsys.readouterr().err


RAISING = """
import contextlib

@contextlib.contextmanager
def at_once(target):
    raise SystemExit(0)
    yield

@contextlib.contextmanager
def at_a_state(target):
    def export(state):
        raise SystemExit(3)
    yield export
"""


@pytest.mark.parametrize("name", ["at_once", "at_a_state"])
def test_a_plug_in_that_exits_is_an_error(name, log, tmp_path, monkeypatch, capsys):
    (tmp_path / "raising.py").write_text(RAISING)
    info = tmp_path / "raising-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: raising\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[worldstate.exporters]\n{name} = raising:{name}\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert main(["log", "replay", str(log), "--export", f"{name}=x"]) == 2
    said = capsys.readouterr().err
    assert f"{name}: expected a part that works, got SystemExit" in said


@pytest.mark.parametrize("error", [SystemExit(0), BaseException("odd"), RuntimeError("no licence")])
def test_a_detector_that_raises_ends_the_run_with_its_name(error):
    class Raising:
        def detect(self, frame):
            raise error

    images = image_channel()
    images.put((0.0, np.zeros((480, 640, 3), np.uint8)))
    looks = ImageLooks(images, OwnDetector.of("mine", Raising), nanoseconds, (640, 480))
    with pytest.raises(OwnPartError, match=f"mine: expected a part that works, got {type(error).__name__}"):
        looks.deliver(lambda *look: None)


def test_a_signal_during_a_plug_in_is_not_its_error():
    with pytest.raises(SystemExit), of_part("mine"):
        raise SystemExit(128 + 15)
