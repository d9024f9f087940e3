"""When the camera sees the vehicles of a stream, and what its detector makes of them."""

from collections.abc import Sequence

import numpy as np

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.datasets.ovad_layout import FRAME_RATE_HZ
from worldstate.ground.typing import FloatArray
from worldstate.simulation.camera.simulated_detector import (
    Frame,
    SimulatedDetection,
    detect,
    line_of_sight,
    lost,
    park,
)
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.route import EgoMotion

from .arrivals import STANDING, SoundEvent, VehicleEvent
from .settings import StreamSettings

CLOCK_S = 0.01  # resolution of the first line of sight
PARKED_SHARE = 0.3  # of the streams have a car at the far kerb, as recordings do
# A box is reported once the vehicle is this far ahead: nearer, it fills the image from edge to edge.
NEAREST_BOX_M = 3.0
# Boxes that are nothing, one to three images long; most scores lie below what the readers of a detector keep
# (.75). The rate is an assumption: a good detector in daylight, about one such box a minute.
CLUTTER_PER_HOUR, CLUTTER_IMAGES, CLUTTER_SCORE = 60.0, (1, 3), (0.3, 0.9)
CLUTTER_WIDTH_PX, CLUTTER_SHAPE = (60.0, 400.0), (0.4, 1.0)


def visible_s(event: VehicleEvent, site: Site, ego: EgoMotion = STANDING) -> float | None:
    """Time of the stream at which a vehicle first comes into view; None where it never does."""
    clock = np.arange(0.0, event.manoeuvre.motion.duration_s, CLOCK_S)
    path, ego_x = event.manoeuvre.motion.trajectory(clock), ego.x_m(event.start_s + clock)
    seen = line_of_sight(path, site, PinholeCamera(), ego_x)
    return round(event.start_s + float(clock[seen.argmax()]), 6) if seen.any() else None


def detected_frames(
    settings: StreamSettings,
    events: Sequence[VehicleEvent],
    sounds: Sequence[SoundEvent],
    rng: np.random.Generator,
) -> list[Frame]:
    """Boxes of a whole stream: vehicles with misses, a parked car in some, clutter; rain takes some."""
    camera, to_park, to_clutter, to_vehicles, to_rain = PinholeCamera(), *rng.spawn(4)
    count = max(round(settings.duration_s * FRAME_RATE_HZ), 1)
    frames: list[Frame] = [()] * count
    if to_park.random() < PARKED_SHARE:
        frames = park(settings.site, camera, count, to_park)
    for event, draws in zip(events, to_vehicles.spawn(len(events)), strict=True):
        _add_boxes(frames, event, settings.site, draws)
    _add_clutter(frames, to_clutter)
    return lost(frames, _soiled(sounds, count), to_rain)


def _add_boxes(frames: list[Frame], event: VehicleEvent, site: Site, rng: np.random.Generator) -> None:
    first, last = (int(np.ceil(time_s * FRAME_RATE_HZ)) for time_s in (event.start_s, event.end_s))
    numbers = np.arange(max(first, 0), min(last, len(frames)))
    path = event.manoeuvre.motion.trajectory(numbers / FRAME_RATE_HZ - event.start_s)
    # What is beside or behind the camera has no picture in it.
    ahead = path.behind(0.0)[0] > NEAREST_BOX_M
    boxes = detect(path.at(path.time_s[ahead]), site, PinholeCamera(), rng)
    for number, seen in zip(numbers[ahead].tolist(), boxes, strict=True):
        frames[number] += seen


def _soiled(sounds: Sequence[SoundEvent], count: int) -> FloatArray:
    """Share of the boxes that drops on the lens take, shape (count,)."""
    missed, time = np.zeros(count), np.arange(count) / FRAME_RATE_HZ
    for one in sounds:
        # A lens dries when the rain is over; how long that takes is not modelled.
        raining = (time >= one.start_s + one.sound.start_s) & (time < one.end_s)
        missed = np.maximum(missed, one.sound.lens_missed * raining)
    return missed


def _add_clutter(frames: list[Frame], rng: np.random.Generator) -> None:
    camera = PinholeCamera()
    for _ in range(rng.poisson(CLUTTER_PER_HOUR * len(frames) / FRAME_RATE_HZ / 3600.0)):
        first = int(rng.integers(len(frames)))
        width = rng.uniform(*CLUTTER_WIDTH_PX)
        height = width * rng.uniform(*CLUTTER_SHAPE)
        left = rng.uniform(0.0, camera.width_px - width)
        # About the horizon, where a detector that knows streets looks for vehicles.
        top = rng.uniform(0.3, 0.7) * (camera.height_px - height)
        left, top, right, bottom = (round(float(v), 1) for v in (left, top, left + width, top + height))
        box = SimulatedDetection((left, top, right, bottom), round(float(rng.uniform(*CLUTTER_SCORE)), 4))
        images = int(rng.integers(*CLUTTER_IMAGES, endpoint=True))
        for number in range(first, min(first + images, len(frames))):
            frames[number] += (box,)
