"""Boxes, a lens and videos of a camera, and the boxes of vehicles that appear behind a corner."""

import json
import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog
from worldstate.adapters.camera.pinhole import PinholeCamera

LENS = {"width_px": 640, "height_px": 480, "horizontal_fov_deg": 70.0, "position_m": [0, 0, 0]}


def boxed(*boxes_px: Iterable[float], label: str = "car", score: float = 0.9) -> DetectionFrame:
    """Return an image with these boxes: left, top, right, bottom."""
    corners = np.array([[*box] for box in boxes_px], float).reshape(-1, 4)
    return DetectionFrame(corners, np.full(len(corners), score), (label,) * len(corners))


EMPTY = boxed()


def crossing(
    first_px: float, step_px: float, height_px: float = 140.0, images: int = 40, **how: object
) -> DetectionLog:
    """Return a car 200 pixels wide that crosses the image at 10 Hz, to the right for a positive step."""
    lefts = [first_px + step_px * i for i in range(images)]
    frames = [boxed((left, 500.0, left + 200.0, 500.0 + height_px), **how) for left in lefts]  # type: ignore[arg-type]
    return DetectionLog.at_rate(frames, 10.0)


def write_boxes(path: Path, frames: Iterable[DetectionFrame]) -> Path:
    """Write the boxes of images in OVAD's form."""
    rows = [
        {"boxes": one.boxes_px.tolist(), "scores": one.scores.tolist(), "classes_str": one.labels}
        for one in frames
    ]
    path.write_text(json.dumps({"detections_per_frame": rows}))
    return path


def write_video(path: Path, images: Iterable[np.ndarray]) -> Path:
    """Write images as a video of 10 Hz."""
    import cv2

    writer = None
    for image in images:
        size = image.shape[1], image.shape[0]
        writer = writer or cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, size)
        writer.write(image)
    if writer is not None:
        writer.release()
    return path


def write_onnx(path: Path, output: np.ndarray) -> Path:
    """Write a model that ignores its image of 32 x 32 pixels and always returns `output`."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    image = helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, 32, 32])
    result = helper.make_tensor_value_info("output0", TensorProto.FLOAT, list(output.shape))
    values = {"nothing": np.zeros(1, np.float32), "fixed": output.astype(np.float32)}
    nodes = [
        helper.make_node("ReduceMean", ["images"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["mean", "nothing"], ["zero"]),
        helper.make_node("Add", ["fixed", "zero"], ["output0"]),
    ]
    given = [numpy_helper.from_array(value, name) for name, value in values.items()]
    graph = helper.make_graph(nodes, "fixed", [image], [result], given)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), path)
    return path


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
        frames.append(boxed(*boxes))
    return DetectionLog.at_rate(frames, 10.0)
