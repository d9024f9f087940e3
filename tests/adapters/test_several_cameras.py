"""Several cameras as one channel: the joint miss rate against a sum over azimuths."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate import NotUsable, Present, Unqueried
from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.vision_query import SeveralCameras, VisionQuery
from worldstate.measurement import Bearing

NOW, COARSE = 1_000_000_000, NotUsable("coarse")
EMPTY = DetectionFrame(np.empty((0, 4)), np.empty(0), ())
CAR = DetectionFrame(np.array([[300.0, 100.0, 340.0, 300.0]]), np.array([0.9]), ("car",))


def camera(yaw_deg, half_deg=45.0, frame=EMPTY):
    lens = PinholeCamera(640, 480, math.radians(half_deg), (0.0, 0.0, 0.0), math.radians(yaw_deg), 0.0)
    return VisionQuery(lens, DetectionLog((frame,), np.array([NOW])))


def fine_miss_rate(cameras, centre_rad, half_rad):
    """Return the mean over a fine grid of the product of the miss rates."""
    grid = centre_rad + half_rad * (2.0 * np.arange(4000) + 1.0 - 4000) / 4000
    missed = np.ones_like(grid)
    for one in cameras:
        rate = np.mean([one.miss_rate.over(one.camera.off_axis(grid), 0.0, label)
                        for label in one.keep.labels], axis=0)  # fmt: skip
        missed *= np.where(one.camera.sees(grid), rate, 1.0)
    return missed.mean()


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-120, 120), min_size=2, max_size=4), st.floats(-1.2, 1.2))
def test_the_joint_miss_rate_is_the_mean_over_azimuths(yaws_deg, azimuth_rad):
    cameras = [camera(yaw) for yaw in yaws_deg]
    asked = SeveralCameras({str(i): one for i, one in enumerate(cameras)})
    said = asked.ask(NOW, Bearing(azimuth_rad, 0.05))
    expected = fine_miss_rate(cameras, azimuth_rad, math.radians(10.0))
    if isinstance(said, Unqueried):
        assert expected == 1.0
    else:
        assert said.miss_rate == pytest.approx(expected, abs=0.004)


def test_a_side_that_two_cameras_share_is_searched_by_both():
    front, left = camera(0.0), camera(80.0)
    both = SeveralCameras({"front": front, "left": left})
    alone = [one.ask(NOW, COARSE, None, "left").miss_rate for one in (front, left)]
    assert both.ask(NOW, COARSE, None, "left").miss_rate < 0.5 * min(alone)
    # The right side is outside the view of the left camera.
    assert both.ask(NOW, COARSE, None, "right") == front.ask(NOW, COARSE, None, "right")


def test_a_detection_of_one_camera_is_present():
    both = SeveralCameras({"front": camera(0.0), "left": camera(60.0, frame=CAR)})
    assert isinstance(both.ask(NOW, Bearing(1.05, 0.05)), Present)
    looks = both.looks(NOW)
    assert [(one.look.sensor, len(one.sightings)) for one in looks] == [("front", 0), ("left", 1)]
    assert looks[1].look.sector_rad == pytest.approx((math.radians(15.0), math.radians(105.0)))
    assert looks[1].sightings[0].azimuth_rad == pytest.approx(math.radians(60.0))


def test_a_camera_without_an_image_does_not_block_others():
    blind = VisionQuery(PinholeCamera.ovad(), DetectionLog((EMPTY,), np.array([0])))
    both = SeveralCameras({"front": blind, "left": camera(60.0, frame=CAR)})
    assert both.last_look(NOW).sensor == "left" and len(both.sightings(NOW)) == 1
    assert isinstance(SeveralCameras({"front": blind}).ask(NOW, COARSE), Unqueried)
