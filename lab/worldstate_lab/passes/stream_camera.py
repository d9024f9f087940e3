"""What a camera would have reported of a stream of which only the truth was kept: boxes frame by frame."""

from dataclasses import replace

import numpy as np

from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.commissioning.heard_stream import HeardStream, junction_named
from worldstate.ground.typing import FloatArray
from worldstate.operations.metrics.approach_table import AFTER_S
from worldstate.simulation.camera.simulated_detector import BOX_NOISE_PX, inside, miss_rate, project
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.kinds import VehicleKind, vehicle_kind

FRAME_S = 0.1
_STILL_M = 1e-3  # Of a tenth of a second: slower ones keep their heading


def stream_detections(heard: HeardStream, rng: np.random.Generator) -> DetectionLog:
    """Return the boxes of everybody in view, missed as often as the paper's detector misses them."""
    camera, site = PinholeCamera(), junction_named(heard.site)
    frames: dict[int, list[tuple[FloatArray, float, str]]] = {}
    kinds = dict(zip(heard.vehicles.vehicle.tolist(), heard.vehicles.kind.tolist(), strict=True))
    for number, name in kinds.items():
        kind, mine = vehicle_kind(name), heard.rows.vehicle == number
        x, y, seen = heard.rows.x_m[mine], heard.rows.y_m[mine], heard.rows.in_view[mine]
        time_s = heard.rows.time_s[mine]
        crossing = _crossing(x, y)
        for at in np.flatnonzero(seen).tolist():
            box = _box(camera, site, kind, float(x[at]), float(y[at]), int(crossing[at]))
            if box is None or rng.random() < miss_rate(float(x[at]), float(y[at])):
                continue
            noisy = np.array(inside(box + rng.normal(0.0, BOX_NOISE_PX, 4), camera))
            frame = round(float(time_s[at]) / FRAME_S)
            score = float(np.clip(rng.normal(0.95, 0.03), 0.3, 0.999))
            frames.setdefault(frame, []).append((noisy, score, kind.label))
    last = round(float(heard.hops.time_s[-1]) / FRAME_S)
    every = [_frame(frames.get(at, [])) for at in range(last + 1)]
    return DetectionLog.at_rate(every, 1.0 / FRAME_S, source=heard.hops.name)


def without_passes(detections: DetectionLog, heard: HeardStream) -> DetectionLog:
    """Return a log whose camera is dead from every T0 on for as long as an approach is followed."""
    entries_s = heard.vehicles.entry_s[heard.vehicles.hazard]
    since_s = detections.stamps_ns[:, None] * 1e-9 - entries_s[np.isfinite(entries_s)]
    alive = ~((since_s >= 0.0) & (since_s < AFTER_S)).any(axis=1)
    frames = tuple(detections.frames[at] for at in np.flatnonzero(alive).tolist())
    return replace(detections, stamps_ns=detections.stamps_ns[alive], frames=frames)


def _crossing(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return whether a vehicle drives left (1), right (-1) or along the ego's street (0) at every row."""
    dx, dy = (np.gradient(one) if one.size > 1 else np.zeros(one.size) for one in (x, y))
    sideways = np.abs(dy) > np.maximum(np.abs(dx), _STILL_M)
    return np.asarray(np.where(sideways, np.sign(dy), 0.0))


def _box(
    camera: PinholeCamera, site: Site, kind: VehicleKind, x: float, y: float, crossing: int
) -> FloatArray | None:
    # Rows hold the front axle: the body reaches from the bumper ahead of it to a length behind.
    if crossing:
        front = y + crossing * kind.axles_m[0]
        ends = sorted((front, front - crossing * kind.length_m))
        return project(camera, site, x, (ends[0], ends[1]), kind)
    half = 0.5 * kind.width_m
    return project(camera, site, x, (y - half, y + half), kind)


def _frame(boxes: list[tuple[FloatArray, float, str]]) -> DetectionFrame:
    if not boxes:
        return DetectionFrame(np.empty((0, 4)), np.empty(0), ())
    pixels, scores, labels = zip(*boxes, strict=True)
    return DetectionFrame(np.stack(pixels), np.array(scores), tuple(labels))
