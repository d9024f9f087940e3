"""Boxes of vehicles that appear behind a corner in a simulated camera."""

import math

import numpy as np

from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog
from worldstate.adapters.camera.pinhole import PinholeCamera

CAMERA = PinholeCamera.ovad(position_m=(0.0, 0.0, 0.0), pitch_rad=0.0)
FOCAL_PX = 0.5 * CAMERA.width_px / math.tan(CAMERA.half_angle_rad)
LANE_M, EDGE_RAD, WIDTH_M, HEIGHT_M, LENGTH_M = 9.0, math.radians(28.0), 1.8, 1.55, 4.5


def box_of(front_m: float, side: int) -> list[float] | None:
    """Return the box of a car with its front at y = side * front_m, cut by the corner."""
    limit = math.tan(EDGE_RAD)
    slopes = []
    for x in (LANE_M - 0.5 * WIDTH_M, LANE_M + 0.5 * WIDTH_M):
        slopes += [min(y / x, limit) for y in (front_m, front_m + LENGTH_M) if front_m / x < limit]
    if not slopes or front_m / LANE_M > limit:
        return None
    columns = [0.5 * CAMERA.width_px - FOCAL_PX * side * slope for slope in (min(slopes), max(slopes))]
    height = FOCAL_PX * HEIGHT_M / (LANE_M - 0.5 * WIDTH_M)
    return [*sorted(np.clip(columns, 0.0, CAMERA.width_px)), 600.0, 600.0 + height]


def passing(starts_s: list[tuple[float, int]], speed: float, rng: np.random.Generator) -> DetectionLog:
    """Return 10 images per second of vehicles that start 20 m beside the axis."""
    frames = []
    for image in range(round(10.0 * (max(start for start, _ in starts_s) + 12.0))):
        boxes = []
        for start, side in starts_s:
            found = box_of(20.0 - speed * (0.1 * image - start), side)
            if found is not None and found[0] < found[1] - 30.0 and rng.random() > 0.1:
                left, right, top, bottom = np.array(found) + rng.normal(0.0, 2.0, 4)
                boxes.append([left, top, right, bottom])
        pixels = np.array(boxes).reshape(-1, 4)
        frames.append(DetectionFrame(pixels, np.full(len(boxes), 0.9), ("car",) * len(boxes)))
    return DetectionLog.at_rate(frames, 10.0)
