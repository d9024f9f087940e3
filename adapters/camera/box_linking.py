"""Overlap of boxes, and linking of boxes in successive images."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import BoolArray, FloatArray, IndexArray

_SPAN = 4  # Number of last boxes whose motion predicts the next one


@dataclass(frozen=True, slots=True)
class AzimuthBox:
    """A box in one image by its azimuths; an edge or height that the image border cuts is NaN."""

    time_s: float
    left_rad: float
    right_rad: float
    middle_rad: float
    height_rad: float  # Height of the object divided by the depth of its near side
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
    """Return row and column of each pair of the cheapest assignment within the gate, shape (k, 2).

    In the assignment, a pair outside the gate has the cost `price`.

    Examples
    --------
    >>> cost = np.array([[1.0, 5.0], [9.0, 2.0], [9.0, 1.0]])
    >>> gated_pairs(cost, cost <= 3.0, price=100.0)
    array([[0, 0],
           [2, 1]])
    """
    # Imported here because it takes 0.4 s, which a command that only prints its options need not spend.
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(np.where(within, cost, price))
    kept = within[rows, columns]
    return np.column_stack([rows[kept], columns[kept]])


def linked_boxes(
    images: Iterable[tuple[float, Sequence[AzimuthBox]]], gate_rad: float, longest_gap_s: float
) -> list[list[AzimuthBox]]:
    """Link the boxes of successive images to tracks, each to the track that predicts it within the gate.

    A track ends if it has no box for longer than the gap. Each image is given as its time and its boxes.
    """
    tracks: list[list[AzimuthBox]] = []
    closed: list[list[AzimuthBox]] = []
    for time_s, boxes in images:
        closed += [one for one in tracks if time_s - one[-1].time_s > longest_gap_s]
        tracks = [one for one in tracks if time_s - one[-1].time_s <= longest_gap_s]
        expected = np.array([_predicted_rad(one, time_s) for one in tracks])
        apart = np.abs(expected[:, None] - np.array([box.middle_rad for box in boxes])[None, :])
        pairs = gated_pairs(apart, apart < gate_rad, np.pi).tolist()
        for row, column in pairs:
            tracks[row].append(boxes[column])
        taken = {column for _, column in pairs}
        tracks += [[box] for column, box in enumerate(boxes) if column not in taken]
    return closed + tracks


def _predicted_rad(boxes: Sequence[AzimuthBox], time_s: float) -> float:
    """Return the azimuth of a track's next box, extrapolated from its last boxes."""
    last, before = boxes[-1], boxes[-_SPAN:][0]
    if last.time_s == before.time_s:
        return last.middle_rad
    rate = (last.middle_rad - before.middle_rad) / (last.time_s - before.time_s)
    return last.middle_rad + rate * (time_s - last.time_s)
