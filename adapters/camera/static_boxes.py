"""Boxes that do not move: a parked car is no co-evidence for the sound of a moving one."""

import math
from dataclasses import dataclass

import numpy as np

from worldstate.ground.checks import in_range
from worldstate.ground.typing import BoolArray, FloatArray, IntArray
from worldstate.ground.values import nanoseconds

from .detections import STAMP_SLACK_NS, DetectionFilter, DetectionLog


@dataclass(frozen=True, slots=True)
class ParkedRule:
    """A box is parked when a box stood at its place in `share` of the frames of the last `span_s` seconds."""

    # For a standing camera: from a moving one every box moves, and none is parked.

    span_s: float = 1.0  # How long it must have stood, > 0
    tolerance_px: float = 5.0  # How far every edge may have moved
    # Share of the past frames in which it must be there; below 1 because detectors miss now and then.
    share: float = 0.8

    def __post_init__(self) -> None:
        in_range("span_s", self.span_s, 0.0, math.inf, open_low=True)
        in_range("tolerance_px", self.tolerance_px, 0.0, math.inf)
        in_range("share", self.share, 0.0, 1.0, open_low=True)


def parked(log: DetectionLog, frame: int, boxes_px: FloatArray, rule: ParkedRule) -> BoolArray:
    """Return which boxes (n, 4) of an image are parked, from that image and earlier ones, shape (n,)."""
    since_ns = int(log.stamps_ns[frame]) - nanoseconds(rule.span_s)
    first = int(np.searchsorted(log.stamps_ns, since_ns - STAMP_SLACK_NS))
    past = log.frames[first:frame]
    # Most images of a hidden approach are empty, and this is asked several times a hop.
    if not past or not len(boxes_px) or log.stamps_ns[0] > since_ns + STAMP_SLACK_NS:
        return np.zeros(len(boxes_px), dtype=bool)
    apart_px = (np.abs(boxes_px[:, None] - earlier.boxes_px[None]).max(axis=2) for earlier in past)
    present = [(apart <= rule.tolerance_px).any(axis=1) for apart in apart_px]
    return np.asarray(np.mean(present, axis=0) >= rule.share)


def kept_and_parked(
    log: DetectionLog, frame: int, keep: DetectionFilter, rule: ParkedRule
) -> tuple[IntArray, BoolArray]:
    """Return the indices of the boxes of an image that are used, and which of those are parked."""
    here = log.frames[frame]
    kept = here.select(keep)
    return kept, parked(log, frame, here.boxes_px[kept], rule)


@dataclass(frozen=True, slots=True)
class BoxCounts:
    """How many boxes of a log count, and why the others do not: each is put down to the first reason.

    Examples
    --------
    >>> str(BoxCounts(frames=10, boxes=6, counted=3, other_class=1, low_score=0, too_small=0, parked=2))
    '3 of 6 boxes in 10 frames count; 1 of another class, 0 below the score, 0 too small, 2 parked'
    """

    frames: int
    boxes: int
    counted: int
    other_class: int
    low_score: int
    too_small: int
    parked: int

    def __str__(self) -> str:
        head = f"{self.counted} of {self.boxes} boxes in {self.frames} frames count"
        classes = f"{self.other_class} of another class, {self.low_score} below the score"
        return f"{head}; {classes}, {self.too_small} too small, {self.parked} parked"


def count_boxes(log: DetectionLog, keep: DetectionFilter, rule: ParkedRule) -> BoxCounts:
    """Count the boxes of a log by what becomes of them."""
    looser = DetectionFilter(keep.labels, 0.0, 0.0), DetectionFilter(keep.labels, keep.min_score, 0.0), keep
    named, scored, high = (sum(len(frame.select(one)) for frame in log.frames) for one in looser)
    boxes = sum(map(len, log.frames))
    still = sum(int(kept_and_parked(log, i, keep, rule)[1].sum()) for i in range(len(log)))
    return BoxCounts(len(log), boxes, high - still, boxes - named, named - scored, scored - high, still)
