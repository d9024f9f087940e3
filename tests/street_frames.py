"""Rendered frames of a street with texture, a road and a passing car."""

import numpy as np
from scipy.ndimage import gaussian_filter, zoom

from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog

WIDTH, HEIGHT = 640, 400


def background(seed=0, level=110.0):
    """Return walls, windows and a road with edges at every scale."""
    rng = np.random.default_rng(seed)
    scene = np.full((HEIGHT, WIDTH), level)
    for size in (4, 10, 25, 60):
        rows, columns = HEIGHT // size + 2, WIDTH // size + 2
        blocks = zoom(rng.normal(size=(rows, columns)), size, order=0)[:HEIGHT, :WIDTH]
        scene += blocks * (6.0 + size / 5.0)
    scene[260:] = 0.3 * scene[260:] + 0.7 * 90.0
    return gaussian_filter(scene, 0.6)


def car_box(frame, speed_px=12.0, start_px=-60.0):
    """Return left, top, right, bottom of the car in a frame, clipped, or None out of view."""
    left = start_px + speed_px * frame
    box = np.array([max(left, 0.0), 210.0, min(left + 130.0, WIDTH), 300.0])
    return None if box[2] - box[0] < 60.0 else box


def street(frames=60, seed=0, car=True, speed_px=12.0):
    """Yield frames with light sensor noise."""
    rng, scene = np.random.default_rng(seed + 1), background(seed)
    body = gaussian_filter(rng.normal(size=(90, 130)), 3.0) * 120.0 + 190.0
    body[55:, 15:40] = body[55:, 90:115] = 30.0
    for number in range(frames):
        image = scene.copy()
        box = car_box(number, speed_px) if car else None
        if box is not None:
            left, top, right, bottom = box.astype(int)
            image[top:bottom, left:right] = body[:, : right - left]
        image = image[:, :, None] + rng.normal(0.0, 2.0, (HEIGHT, WIDTH, 3))
        yield np.clip(image, 0, 255).astype(np.uint8)


def reference(frames=60, speed_px=12.0):
    """Return the boxes of the car as a detection log at 10 Hz."""
    boxes = [car_box(number, speed_px) for number in range(frames)]
    rows = [np.empty((0, 4)) if box is None else box[None] for box in boxes]
    found = [DetectionFrame(row, np.ones(len(row)), ("car",) * len(row)) for row in rows]
    return DetectionLog.at_rate(found, frame_rate_hz=10.0)
