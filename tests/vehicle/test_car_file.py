"""Car files: rotated arrays, several cameras, clocks and errors of fields."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import soundfile
from camera_boxes import boxed, write_boxes
from scipy.spatial.transform import Rotation

from worldstate.adapters import read_model, save_model
from worldstate.adapters.vehicle.car_file import Mounting, read_car
from worldstate.cli.main import main
from worldstate.ground.errors import InputFileError, InvalidArgumentError

# Three-dimensional: two rings of five, one above the other.
TURN = 2.0 * np.pi * np.arange(10) / 5
RINGS = np.stack([0.2 * np.cos(TURN), 0.2 * np.sin(TURN), np.repeat([0.0, 0.15], 5)], axis=1)
ARRAY = {"positions_m": RINGS.tolist(), "position_m": [1.2, 0.1, 1.6], "yaw_deg": 30.0, "pitch_deg": -12.0}
LENS = {"width_px": 640, "height_px": 480, "horizontal_fov_deg": 60.0}
FRONT = LENS | {"name": "front", "position_m": [2.0, 0.1, 1.2], "stamp_offset_s": 0.25}
LEFT = LENS | {"name": "left", "position_m": [1.5, 0.9, 1.2], "yaw_deg": 60.0, "roll_deg": 3.0}
CAR = {"name": "shuttle", "array": ARRAY, "cameras": [FRONT, LEFT]}


def written(folder: Path, car: object) -> Path:
    path = folder / "car.json"
    path.write_text(json.dumps(car))
    return path


def street(folder: Path) -> str:
    """Write 1.5 s of noise of ten microphones."""
    soundfile.write(folder / "street.wav", np.random.default_rng(0).normal(0.0, 0.1, (24_000, 10)), 16_000)
    return str(folder / "street.wav")


@pytest.mark.parametrize("angles", [(30.0, -12.0, 5.0), (-170.0, 80.0, -179.0), (0.0, 0.0, 90.0)])
def test_rotations_of_a_mounting_equal_scipy(angles):
    yaw, pitch, roll = angles
    turned = Rotation.from_euler("ZYX", [yaw, -pitch, roll], degrees=True).apply(RINGS)
    mounted = Mounting((1.0, 2.0, 3.0), yaw, pitch, roll).applied(RINGS)
    np.testing.assert_allclose(mounted, turned + np.array([1.0, 2.0, 3.0]), atol=1e-12)


def test_cameras_have_names_and_positions_relative_to_the_array(tmp_path):
    car = read_car(written(tmp_path, CAR))
    assert list(car.cameras) == ["front", "left"]
    assert car.camera("front") is car.cameras["front"]
    assert car.cameras["front"].position_m == pytest.approx((0.8, 0.0, -0.4))
    assert car.cameras["left"].position_m == pytest.approx((0.3, 0.8, -0.4))
    assert math.degrees(car.cameras["left"].yaw_rad) == pytest.approx(60.0)
    assert car.cameras["front"].stamp_offset_s == 0.25
    with pytest.raises(InvalidArgumentError, match="expected one of front, left, got 'rear'"):
        car.camera("rear")


def test_the_array_may_be_in_a_file_beside_or_a_board(tmp_path):
    (tmp_path / "mics.csv").write_text("\n".join(",".join(map(str, row)) for row in RINGS.tolist()))
    beside = {"array": {"file": "mics.csv"} | {k: v for k, v in ARRAY.items() if k != "positions_m"}}
    inline = read_car(written(tmp_path, CAR)).array
    np.testing.assert_allclose(read_car(written(tmp_path, beside)).array.positions_m, inline.positions_m)
    mounted = {"file": "respeaker-usb", "position_m": [1.0, 0.0, 1.5], "yaw_deg": 90}
    board = read_car(written(tmp_path, {"array": mounted})).array
    np.testing.assert_allclose(board.positions_m[0], [1.0, -0.032, 1.5], atol=1e-12)
    assert board.channels == (2, 3, 4, 5)


def changed(part: str, **keys: object) -> object:
    array, front = (one | keys if part == name else one for name, one in (("array", ARRAY), ("front", FRONT)))
    return {"array": array, "cameras": [front, LEFT]} | (keys if part == "car" else {})


@pytest.mark.parametrize(
    ("car", "said"),
    [
        ([], "car: expected an object"),
        (changed("car", wheels=4), r"car: expected keys among .*, got \['wheels'\]"),
        (changed("array", file="mics.csv"), "car.array: expected either file or positions_m"),
        (changed("array", yaw=3.0), r"car.array: expected keys among .*'yaw_deg'\], got \['yaw'\]"),
        (changed("array", pitch_deg=100.0), r"car.array: pitch_deg: expected a number in \[-90.0, 90.0\]"),
        (changed("array", position_m=[1200.0, 0.0, 1600.0]), r"car.array: position_m.x: .* got 1200.0"),
        (changed("array", positions_m=[[0.0, 1.0]]), r"car.array.positions_m\[0\]"),
        (changed("array", yaw_deg="left"), "car.array.yaw_deg: expected a finite number, got 'left'"),
        (changed("front", name="left"), r"car.cameras\[1\].name: expected a unique name, got 'left'"),
        (changed("front", stamp_offset_s=1e10), r"car.cameras\[0\]: stamp_offset_s: .* got 1"),
        (changed("front", position_m=None), r"car.cameras\[0\]: .*position_m: expected its position"),
    ],
)
def test_errors_of_a_car_file_name_the_field(tmp_path, car, said):
    with pytest.raises(InputFileError, match=said) as refused:
        read_car(written(tmp_path, car))
    assert "car.json" in str(refused.value)


def test_a_car_file_equals_single_options(tmp_path):
    """Array, boxes of two cameras, motion, engine and model give the states of single options."""
    (tmp_path / "moves.csv").write_text("time_s,speed_mps\n0,3\n9,3\n")
    save_model(tmp_path / "mine.json", read_model())
    wide = [one | {"horizontal_fov_deg": 90.0} for one in (FRONT, LEFT)]
    sensors = read_car(written(tmp_path, CAR | {"cameras": wide})).cameras
    told = [boxes(tmp_path, name, sensors[name].column(np.full(15, 0.5)).tolist()) for name in sensors]
    options = [word for one in told for word in ("--detections", one)]
    options += ["--odometry", str(tmp_path / "moves.csv"), "--model", str(tmp_path / "mine.json")]
    words = ["run", street(tmp_path), "--car", str(tmp_path / "car.json")]
    assert main([*words, *options, "--uncalibrated", "--out", str(tmp_path / "by_options.jsonl")]) == 0
    full = [one | {"detections": f"{one['name']}.json"} for one in wide]
    written(tmp_path, CAR | {"cameras": full, "odometry": "moves.csv", "model": "mine.json"})
    assert main([*words, "--uncalibrated", "--out", str(tmp_path / "alone.jsonl")]) == 0
    states = (tmp_path / "alone.jsonl").read_text()
    assert states == (tmp_path / "by_options.jsonl").read_text()
    last = json.loads(states.splitlines()[-1])
    assert [one["sensor"] for one in last["searched"]] == ["front", "left"]


def boxes(folder: Path, name: str, columns_px: list[float]) -> str:
    path = write_boxes(folder / f"{name}.json", [boxed((x - 15, 100, x + 15, 300)) for x in columns_px])
    return f"{name}={path}"


TWICE = ["--detections", "left=a", "--detections", "left=b"]
WRONG = [
    (["--array", "mics.csv"], "car: expected no array with it"),
    (["--camera", "lens.json"], "camera: expected one of front, left, got 'lens.json'"),
    (["--detections", "a.json", "--detections", "b.json"], "--detections: expected one, or --car with"),
    (["--camera", "left", "--detections", "front=a.json"], "those of several cameras without a camera"),
    (TWICE, "--detections: expected different names, got left=a left=b"),
    (["--detections", "rear=a.json"], "camera: expected one of front, left, got 'rear'"),
    (["--detections", "left=a.json"], "a.json"),
]


@pytest.mark.parametrize(("words", "said"), WRONG)
def test_options_that_contradict_the_car_file_or_each_other_are_refused(tmp_path, refused, words, said):
    run = ["run", street(tmp_path), "--car", str(written(tmp_path, CAR)), "--uncalibrated"]
    assert said in refused([*run, *words])
