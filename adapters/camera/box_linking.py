"""Boxes of one image and of the next: which overlap, which belong to one vehicle, which stand still.

A parked car is no co-evidence for the sound of a moving one.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import BoolArray, FloatArray, IndexArray, IntArray
from worldstate.ground.values import nanoseconds

from .detections import STAMP_SLACK_NS, DetectionFilter, DetectionLog

# A box is parked when a box stood at its place, every edge within so many pixels, in this share of the images
# of so many seconds; below 1 because detectors miss now and then.
PARKED_S, PARKED_PX, PARKED_SHARE = 1.0, 5.0, 0.8
_SPAN = 4  # Boxes whose motion predicts the next one


@dataclass(frozen=True, slots=True)
class AzimuthBox:
    """A box in one image by its azimuths; an edge or a height that the image cuts is NaN."""

    time_s: float
    left_rad: float
    right_rad: float
    middle_rad: float
    height_rad: float  # Over the depth of its near side
    label: str


def overlaps(boxes_px: FloatArray, others_px: FloatArray) -> FloatArray:
    r"""Return the intersection over union of every box with every other one.

    .. math:: IoU = |A \cap B| / |A \cup B|

    Shapes: boxes_px, others_px (n, 4).
    """
    low = np.maximum(boxes_px[:, None, :2], others_px[None, :, :2])
    high = np.minimum(boxes_px[:, None, 2:], others_px[None, :, 2:])
    common = np.clip(high - low, 0.0, None).prod(axis=2)
    union = _areas(boxes_px)[:, None] + _areas(others_px)[None, :] - common
    return np.asarray(np.divide(common, union, out=np.zeros_like(common), where=union > 0))


def _areas(boxes_px: FloatArray) -> FloatArray:
    return np.asarray(np.clip(boxes_px[:, 2:] - boxes_px[:, :2], 0.0, None).prod(axis=1))


def gated_pairs(cost: FloatArray, within: BoolArray, price: float | FloatArray) -> IndexArray:
    """Return row and column of each pair of the cheapest assignment, shape (k, 2), within the gate.

    In the choice, a pair that is not within it costs `price`.

    Examples
    --------
    >>> cost = np.array([[1.0, 5.0], [9.0, 2.0], [9.0, 1.0]])
    >>> gated_pairs(cost, cost <= 3.0, price=100.0)
    array([[0, 0],
           [2, 1]])
    """
    # Imported where it is used: it takes 0.4 s, which a command that only prints its options would pay.
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(np.where(within, cost, price))
    kept = within[rows, columns]
    return np.column_stack([rows[kept], columns[kept]])


def linked_boxes(
    images: Iterable[tuple[float, Sequence[AzimuthBox]]], gate_rad: float, longest_gap_s: float
) -> list[list[AzimuthBox]]:
    """Join the boxes of successive images to tracks, each box to the one that predicts it within a gate.

    A track that has no box for longer than the gap ends. Images come as their time and their boxes.
    """
    tracks: list[list[AzimuthBox]] = []
    closed: list[list[AzimuthBox]] = []
    for time_s, boxes in images:
        closed += [one for one in tracks if time_s - one[-1].time_s > longest_gap_s]
        tracks = [one for one in tracks if time_s - one[-1].time_s <= longest_gap_s]
        expected = np.array([_predicted_rad(one, time_s) for one in tracks])
        found = np.array([box.middle_rad for box in boxes])
        apart = np.abs(expected[:, None] - found[None, :])
        pairs = gated_pairs(apart, apart < gate_rad, np.pi).tolist()
        for row, column in pairs:
            tracks[row].append(boxes[column])
        taken = {column for _, column in pairs}
        tracks += [[box] for column, box in enumerate(boxes) if column not in taken]
    return closed + tracks


def _predicted_rad(boxes: Sequence[AzimuthBox], time_s: float) -> float:
    """Return where the next box of a track is expected, from the motion of its last ones."""
    last, before = boxes[-1], boxes[-_SPAN:][0]
    if last.time_s == before.time_s:
        return last.middle_rad
    rate = (last.middle_rad - before.middle_rad) / (last.time_s - before.time_s)
    return last.middle_rad + rate * (time_s - last.time_s)


def parked(log: DetectionLog, frame: int, boxes_px: FloatArray) -> BoolArray:
    """Return which boxes (n, 4) of an image are parked, from that image and earlier ones, shape (n,).

    For a standing camera: from a moving one every box moves, and none is parked.
    """
    since_ns = int(log.stamps_ns[frame]) - nanoseconds(PARKED_S)
    first = int(np.searchsorted(log.stamps_ns, since_ns - STAMP_SLACK_NS))
    past = log.frames[first:frame]
    # Most images of a hidden approach are empty, and this is asked several times a hop.
    if not past or not len(boxes_px) or log.stamps_ns[0] > since_ns + STAMP_SLACK_NS:
        return np.zeros(len(boxes_px), dtype=bool)
    apart_px = (np.abs(boxes_px[:, None] - earlier.boxes_px[None]).max(axis=2) for earlier in past)
    present = [(apart <= PARKED_PX).any(axis=1) for apart in apart_px]
    return np.asarray(np.mean(present, axis=0) >= PARKED_SHARE)


def kept_and_parked(log: DetectionLog, frame: int, keep: DetectionFilter) -> tuple[IntArray, BoolArray]:
    """Return the indices of the boxes of an image that are used, and which of those are parked."""
    here = log.frames[frame]
    kept = here.select(keep)
    return kept, parked(log, frame, here.boxes_px[kept])


COUNTS_TOLD = (
    "{counted} of {boxes} boxes in {frames} frames count; {other_class} of another class, "
    "{low_score} below the score, {too_small} too small, {parked} parked"
)


def count_boxes(log: DetectionLog, keep: DetectionFilter) -> dict[str, int]:
    """Count the boxes of a log by what becomes of them: each is put down to the first reason."""
    looser = DetectionFilter(keep.labels, 0.0, 0.0), DetectionFilter(keep.labels, keep.min_score, 0.0), keep
    named, scored, high = (sum(len(frame.select(one)) for frame in log.frames) for one in looser)
    boxes = sum(map(len, log.frames))
    still = sum(int(kept_and_parked(log, i, keep)[1].sum()) for i in range(len(log)))
    apart = {"other_class": boxes - named, "low_score": named - scored, "too_small": scored - high}
    return {"frames": len(log), "boxes": boxes, "counted": high - still, **apart, "parked": still}
