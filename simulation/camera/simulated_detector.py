"""Simulated detector: boxes of vehicles in line of sight, with small errors and misses."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from worldstate.adapters.datasets.ovad import FRAME_RATE_HZ
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.simulation.scene.driving import CAMERA, camera_sees
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.kinds import LIGHT, VehicleKind
from worldstate.simulation.scene.vehicle import ARRAY_HEIGHT_M, LENGTH_M, WIDTH_M, Trajectory

LEAST_VISIBLE = 0.2  # Visible share of the vehicle's length that a detector needs
# Miss rates measured in the paper: 4 % at boresight, 14 % at 20-30 deg.
MISS_AZIMUTH_DEG = (0.0, 10.0, 25.0)
MISS_RATE = (0.04, 0.04, 0.14)
BOX_NOISE_PX = 3.0
PARKED_NOISE_PX = 0.4


@dataclass(frozen=True, slots=True)
class SimulatedDetection:
    """One box: left, top, right, bottom in pixels, a score in [0, 1] and a class name."""

    box_px: tuple[float, float, float, float]
    score: float
    label: str = "car"


Frame = tuple[SimulatedDetection, ...]


def line_of_sight(trajectory: Trajectory, site: Site, ego_x_m: float | FloatArray = 0.0) -> BoolArray:
    """Return when the middle of the vehicle's front is in view, shape (T,)."""
    return camera_sees(site, *trajectory.behind(0.0), ego_x_m)


def detect(trajectory: Trajectory, site: Site, rng: np.random.Generator) -> list[Frame]:
    """Return boxes of a passing vehicle, one tuple per frame of `trajectory`."""
    ahead, _ = trajectory.behind(0.0)
    # The lateral limits of the visible part, which is empty if right > left.
    right, left = trajectory.footprint_y_m()
    right_limit, left_limit = site.sights_m(ahead, CAMERA.position_m[:2])
    visible = np.maximum(right, right_limit), np.minimum(left, left_limit)
    seen, kind = line_of_sight(trajectory, site), trajectory.kind
    frames: list[Frame] = []
    for x, low, high, sight in zip(ahead, *visible, seen, strict=True):
        share = (high - low) / min(kind.length_m, LENGTH_M)
        clear = share > LEAST_VISIBLE and (sight or not site.is_open)
        box = project(site, x, (low, high), kind) if clear else None
        missed = rng.random() < miss_rate(x, 0.5 * (low + high))
        jitter, luck = rng.normal(0.0, BOX_NOISE_PX, 4), rng.normal(0.95, 0.03)
        if box is None or missed:
            frames.append(())
        else:
            score = float(np.clip(luck * (0.75 + 0.25 * min(share, 1.0)), 0.3, 0.999))
            frames.append((SimulatedDetection(inside(box + jitter), round(score, 4), kind.label),))
    return frames


def park(site: Site, frames: int, rng: np.random.Generator) -> list[Frame]:
    """Return boxes of a car that is parked at the far kerb for the whole recording."""
    x = site.far_kerb_m - 0.5 * WIDTH_M
    right, left = site.sight_m(x, CAMERA.position_m[:2])
    middle = rng.uniform(0.6 * right, 0.6 * left)
    low, high = max(middle - LENGTH_M / 2.0, right), min(middle + LENGTH_M / 2.0, left)
    box = project(site, x, (low, high))
    if box is None:
        return [()] * frames
    noise = rng.normal(0.0, PARKED_NOISE_PX, (frames, 4))
    scores = np.clip(rng.normal(0.92, 0.02, frames), 0.3, 0.999).round(4)
    boxes = (inside(box + one) for one in noise)
    return [(SimulatedDetection(*seen),) for seen in zip(boxes, scores.tolist(), strict=True)]


def through_rain(
    frames: Sequence[Frame], showers: Iterable[tuple[float, float, float]], rng: np.random.Generator
) -> list[Frame]:
    """Remove boxes at random while the lens is wet; a shower is (start, end, share of lost boxes)."""
    missed, time = np.zeros(len(frames)), np.arange(len(frames)) / FRAME_RATE_HZ
    for begin_s, end_s, share in showers:
        # The lens is dry when the rain ends; drying is not modelled.
        missed = np.maximum(missed, share * ((time >= begin_s) & (time < end_s)))
    return [
        tuple(box for box in frame if rng.random() >= share)
        for frame, share in zip(frames, missed, strict=True)
    ]


def to_json(frames: list[Frame]) -> dict[str, Any]:
    """Return the detections under the keys of OVAD's `camera_baseline_results.json`."""
    rows = [
        {
            "boxes": [list(seen.box_px) for seen in frame],
            "scores": [seen.score for seen in frame],
            "classes_str": [seen.label for seen in frame],
        }
        for frame in frames
    ]
    return {"detections_per_frame": rows}


def miss_rate(ahead_m: float, lateral_m: float) -> float:
    """Return the miss rate of a vehicle at a position, by its azimuth."""
    azimuth_deg = abs(math.degrees(math.atan2(lateral_m, ahead_m)))
    return float(np.interp(azimuth_deg, MISS_AZIMUTH_DEG, MISS_RATE))


def project(
    site: Site, middle_x: float, ends_y: tuple[float, float], kind: VehicleKind = LIGHT
) -> FloatArray | None:
    """Return the box (left, top, right, bottom) of the visible cuboid; None if it is outside the image."""
    camera, pitch = CAMERA, CAMERA.pitch_rad
    x = middle_x + kind.width_m * np.array([-0.5, 0.5])
    z = np.array([0.0, kind.height_m]) - ARRAY_HEIGHT_M
    # A corner hides more of the near face than of the far one.
    right, left = site.sights_m(x, camera.position_m[:2])
    y = np.clip(np.array(ends_y)[:, None], np.minimum(right, left), left)
    places = np.broadcast_arrays(x, y, z[:, None, None])
    corners = np.stack([*map(np.ravel, places)], axis=1) - camera.position_m
    depth = corners[:, 0] * math.cos(pitch) + corners[:, 2] * math.sin(pitch)
    up = corners[:, 2] * math.cos(pitch) - corners[:, 0] * math.sin(pitch)
    focal = 0.5 * camera.width_px / math.tan(camera.half_angle_rad)
    column = 0.5 * camera.width_px - focal * corners[:, 1] / depth
    row = 0.5 * camera.height_px - focal * up / depth
    box = np.array([column.min(), row.min(), column.max(), row.max()])
    outside = box[2] < 0 or box[0] > camera.width_px or box[3] < 0 or box[1] > camera.height_px
    return None if outside else box


def inside(box: FloatArray) -> tuple[float, float, float, float]:
    """Clip to the image, keep at least one pixel, round to tenths."""
    x = np.clip(box[[0, 2]], 0.0, CAMERA.width_px - 1.0)
    y = np.clip(box[[1, 3]], 0.0, CAMERA.height_px - 1.0)
    left, top, right, bottom = (round(float(v), 1) for v in (x[0], y[0], x[1], y[1]))
    return left, top, max(right, left + 1.0), max(bottom, top + 1.0)
