"""Ground truth of a stream: every vehicle at every tenth of a second."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from worldstate.adapters.datasets.ovad import FRAME_RATE_HZ
from worldstate.ground import BoolArray, FloatArray
from worldstate.simulation.camera import simulated_detector as detector
from worldstate.simulation.dataset.recording import SCHEMA, SCHEMA_VERSION
from worldstate.simulation.scene.driving import CAMERA
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.vehicle import EgoMotion

from .arrivals import STANDING, SoundEvent, VehicleEvent
from .rendering import row_times
from .settings import HAZARDS, StreamSettings

CLOCK_S = 0.01  # Resolution of the first line of sight
PARKED_SHARE = 0.3  # Share of the streams with a parked car at the far kerb, as in recordings
# A box is reported from this distance ahead; a nearer vehicle fills the whole image.
NEAREST_BOX_M = 3.0
# False boxes, one to three images long; most scores are below the threshold of a detector's users (0.75). The
# rate is assumed: a good detector in daylight, about one such box per minute.
CLUTTER_PER_HOUR, CLUTTER_IMAGES, CLUTTER_SCORE = 60.0, (1, 3), (0.3, 0.9)
CLUTTER_WIDTH_PX, CLUTTER_SHAPE = (60.0, 400.0), (0.4, 1.0)


def visible_s(event: VehicleEvent, site: Site, ego: EgoMotion = STANDING) -> float | None:
    """Return the time at which a vehicle first comes into view; None if it never does."""
    clock = np.arange(0.0, event.manoeuvre.motion.duration_s, CLOCK_S)
    path, ego_x = event.manoeuvre.motion.trajectory(clock), ego.x_m(event.start_s + clock)
    seen = detector.line_of_sight(path, site, ego_x)
    return round(event.start_s + float(clock[seen.argmax()]), 6) if seen.any() else None


def detected_frames(
    settings: StreamSettings,
    events: Sequence[VehicleEvent],
    sounds: Sequence[SoundEvent],
    rng: np.random.Generator,
) -> list[detector.Frame]:
    """Return boxes of a whole stream: vehicles with misses, some parked cars, clutter; rain removes some."""
    to_park, to_clutter, to_vehicles, to_rain = rng.spawn(4)
    count = max(round(settings.duration_s * FRAME_RATE_HZ), 1)
    frames: list[detector.Frame] = [()] * count
    if to_park.random() < PARKED_SHARE:
        frames = detector.park(settings.site, count, to_park)
    for event, draws in zip(events, to_vehicles.spawn(len(events)), strict=True):
        _add_boxes(frames, event, settings.site, draws)
    _add_clutter(frames, to_clutter)
    showers = ((one.start_s + one.sound.start_s, one.end_s, one.sound.lens_missed) for one in sounds)
    return detector.through_rain(frames, showers, to_rain)


def _add_boxes(
    frames: list[detector.Frame], event: VehicleEvent, site: Site, rng: np.random.Generator
) -> None:
    first, last = (int(np.ceil(time_s * FRAME_RATE_HZ)) for time_s in (event.start_s, event.end_s))
    numbers = np.arange(max(first, 0), min(last, len(frames)))
    path = event.manoeuvre.motion.trajectory(numbers / FRAME_RATE_HZ - event.start_s)
    # Objects beside or behind the camera are not in the image.
    ahead = path.behind(0.0)[0] > NEAREST_BOX_M
    boxes = detector.detect(path.at(path.time_s[ahead]), site, rng)
    for number, seen in zip(numbers[ahead].tolist(), boxes, strict=True):
        frames[number] += seen


def _add_clutter(frames: list[detector.Frame], rng: np.random.Generator) -> None:
    for _ in range(rng.poisson(CLUTTER_PER_HOUR * len(frames) / FRAME_RATE_HZ / 3600.0)):
        first = int(rng.integers(len(frames)))
        width = rng.uniform(*CLUTTER_WIDTH_PX)
        height = width * rng.uniform(*CLUTTER_SHAPE)
        left = rng.uniform(0.0, CAMERA.width_px - width)
        # False boxes are near the horizon, like the vehicles that a detector reports.
        top = rng.uniform(0.3, 0.7) * (CAMERA.height_px - height)
        left, top, right, bottom = (round(float(v), 1) for v in (left, top, left + width, top + height))
        score = round(float(rng.uniform(*CLUTTER_SCORE)), 4)
        box = detector.SimulatedDetection((left, top, right, bottom), score)
        images = int(rng.integers(*CLUTTER_IMAGES, endpoint=True))
        for number in range(first, min(first + images, len(frames))):
            frames[number] += (box,)


COLUMNS = (
    "time_s", "vehicle", "x_m", "y_m", "speed_mps", "in_view", "time_to_visible_s", "loudness_db",
)  # fmt: skip
FOLLOWS = "follows"
EVENTS_NAME, ROWS_NAME = "events.json", "vehicles.csv"


@dataclass(frozen=True, slots=True, eq=False)
class VehicleTruth:
    """One vehicle of a stream and its rows."""

    number: int
    event: VehicleEvent
    t0_s: float | None  # First line of sight; None if it never comes into view
    time_s: FloatArray  # shape (R,): Tenths of a second of the stream
    x_m: FloatArray  # shape (R,): Front bumper, ahead of the array
    y_m: FloatArray  # shape (R,): Front bumper, left
    axle_rad: FloatArray  # shape (R,): Azimuth of the front axle
    axle_m: FloatArray  # shape (R,): Distance of the front axle
    speed_mps: FloatArray  # shape (R,)
    in_view: BoolArray  # shape (R,)

    @property
    def hazard(self) -> bool:
        """Whether the vehicle comes out of a hidden arm."""
        return self.event.flow in (*HAZARDS, FOLLOWS)

    def time_to_visible_s(self) -> list[float | None]:
        """Time until the first line of sight at every row, negative afterwards; None if it never comes."""
        if self.t0_s is None:
            return [None] * len(self.time_s)
        return [round(self.t0_s - time_s, 3) for time_s in self.time_s.tolist()]


def vehicle_truth(number: int, event: VehicleEvent, settings: StreamSettings) -> VehicleTruth:
    """Return the positions of a vehicle at its rows, and when it is in view."""
    rows = row_times(event, settings)
    path = event.manoeuvre.motion.trajectory(rows - event.start_s)
    x, y = path.behind(0.0)
    axle_x, axle_y = path.behind(path.kind.axles_m[0])
    ego_x = settings.ego.x_m(rows)
    return VehicleTruth(
        number=number,
        event=event,
        t0_s=visible_s(event, settings.site, settings.ego),
        time_s=rows.round(1),
        x_m=x - ego_x,
        y_m=y,
        axle_rad=np.arctan2(axle_y, axle_x - ego_x),
        axle_m=np.hypot(axle_x - ego_x, axle_y),
        speed_mps=path.speed_mps,
        in_view=detector.line_of_sight(path, settings.site, ego_x),
    )


def describe_events(
    vehicles: Sequence[VehicleTruth], sounds: Sequence[SoundEvent], loudness_db: Mapping[int, FloatArray]
) -> dict[str, list[dict[str, Any]]]:
    """Return `events.json`: one entry per vehicle and per other sound."""
    told = [
        {
            "vehicle": one.number,
            "flow": one.event.flow,
            "kind": one.event.manoeuvre.motion.kind.name,
            "signal": one.event.signal or None,
            "arm": one.event.manoeuvre.arm,
            "hazard": one.hazard,
            "t0_s": one.t0_s,
            "first_s": round(one.event.start_s, 3),
            "last_s": round(one.event.end_s, 3),
        }
        for one in vehicles
    ]
    others = [
        {
            "kind": one.sound.kind,
            "place_m": list(one.sound.place_m) if one.sound.has_place else None,
            "first_s": round(one.start_s + one.sound.start_s, 3),
            "last_s": round(one.start_s + one.sound.end_s, 3),
            "loudness_db": round(float(levels[0].max()), 1) if levels.size else None,
        }
        for number, one in enumerate(sounds, start=len(vehicles))
        for levels in [loudness_db[number]]
    ]
    return {"vehicles": told, "sounds": others}


def describe_stream(settings: StreamSettings, vehicles: Sequence[VehicleTruth]) -> dict[str, Any]:
    """Return a stream in the form of a recording's truth: the rows of its vehicles over their times."""
    # Code that reads a recording's truth draws and scores tracks; `entry_s` is the first T0 of all vehicles.
    tracks = [_frames(one) for one in vehicles if len(one.time_s)]
    frames = max(round(settings.duration_s * FRAME_RATE_HZ), 1)
    return {
        "schema": SCHEMA,
        "version": SCHEMA_VERSION,
        "settings": asdict(settings),
        "frame_rate_hz": FRAME_RATE_HZ,
        "entry_s": min((one.t0_s for one in vehicles if one.t0_s is not None), default=None),
        "frames": tracks[0] if tracks else [],
        "others": tracks[1:],
        "ego": {"x_m": [0.0] * frames, "speed_mps": [0.0] * frames},
    }


def _frames(one: VehicleTruth) -> list[dict[str, Any]]:
    columns = {
        "time_s": one.time_s,
        "speed_mps": one.speed_mps,
        "azimuth_rad": one.axle_rad,
        "range_m": one.axle_m,
    }
    return [
        {name: round(float(values[i]), 3) for name, values in columns.items()}
        | {"time_to_visible_s": left}
        | {"position_m": [round(float(one.x_m[i]), 3), round(float(one.y_m[i]), 3)]}
        | {"line_of_sight": bool(one.in_view[i])}
        for i, left in enumerate(one.time_to_visible_s())
    ]


def truth_rows(
    vehicles: Sequence[VehicleTruth], loudness_db: Mapping[int, FloatArray]
) -> Iterator[list[object]]:
    """Yield the rows of `vehicles.csv`: one per vehicle and tenth of a second; None is an empty cell."""
    for one in vehicles:
        places = np.column_stack([one.x_m, one.y_m, one.speed_mps]).round(2).tolist()
        loudness, seen = loudness_db[one.number][0].round(1).tolist(), one.in_view.astype(int).tolist()
        for row in zip(one.time_s.tolist(), places, seen, one.time_to_visible_s(), loudness, strict=True):
            yield [row[0], one.number, *row[1], *row[2:]]
