"""Errors of adapters for wrong arguments: one row per error. Damaged files have their own tests."""

import io
import math
from collections.abc import Callable

import numpy as np
import pytest

from worldstate import Listener
from worldstate.adapters import ListenSettings, PinholeCamera
from worldstate.adapters.audio.sound_file import RawPcm
from worldstate.adapters.camera.camera_health import (
    CameraHealth,
    DegradationLog,
    degrade,
    image_quality,
    learn_health,
)
from worldstate.adapters.camera.detections import DetectionFilter, DetectionFrame, DetectionLog
from worldstate.adapters.listener import listen_steps
from worldstate.adapters.live.live_sensors import DetectionSocket
from worldstate.adapters.live.live_sound import BoundedChannel
from worldstate.adapters.source import open_source
from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.ground.errors import WorldstateError
from worldstate.ground.values import nanoseconds

EMPTY, GREY = DetectionFrame(np.empty((0, 4)), np.empty(0), ()), np.full((40, 60, 3), 90, np.uint8)
RNG = np.random.default_rng(0)


def camera(**setting):
    return lambda: PinholeCamera.ovad(**setting)


def degraded(frame=GREY, family="blur", level=0.5):
    return lambda: degrade(frame, family, level, RNG)


def look(stamp_ns, frame=EMPTY):
    return lambda: Listener(ovad_array(), 48_000).look(stamp_ns, frame)


def heard_at(rate):
    noise = RNG.uniform(-0.1, 0.1, (2 * rate, 56)).astype("<f4")
    pipe = RawPcm(io.BytesIO(noise.tobytes()), rate, 56, "f32")
    return lambda: list(listen_steps(open_source(pipe, array=ovad_array())))


REFUSALS: dict[str, tuple[Callable[[], object], str]] = {
    "camera with a view of zero": (camera(half_angle_rad=0.0), "half_angle_rad"),
    "camera with a view of 180 degrees": (camera(half_angle_rad=1.6), "half_angle_rad"),
    "camera without columns": (camera(width_px=0), "width_px"),
    "camera with a nominal range of 0.5 m": (camera(nominal_range_m=0.5), "nominal_range_m"),
    "camera that looks up": (camera(pitch_rad=2.0), "pitch_rad"),
    "camera with a yaw that is no number": (camera(yaw_rad=math.nan), "yaw_rad"),
    "camera with two coordinates": (camera(position_m=(0.0, 0.0)), "position_m"),
    "box outside of the image": (
        lambda: PinholeCamera.ovad().sighting((2000, 0, 2100, 200), "car", 0.9),
        "1936",
    ),
    "filter with a score above one": (lambda: DetectionFilter(min_score=1.5), "min_score"),
    "filter with a negative height": (lambda: DetectionFilter(min_height_px=-1.0), "min_height_px"),
    "two stamps for one image": (lambda: DetectionLog((EMPTY,), np.array([1, 2])), "one per frame"),
    "health of no images": (lambda: learn_health([], RNG), "image"),
    "health with sharpness that rises": (
        lambda: CameraHealth(100.0, (1.0, 2.0, 1.0, 1.0, 1.0), (0.0,) * 5),
        "sharpness",
    ),
    "degradation with one stamp twice": (
        lambda: DegradationLog(np.array([0, 0]), np.array([0.0, 0.0])),
        "stamps",
    ),
    "quality of an image without colours": (lambda: image_quality(np.zeros((4, 4), np.uint8)), ""),
    "degraded image of floats": (degraded(GREY / 2), ""),
    "degradation by fog": (degraded(family="fog"), ""),
    "degradation above one": (degraded(level=1.5), ""),
    **{f"look at {stamp!r}": (look(stamp), "stamp_ns") for stamp in (None, "0", 1.5e9, math.nan, 10**40)},
    "look without an image": (look(0, None), "look: expected a DetectionFrame"),
    "measurement of None": (lambda: Listener(ovad_array(), 48_000).add(None), "add: expected Measurement"),
    "forgetting time of zero": (lambda: ListenSettings(forgetting_s=0.0), "forgetting_s"),
    "channel of no items": (lambda: BoundedChannel(0), "capacity"),
    **{
        f"address {one}": (lambda one=one: DetectionSocket(one, nanoseconds), "expected HOST:PORT")
        for one in ("9100", "127.0.0.1:x", "127.0.0.1:70000")
    },
    **{
        f"sound at {rate} Hz": (heard_at(rate), f"at least 6000 Hz, got {rate} Hz") for rate in (3_000, 5_800)
    },
}


@pytest.mark.parametrize(("call", "words"), REFUSALS.values(), ids=REFUSALS)
def test_refuses(call, words):
    with pytest.raises(WorldstateError, match=words):
        call()
