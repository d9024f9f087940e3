"""A well-formed input of `run` without effect gives a line or an error."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import soundfile

from worldstate.cli.main import main

LENGTH_S = 3.0
LENS = {"width_px": 1936, "height_px": 1216, "horizontal_fov_deg": 68.75, "position_m": [-0.57, 0, -0.49]}
FRONT = {"name": "front", **LENS}
EMPTY = {"boxes": [], "scores": [], "classes_str": []}
ASKED = {"detections_per_frame": [EMPTY] * 30}
TRUCK = {"boxes": [[10.0, 200.0, 400.0, 600.0]], "scores": [0.4], "classes_str": ["truck"]}
NOTHING = {"detections_per_frame": list[object]()}


def odometry(*times_s: float) -> str:
    return "time_s,speed_mps\n" + "".join(f"{time_s},0\n" for time_s in times_s)


def boxes(content: object) -> Mapping[str, object]:
    return {"--detections d.json": content}


def car(**parts: object) -> Mapping[str, object]:
    return {"--car car.json": parts}


CAMERAS = (
    {**FRONT, "detections": "asked.json"},
    {**FRONT, "name": "rear", "yaw_deg": 180, "detections": "nothing.json"},
)
# Inputs beside the sound: an option with the content of its file or its words, and the printed line.
SILENT: dict[str, tuple[Mapping[str, object], str]] = {
    "boxes of no image": (boxes(NOTHING), "searched no image"),
    "one image listed": (boxes({"images": [{"id": 0}], "annotations": []}), "1 of 1 stamps"),
    "MOTChallenge text, empty": ({"--detections d.txt": ""}, "searched no image"),
    "boxes that do not count": (
        boxes({"detections_per_frame": [TRUCK] + [EMPTY] * 29}),
        "none of its boxes has counted yet",
    ),
    "a camera alone": ({"--camera c.json": LENS}, "--camera without --detections"),
    "a camera of a car alone": (car(cameras=[FRONT]), "cameras of --car without"),
    "an empty car": (car(), "no array, camera, model, odometry or measurements"),
    "a car's name": (car(name="mine"), "no array, camera"),
    "one of two cameras": (car(cameras=CAMERAS), "rear: the detector searched no image"),
    "an empty context": ({"--context x.json": {}}, "it is empty"),
    "odometry, empty": ({"--odometry o.csv": odometry()}, "at least one line"),
    "odometry in milliseconds": ({"--odometry o.csv": odometry(*range(0, 3000, 100))}, "in another unit"),
    "sound that was heard before": ({"--resume state.json": None}, "all of this sound was used before"),
}


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    folder = tmp_path_factory.mktemp("street")
    noise = np.random.default_rng(0).uniform(-0.01, 0.01, (round(48_000 * LENGTH_S), 1))
    sound = noise + np.random.default_rng(1).uniform(-0.002, 0.002, (len(noise), 56))
    soundfile.write(folder / "a.wav", sound, 48_000)
    (folder / "asked.json").write_text(json.dumps(ASKED))
    (folder / "nothing.json").write_text(json.dumps(NOTHING))
    assert main(["run", str(folder / "a.wav"), "--save-state", str(folder / "state.json")]) == 0
    return folder


@pytest.mark.parametrize("name", SILENT)
def test_an_input_without_effect_gives_a_line(street, name, monkeypatch, capsys, caplog):
    monkeypatch.chdir(street)
    given, told = SILENT[name]
    words = ["run", "a.wav"]
    for option, held in given.items():
        words += option.split()
        if option.endswith(".json") and held is not None:
            Path(words[-1]).write_text(json.dumps(held))
        elif held is not None and " " in option:
            Path(words[-1]).write_text(str(held))
        elif held is not None:
            words.append(str(held))
    code = main(words)
    said = capsys.readouterr().err + caplog.text
    assert code in (0, 2) and told in said, said


USED = "--detections asked.json", "--car asked_car.json", "--odometry steady.csv"


@pytest.mark.parametrize("words", ["", *USED, "--resume state.json --start 3"])
def test_an_input_with_an_effect_gives_no_line(street, words, monkeypatch, capsys, caplog):
    monkeypatch.chdir(street)
    Path("asked_car.json").write_text(json.dumps({"cameras": [{**FRONT, "detections": "asked.json"}]}))
    Path("steady.csv").write_text(odometry(*np.arange(0.0, LENGTH_S, 0.1)))
    assert main(["run", "a.wav", *words.split()]) == 0
    assert [one.message for one in caplog.records if "no array is named" not in one.message] == []
    assert capsys.readouterr().err == ""
