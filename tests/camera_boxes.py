"""Boxes, a lens and videos of a camera."""

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog

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
