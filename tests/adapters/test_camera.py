"""The camera: round trips, mirror symmetry and OpenCV's projection."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.ground.values import wrap_angle

CAMERAS = st.builds(
    PinholeCamera.ovad,
    half_angle_rad=st.floats(0.1, 1.3),
    position_m=st.tuples(st.floats(-3, 3), st.floats(-1, 1), st.floats(-1, 1)),
    yaw_rad=st.floats(-math.pi, math.pi),
    pitch_rad=st.floats(-0.4, 0.4),
    roll_rad=st.floats(-0.3, 0.3),
    nominal_range_m=st.floats(5.0, 100.0),
)


def mirrored(camera: PinholeCamera) -> PinholeCamera:
    x, y, z = camera.position_m
    return replace(camera, position_m=(x, -y, z), yaw_rad=-camera.yaw_rad, roll_rad=-camera.roll_rad)


@given(camera=CAMERAS, share=st.floats(0.0, 1.0))
def test_column_and_back(camera: PinholeCamera, share: float) -> None:
    azimuth = camera.azimuth(share * camera.width_px)
    assert -math.pi < azimuth <= math.pi
    assert float(camera.column(azimuth)) == pytest.approx(share * camera.width_px, abs=1e-6 * camera.width_px)


@given(camera=CAMERAS, inside=st.floats(0.001, 0.999), outside=st.floats(0.01, 0.5))
def test_sees_between_its_edges(camera: PinholeCamera, inside: float, outside: float) -> None:
    width = camera.width_px
    assert camera.sees(camera.azimuth(inside * width))
    assert not camera.sees(camera.azimuth([-outside * width, (1 + outside) * width])).any()


@given(camera=CAMERAS, share=st.floats(0.0, 1.0))
def test_the_mirrored_camera_sees_the_mirrored_world(camera: PinholeCamera, share: float) -> None:
    there = float(mirrored(camera).azimuth((1.0 - share) * camera.width_px))
    assert wrap_angle(there + float(camera.azimuth(share * camera.width_px))) == pytest.approx(0.0, abs=1e-9)


@given(camera=CAMERAS, off_axis=st.floats(-1.2, 1.2))
def test_agrees_with_opencv(camera: PinholeCamera, off_axis: float) -> None:
    cv2 = pytest.importorskip("cv2")
    centre, bearing = np.array(camera.position_m), camera.yaw_rad + off_axis
    point = centre + camera.nominal_range_m * np.array([math.cos(bearing), math.sin(bearing), 0.0])
    focal = camera.width_px / 2 / math.tan(camera.half_angle_rad)
    matrix = np.array([[focal, 0, camera.width_px / 2], [0, focal, camera.height_px / 2], [0, 0, 1.0]])
    # Rows: right, down and forward. A positive roll raises the left side.
    angles_rad = camera.yaw_rad, -camera.pitch_rad, camera.roll_rad
    axes = Rotation.from_euler("ZYX", angles_rad).as_matrix()
    rotation = np.stack([-axes[:, 1], -axes[:, 2], axes[:, 0]])
    pixels, _ = cv2.projectPoints(
        point.reshape(1, 1, 3), cv2.Rodrigues(rotation)[0], -rotation @ centre, matrix, None
    )
    azimuth = math.atan2(point[1], point[0])
    assert float(camera.column(azimuth)) == pytest.approx(pixels[0, 0, 0], rel=1e-6, abs=1e-3)


def test_the_parallax_shift_is_computed() -> None:
    camera = PinholeCamera.ovad()
    for azimuth_deg, shift_deg in ((30.0, 1.5), (-30.0, 1.8)):
        shift = abs(azimuth_deg - math.degrees(camera.off_axis(math.radians(azimuth_deg))))
        assert shift == pytest.approx(shift_deg, abs=0.05)


def test_behind_the_camera_is_in_no_column() -> None:
    assert np.isnan(PinholeCamera.ovad().column([math.pi, 2.0, -2.0])).all()
    rear = PinholeCamera.ovad(yaw_rad=math.pi, position_m=(0.0, 0.0, 0.0))
    assert float(rear.column(math.pi)) == pytest.approx(968)


@given(left=st.floats(0.0, 1800.0), width=st.floats(1.0, 130.0))
def test_a_sighting_is_between_the_edges_of_its_box(left: float, width: float) -> None:
    camera = PinholeCamera.ovad()
    seen = camera.sighting((left, 400, left + width, 700), "car", 0.9)
    assert camera.azimuth(left + width) < seen.azimuth_rad < camera.azimuth(left)
    assert seen.width_rad == pytest.approx(float(camera.azimuth(left) - camera.azimuth(left + width)))
    assert seen.std_rad >= seen.width_rad / math.sqrt(12)


def test_an_unknown_range_widens_a_sighting() -> None:
    box = (100, 400, 200, 700)
    known, unknown = (PinholeCamera.ovad(range_spread=s).sighting(box, "car", 0.9) for s in (0.0, 1.0))
    assert known.std_rad == pytest.approx(known.width_rad / math.sqrt(12))
    shift = unknown.azimuth_rad - float(PinholeCamera.ovad().off_axis(unknown.azimuth_rad))
    assert unknown.std_rad == pytest.approx(math.hypot(known.std_rad, shift))
