"""Offset and yaw of a camera from synthetic and rendered passes."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import soundfile
from camera_boxes import LENS
from made_up_sound import THREE

from worldstate.adapters.source import open_source
from worldstate.adapters.vehicle.car_file import read_car, write_aligned
from worldstate.cli.main import main
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.operations.alignment.camera_alignment import HeardPass, align, heard_passes

STREET_M, PACE_MPS = 10.0, 7.0


def azimuth(time_s: np.ndarray, side: int) -> np.ndarray:
    """Return the azimuth of a vehicle from a side that is ahead at 0 s."""
    return np.arctan2(-side * PACE_MPS * time_s, STREET_M)


def passes(
    n: int, offset_s: float, yaw_deg: float, *, std_deg: float = 3.0, other: float = 0.3, sides=(1, -1)
) -> list[HeardPass]:
    """Return passes of a camera with this offset and yaw: stamps too early, azimuths too low."""
    rng = np.random.default_rng(7)
    found = []
    for number in range(n):
        side, start_s = sides[number % len(sides)], 20.0 * number
        box_s, sound_s = np.arange(-0.8, 0.8, 0.1), np.arange(-2.0, 2.0, 0.1) + 0.03
        heard = azimuth(sound_s, side) + np.radians(std_deg) * rng.standard_normal(len(sound_s))
        astray = rng.random(len(heard)) < other
        heard[astray] = rng.uniform(-math.pi / 2, math.pi / 2, int(astray.sum()))
        box_rad = azimuth(box_s, side) - math.radians(yaw_deg)
        found.append(HeardPass(start_s + box_s - offset_s, box_rad, start_s + sound_s, heard))
    return found


@pytest.mark.long
@pytest.mark.parametrize(
    ("offset_s", "yaw_deg"), [(0.0, 0.0), (0.234, 3.3), (-0.45, -8.1), (0.81, 0.0), (-0.05, 12.0)]
)
def test_offset_and_yaw_are_estimated_despite_reflections(offset_s, yaw_deg):
    found = align(passes(20, offset_s, yaw_deg))
    assert found.offset_s == pytest.approx(offset_s, abs=0.02)
    assert found.yaw_deg == pytest.approx(yaw_deg, abs=0.8)
    assert found.passes == 20
    assert 0.6 < found.agreeing < 0.85
    assert 1.0 < found.median_error_deg < 3.5


def test_intervals_contain_the_truth_and_narrow_with_passes():
    few, many = (align(passes(n, 0.2, 3.0)) for n in (6, 40))
    for found in (few, many):
        (low_s, high_s), (low_deg, high_deg) = found.offset_interval_s, found.yaw_interval_deg
        assert low_s - 0.005 <= 0.2 <= high_s + 0.005
        assert low_deg - 0.1 <= 3.0 <= high_deg + 0.1
    assert np.ptp(many.offset_interval_s) < np.ptp(few.offset_interval_s)
    assert np.ptp(many.yaw_interval_deg) < np.ptp(few.yaw_interval_deg)


@pytest.mark.parametrize(
    ("heard", "said"),
    [
        (passes(12, 0.1, 2.0, sides=(1,)), "12 from the left, 0 from"),
        (passes(12, 0.1, 2.0, sides=(-1,)), "0 from the left, 12"),
        (passes(4, 0.0, 0.0), "expected at least 5 vehicles .* got 4"),
        (passes(20, 0.0, 25.0, other=0.0), "at its edge: correct it by hand first"),
    ],
)
def test_passes_of_one_side_too_few_and_a_large_offset_raise_an_error(heard, said):
    with pytest.raises(InvalidArgumentError, match=said):
        align(heard)


PLACES = THREE.positions_m.tolist()
CAMERAS = [LENS | {"name": "front"}, LENS | {"name": "left", "yaw_deg": 60.0, "stamp_offset_s": 0.5}]


@pytest.fixture
def car(tmp_path):
    path = tmp_path / "car.json"
    path.write_text(json.dumps({"array": {"positions_m": PLACES}, "cameras": CAMERAS}))
    return path


def test_the_align_command_adds_offset_and_yaw_to_the_car_file(car, tmp_path, capsys, monkeypatch):
    sounds = [tmp_path / f"{number}.wav" for number in range(10)]
    for sound in sounds:
        soundfile.write(sound, np.random.default_rng(0).normal(0.0, 0.1, (9_000, 3)), 8_000)
    seen = iter(passes(10, 0.2, 3.0))
    monkeypatch.setattr(
        "worldstate.operations.alignment.camera_alignment.heard_passes", lambda source, margin_s: [next(seen)]
    )
    out = tmp_path / "aligned.json"
    words = ["array", "align", *map(str, sounds), "--car", str(car), "--camera", "left", "--out", str(out)]
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["recordings"], found["passes"]) == (10, 10)
    before, after = read_car(car), read_car(out)
    assert after.cameras["left"].stamp_offset_s == pytest.approx(0.5 + found["offset_s"], abs=1e-4)
    assert math.degrees(after.cameras["left"].yaw_rad) == pytest.approx(60.0 + found["yaw_deg"], abs=1e-3)
    assert after.cameras["front"] == before.cameras["front"]
    np.testing.assert_array_equal(after.array.positions_m, before.array.positions_m)


def test_the_array_file_must_exist_beside_the_new_car_file(tmp_path):
    (tmp_path / "mics.csv").write_text("\n".join(",".join(map(str, row)) for row in PLACES))
    (tmp_path / "elsewhere").mkdir()
    path = tmp_path / "car.json"
    path.write_text(json.dumps({"array": {"file": "mics.csv"}, "cameras": CAMERAS}))
    write_aligned(path, tmp_path / "new.json", None, 0.1, 2.0)
    assert read_car(tmp_path / "new.json").cameras["front"].stamp_offset_s == 0.1
    with pytest.raises(InputFileError, match=r"where mics.csv is"):
        write_aligned(path, tmp_path / "elsewhere" / "new.json", None, 0.1, 2.0)


def test_recordings_that_cannot_be_aligned_raise_an_error(tmp_path, capsys, refused):
    assert "nowhere: expected a data set" in refused(["array", "align", "nowhere"])
    assert main(["array", "align", str(tmp_path), "--out", str(tmp_path / "new.json")]) == 2
    assert "--out: expected --car with it" in capsys.readouterr().err


@pytest.mark.slow
def test_rendered_streets_give_the_true_offset_and_yaw(tmp_path):
    for site, seed in (("SA1", 3), ("SB2", 3)):
        words = ["--minutes", "4", "--site", site, "--traffic", "approaches", "--bandwidth", "2000"]
        assert main(["sim", "make", "--out", str(tmp_path), *words, "--seed", str(seed)]) == 0
    sources = [open_source(folder, uncalibrated=True) for folder in tmp_path.iterdir()]
    for offset_s, yaw_deg in ((0.0, 0.0), (0.3, 4.0)):
        heard = []
        for one in sources:
            camera = replace(one.camera, yaw_rad=-math.radians(yaw_deg))
            moved = replace(one, detections=one.detections.shifted(-offset_s), camera=camera)
            heard += heard_passes(moved, 1.0)
        found = align(heard)
        assert found.offset_s == pytest.approx(offset_s, abs=0.1)
        assert found.yaw_deg == pytest.approx(yaw_deg, abs=2.0)
