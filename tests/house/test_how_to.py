"""The recipes of docs/guide/how_to.md run as they are printed, by section, on small files of their names."""

import json
import re
import shlex
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import soundfile

from worldstate.adapters.files.model_file import read_model, save_model
from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import ovad_array

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "adapters")]
from passing_boxes import passing  # noqa: E402
from test_detectors import FORMS, model_file  # noqa: E402

PAGE = (ROOT / "docs" / "guide" / "how_to.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^## (.*)\n([\s\S]*?)(?=^## |\Z)", PAGE, flags=re.MULTILINE))
SIZE = 480, 320
WIDTH_PX = 1936.0  # Of the camera that is assumed where none is given


def recipes(section: str) -> list[list[str]]:
    """Return the words of every command of a section."""
    return [
        shlex.split(line)[1:] for line in re.findall(r"^    (worldstate .*)$", section, flags=re.MULTILINE)
    ]


def commissions(words: list[str]) -> bool:
    return words[:2] == ["model", "make"]


def run(words: list[str]) -> None:
    assert main(words) == 0, " ".join(words)
    for option in ("--out", "--figure", "--save-state", "--windows"):
        if option in words:
            assert Path(words[words.index(option) + 1]).stat().st_size > 0


@pytest.fixture(scope="module")
def desk(approach, tmp_path_factory):
    """Return a folder with the files that the recipes name."""
    folder = tmp_path_factory.mktemp("how_to")
    _write_sounds(folder, approach)
    positions = "\n".join(",".join(map(str, row)) for row in ovad_array().positions_m.tolist())
    (folder / "mics.csv").write_text("x,y,z\n" + positions + "\n")
    save_model(folder / "my_model.json", read_model())
    lens = {"width_px": SIZE[0], "height_px": SIZE[1], "horizontal_fov_deg": 60, "position_m": [0, 0, 0]}
    (folder / "camera.json").write_text(json.dumps(lens))
    boxes = [
        {"image_id": k, "category_id": 3, "bbox": [100 + 3 * k, 150, 150, 120], "score": 0.9}
        for k in range(15)
    ]
    (folder / "boxes.json").write_text(json.dumps(boxes))
    video = cv2.VideoWriter(str(folder / "street.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, SIZE)
    for image in np.random.default_rng(0).integers(0, 255, (15, SIZE[1], SIZE[0], 3), dtype=np.uint8):
        video.write(image)
    video.release()
    model_file(folder / "m.onnx", FORMS["a score a class"])
    return folder


def _write_sounds(folder: Path, approach) -> None:
    sound, rate = soundfile.read(approach.audio_path, dtype="float32")
    soundfile.write(folder / "some.wav", sound[rate : 5 * rate + rate // 2], rate, subtype="FLOAT")
    soundfile.write(folder / "night.wav", sound[: 2 * rate], rate, subtype="FLOAT")
    frames = passing([(1.0, 1)], 5.0, np.random.default_rng(1)).frames
    rows = [
        {
            "boxes": one.boxes_px.clip(0.0, (WIDTH_PX, 1200.0) * 2).tolist(),
            "scores": one.scores.tolist(),
            "classes_str": list(one.labels),
        }
        for one in frames
    ]
    noise = np.random.default_rng(2).uniform(-0.01, 0.01, (6000 * 8, 56))
    for name in ("recording_folder", "next_recording"):
        (folder / name).mkdir()
        soundfile.write(folder / name / "out_multi.wav", noise, 6000)
        log = json.dumps({"detections_per_frame": rows})
        (folder / name / "camera_baseline_results.json").write_text(log)


@pytest.mark.parametrize("section", [name for name, text in SECTIONS.items() if recipes(text)])
def test_recipes_run_as_they_are_printed(section, desk, monkeypatch):
    monkeypatch.chdir(desk)
    for words in recipes(SECTIONS[section]):
        if not commissions(words):
            if words[:2] == ["model", "fit"]:
                _of_more_recordings(Path("features.csv"))
            run(words)


def _of_more_recordings(table: Path) -> None:
    """Repeat a table as if five recordings had been labelled, as the page asks for, and seconds of nobody."""
    head, *rows = table.read_text().splitlines()
    nobody = [re.sub(r",(left|right|front),", ",none,", row) for row in rows]
    again = [row.replace("recording_folder", f"recording_{k}") for k in range(5) for row in rows + nobody]
    table.write_text("\n".join([head, *again]) + "\n")


@pytest.mark.slow
def test_commissions_run_as_they_are_printed_but_for_their_size(desk, monkeypatch):
    """Quick ones, without the exam; all of them hear the same streams."""
    monkeypatch.chdir(desk)
    sound, rate = soundfile.read("some.wav", dtype="float32")
    soundfile.write("night.wav", np.tile(sound[::8], (90, 1)), rate // 8, subtype="FLOAT")
    for words in (words for text in SECTIONS.values() for words in recipes(text) if commissions(words)):
        run([*words, "--quick", "--no-exam", "--streams", "streams"])
