"""Plug-ins on the command line, and the examples of a loop of the user's own and of NanoDet."""

import csv
import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from camera_boxes import write_video
from made_up_sound import plane_wave
from scripted_states import scripted_states, write_states

from worldstate.adapters import AcousticAdapter, Detector, open_video, write_array_xml
from worldstate.adapters.camera.box_linking import overlaps
from worldstate.adapters.own_parts import OwnDetector, installed, of_part
from worldstate.belief.street_model import StreetModel
from worldstate.cli.main import main
from worldstate.ground.errors import InputFileError

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "docs" / "examples"


def example(name):
    """Import an example of the pages."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """Install the example into an empty folder."""
    target, tree = tmp_path_factory.mktemp("site"), tmp_path_factory.mktemp("tree") / "own_parts"
    shutil.copytree(EXAMPLES / "own_parts", tree)
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--target", str(target)]
    words = [sys.executable, "-m", "pip", "install", *options, str(tree)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
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
    return write_states(tmp_path / "states.jsonl", scripted_states())


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
    beacons, out = tmp_path / "v2x.jsonl", tmp_path / "states.jsonl"
    rows = [(round(s * 1e9), 30.0 - 5.0 * s) for s in np.arange(2.0, 4.0, 0.1)]
    beacons.write_text("".join(f'{{"stamp_ns": {ns}, "x_m": 9.0, "y_m": {y}}}\n' for ns, y in rows))
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
    # A grey street with a bright moving block of 300 pixels from image 50 on.
    images = np.full((100, 304, 968, 3), 90, np.uint8)
    for number in range(50, 100):
        images[number, :, 12 * (number - 50) :][:, :300] = 220
    write_video(folder / "ueye_stereo_vid.mp4", images)
    options = ["run", str(folder), "--detector", "moving-columns", "--out", str(tmp_path / "s.jsonl")]
    assert main(options) == 0
    states = [json.loads(line) for line in (tmp_path / "s.jsonl").open()]
    found = {state["stamp_ns"]: one["found"] for state in states for one in state["searched"]}
    assert not any(seen for stamp_ns, seen in found.items() if stamp_ns < 5_000_000_000)
    assert sum(seen for stamp_ns, seen in found.items() if stamp_ns >= 5_200_000_000) > 20


def test_an_own_array_and_signature_give_measurements(own_parts, tmp_path):
    array = own_parts.my_array()
    write_array_xml(tmp_path / "roof.xml", array)
    adapter = AcousticAdapter(array, 16_000, own_parts.LoudSide())
    measured = adapter.measure(plane_wave(array, 16_000, np.pi / 3, 2.0))
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
        ([*run, "--car", str(tmp_path / "v2x.json")], "v2x: expected a part that works, got FileNotFound"),
        ([*run, "--detector", "yolo"], "worldstate.detectors (motion, knn, FILE.onnx, moving-columns), got"),
    ):
        assert main(options) == 2, options
        assert said in " ".join(capsys.readouterr().err.split()), options


def installed_module(folder, name, text, entry):
    """Write a module and an exporter in it as an installed package has them."""
    (folder / f"{name}.py").write_text(text)
    (info := folder / f"{name}-1.0.dist-info").mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[worldstate.exporters]\n{entry}\n")


AT_A_STATE = """
import contextlib

@contextlib.contextmanager
def export(target):
    def end(state):
        raise SystemExit(3)
    yield end
"""
BROKEN = {
    "at import": ("raise RuntimeError('no licence')", "(RuntimeError: no licence)"),
    "no function": ("export = 7", "to be callable, got 7"),
    "at once": ("def export(target): raise SystemExit(0)", "a part that works, got SystemExit"),
    "at a state": (AT_A_STATE, "a part that works, got SystemExit"),
}


@pytest.mark.parametrize("how", BROKEN)
def test_a_broken_plug_in_has_its_own_error(how, log, tmp_path, monkeypatch, refused):
    text, said = BROKEN[how]
    module = "broken_" + how.replace(" ", "_")
    installed_module(tmp_path, module, text, f"broken = {module}:export")
    monkeypatch.syspath_prepend(tmp_path)
    assert said in refused(["log", "replay", str(log), "--export", "broken=x"])


def test_a_signal_during_a_plug_in_is_not_its_error():
    with pytest.raises(SystemExit), of_part("mine"):
        raise SystemExit(128 + 15)


def test_the_example_of_a_loop_hands_over_a_hidden_vehicle(capsys):
    own_loop = example("own_loop")
    at = {state.stamp_ns / 1e9: state for state in own_loop.run()}
    assert at[1.4].entities == ()
    (hidden,), (seen,) = at[3.5].entities, at[4.5].entities
    assert (hidden.status, hidden.direction, seen.status) == ("hidden", "left", "visible")
    assert hidden.id == seen.id
    assert at[1.4].risk < 0.1 < 0.8 < at[3.5].risk
    # The remaining risk is the share of vehicles that are followed by another.
    assert at[4.5].risk == pytest.approx(StreetModel().follows, abs=0.05)
    assert [cue.advisory is not None for cue in at[3.5].cues] == [True, False]
    assert seen.azimuth_rad == pytest.approx(own_loop.azimuth_at(4.5), abs=0.03)
    own_loop.main()
    lines = capsys.readouterr().out.splitlines()
    assert "hidden at +" in lines[4]
    assert "visible at" in lines[-1]


# NanoDet: its decoder against a computed box, and the real model on recordings.

RECORDINGS = Path(os.environ.get("OVAD_SEQUENCES", ROOT.parent / "shared" / "ovad-sequences"))


@pytest.fixture(scope="module")
def nanodet():
    return example("nanodet")


class OneCar:
    """A session with a car in every crop: cell (5, 3) of stride 16, sides 2, 0.5, 1 and 3 bins away."""

    def get_inputs(self):
        return [SimpleNamespace(name="image")]

    def run(self, names, feed):
        (self.seen,) = feed.values()
        cells, car, cell = [(416 // stride) ** 2 for stride in (8, 16, 32)], 2, 3 * 26 + 5
        scores, logits = ([np.zeros((1, n, width), np.float32) for n in cells] for width in (80, 32))
        bins = np.full((4, 8), -100.0)
        bins[[0, 1, 1, 2, 3], [2, 0, 1, 1, 3]] = 0.0  # Two bins share a half
        scores[1][0, cell, car], logits[1][0, cell] = 0.9, bins.ravel()
        return [*scores, *logits]


def test_a_box_is_decoded_as_computed(nanodet):
    # The cell's middle is 16 (5, 3) + 7.5 = (87.5, 55.5); its sides are 32, 8, 16 and 48 px away. The crop
    # begins at (100, 50) and is twice the size of the input.
    session = OneCar()
    detector: Detector = nanodet.NanoDet(session, [(100.0, 50.0, 832.0)])
    found = detector.detect(np.full((1216, 1936, 3), 128, np.uint8))
    assert found.labels == ("car",)
    np.testing.assert_allclose(found.boxes_px, [[211.0, 145.0, 307.0, 257.0]], atol=1e-3)
    np.testing.assert_allclose(found.scores, [0.9], rtol=1e-6)
    assert session.seen.shape == (1, 3, 416, 416)
    np.testing.assert_allclose(session.seen[0, 0], (128 - 103.53) / 57.375, rtol=1e-5)


def test_a_model_that_is_not_there_is_named(nanodet, tmp_path):
    with pytest.raises(InputFileError, match="expected an ONNX model"):
        nanodet.open_nanodet(tmp_path / "none.onnx")


@pytest.mark.skipif(
    not (RECORDINGS / "detector").is_dir(),
    reason="no ovad-sequences, neither where OVAD_SEQUENCES points nor in ../shared",
)
def test_boxes_are_those_that_come_with_the_recordings(nanodet, monkeypatch):
    # `worldstate run --detector nanodet` opens it like this.
    monkeypatch.setenv("NANODET_ONNX", str(RECORDINGS / "detector" / "nanodet_m.onnx"))
    detector = OwnDetector.of("nanodet", nanodet.open_nanodet)
    given = json.loads((RECORDINGS / "boxes" / "1_04_0018.json").read_text())["frames"]
    shared = []
    for number, image in enumerate(open_video(RECORDINGS / "video" / "1_04_0018.mp4").frames()):
        if number in (40, 75, 85):
            boxes = np.array([row[:4] for row in given[number]])
            shared += overlaps(boxes, detector.detect(image).boxes_px).max(axis=1).tolist()
    assert len(shared) > 10
    assert np.mean(np.array(shared) > 0.9) > 0.9
