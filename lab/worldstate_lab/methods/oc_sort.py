"""OC-SORT (Cao et al., CVPR 2023): a box tracker that relies on observations more than on predictions."""

import math
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from worldstate.adapters.camera.box_linking import gated_pairs, overlaps
from worldstate.ground.typing import FloatArray

# State of SORT (Bewley et al., 2016): centre, area and aspect ratio of a box, and the change of the first
# three per image. The noise levels are those of its code, which all later versions have kept.
_F = np.eye(7) + np.eye(7, k=4)
_H = np.eye(4, 7)
_Q = np.diag([1.0, 1.0, 1.0, 1.0, 0.01, 0.01, 0.0001])
_R = np.diag([1.0, 1.0, 10.0, 10.0])
_P = np.diag([10.0] * 4 + [10_000.0] * 3)
_TINY = 1e-6
# The published settings.
MIN_SCORE = 0.6  # Boxes with a lower score are ignored
MAX_AGE = 30  # Number of images without a box after which a track ends: 3 s at 10 Hz
MIN_HITS = 3  # Number of consecutive images with a box that confirm a track
MIN_IOU = 0.3  # Minimum overlap of a box with its prediction
INERTIA = 0.2  # Weight of the direction of motion in the association
DELTA_T = 3  # Number of images over which that direction is measured


@dataclass(frozen=True, slots=True, eq=False)
class TrackedBox:
    """One live track in one image."""

    track: int  # Number of the identity
    box_px: FloatArray  # The detection if there is one, otherwise the prediction
    detection: int  # Index among the boxes of this image, -1 if the track coasts
    certain: bool  # Whether the published code returns it now
    known: bool  # Whether it was confirmed at least once


class OcSort:
    """Tracker with boxes as input and live tracks as output; an image without boxes is a step too.

    Examples
    --------
    >>> sort = OcSort()
    >>> for shift in (0.0, 10.0, 20.0, 30.0):
    ...     tracks = sort.step(np.array([[shift, 9.0, shift + 100.0, 89.0]]), np.array([0.9]))
    >>> [(one.track, one.detection, one.certain) for one in tracks]
    [(0, 0, True)]
    >>> [coasting] = sort.step(np.empty((0, 4)), np.empty(0))
    >>> coasting.detection, coasting.certain, coasting.box_px.round().tolist()
    (-1, False, [40.0, 9.0, 140.0, 89.0])
    """

    def __init__(self, min_score: float = MIN_SCORE) -> None:
        self._min_score = min_score
        self._tracks: list[_Track] = []
        self._born = self._steps = 0

    def step(self, boxes_px: FloatArray, scores: FloatArray) -> list[TrackedBox]:
        """Process the boxes (n, 4) and scores (n,) of the next image."""
        self._steps += 1
        for track in self._tracks:
            track.predict()
        used = np.flatnonzero(scores >= self._min_score)
        boxes, taken = boxes_px[used], {}
        pairs = self._associate(boxes, scores[used])
        for i, j in pairs:
            self._tracks[i].observe(boxes[j])
            taken[self._tracks[i].number] = int(used[j])
        for j in np.setdiff1d(np.arange(len(used)), [j for _, j in pairs]):
            taken[self._born] = int(used[j])
            self._tracks.append(_Track.at(boxes[j], self._born))
            self._born += 1
        self._tracks = [track for track in self._tracks if track.unseen <= MAX_AGE]
        return [self._told(track, taken.get(track.number, -1)) for track in self._tracks]

    def _told(self, track: "_Track", detection: int) -> TrackedBox:
        # In the first images, confirmation is not required; otherwise every recording would begin without
        # tracks.
        early = self._steps <= MIN_HITS
        certain = detection >= 0 and (track.streak >= MIN_HITS or early)
        track.known |= certain
        box = track.last_px if detection >= 0 else track.belief.box_px
        return TrackedBox(track.number, box, detection, certain, track.known)

    def _associate(self, boxes: FloatArray, scores: FloatArray) -> list[tuple[int, int]]:
        """Return pairs of track and box, first by prediction and direction, then by the last observed box."""
        tracks = self._tracks
        predicted = np.array([track.belief.box_px for track in tracks]).reshape(-1, 4)
        overlap = overlaps(predicted, boxes)
        toward = [track.consistency(boxes) for track in tracks]
        weight = INERTIA * scores * np.array(toward).reshape(overlap.shape)
        pairs = _matched(overlap, weight)
        # A vehicle that braked is at its observed and not at its predicted position.
        idle = np.setdiff1d(np.arange(len(tracks)), [i for i, _ in pairs])
        free = np.setdiff1d(np.arange(len(boxes)), [j for _, j in pairs])
        last = np.array([tracks[i].last_px for i in idle]).reshape(-1, 4)
        again = _matched(overlaps(last, boxes[free]), 0.0)
        return pairs + [(int(idle[i]), int(free[j])) for i, j in again]


@dataclass(frozen=True, slots=True, eq=False)
class _Belief:
    """Mean and covariance of SORT's box state."""

    mean: FloatArray
    cov: FloatArray

    @classmethod
    def at(cls, box_px: FloatArray) -> Self:
        return cls(np.r_[_measured(box_px), 0.0, 0.0, 0.0], _P)

    @property
    def box_px(self) -> FloatArray:
        x, y, area, ratio = self.mean[:4].tolist()
        width = math.sqrt(max(area * ratio, 0.0))
        half = 0.5 * np.array([width, area / width if width else 0.0])
        middle = np.array([x, y])
        return np.asarray(np.r_[middle - half, middle + half])

    def predict(self) -> "_Belief":
        mean = self.mean.copy()
        # The area must not shrink to zero: a box has no size if the area is negative.
        if mean[2] + mean[6] <= 0.0:
            mean[6] = 0.0
        return _Belief(_F @ mean, _F @ self.cov @ _F.T + _Q)

    def update(self, z: FloatArray) -> "_Belief":
        gain = np.linalg.solve(self.cov[:4, :4] + _R, self.cov[:4]).T
        left = np.eye(7) - gain @ _H
        cov = left @ self.cov @ left.T + gain @ _R @ gain.T
        return _Belief(self.mean + gain @ (z - self.mean[:4]), cov)


@dataclass(slots=True, eq=False)
class _Track:
    """One track with its observations."""

    number: int
    belief: _Belief
    last_px: FloatArray
    age: int = 0  # Images since it began
    unseen: int = 0  # Images since its last box
    streak: int = 0  # Consecutive images with a box, without the first
    known: bool = False
    # By age. The first box of the track is left out, as in the authors' code: a direction needs two more.
    seen: dict[int, FloatArray] = field(default_factory=dict)
    direction: FloatArray | None = None
    # Belief at the first image without a box. When the gap ends, it is replayed from there.
    frozen: _Belief | None = None

    @classmethod
    def at(cls, box_px: FloatArray, number: int) -> Self:
        return cls(number, _Belief.at(box_px), box_px)

    def predict(self) -> None:
        if self.unseen:
            self.streak = 0
            self.frozen = self.frozen or self.belief
        self.belief = self.belief.predict()
        self.age += 1
        self.unseen += 1

    def observe(self, box_px: FloatArray) -> None:
        if self.seen:
            self.direction = _direction(self._earlier(), box_px)
        if self.frozen is not None:
            self.belief = self._replayed(self.frozen, box_px)
        # As in the authors' code, the box that ends a gap is used twice: here, and in the replay before.
        self.belief = self.belief.update(_measured(box_px))
        self.frozen, self.unseen, self.last_px = None, 0, box_px
        self.streak += 1
        self.seen[self.age] = box_px
        self.seen = {age: box for age, box in self.seen.items() if age >= self.age - DELTA_T}

    def consistency(self, boxes: FloatArray) -> FloatArray:
        r"""Return :math:`(\pi/2 - \Delta\theta) / \pi`, agreement of each box with the track's direction."""
        if self.direction is None:
            return np.zeros(len(boxes))
        toward = _direction(self._earlier(), boxes)
        return np.asarray(0.5 - np.arccos(np.clip(toward @ self.direction, -1.0, 1.0)) / np.pi)

    def _earlier(self) -> FloatArray:
        """Return the box of `DELTA_T` images ago, or the first one after it."""
        ages = sorted(self.seen)
        return self.seen[next((age for age in ages if age >= self.age - DELTA_T), ages[-1])]

    def _replayed(self, belief: _Belief, box_px: FloatArray) -> _Belief:
        """Filter the gap again along the straight line from the last box to this one, in centre and size."""
        first, last = _middle_and_size(self.last_px), _middle_and_size(box_px)
        for step in range(1, self.unseen + 1):
            belief = belief.update(_shape(first + (last - first) * step / self.unseen))
            if step < self.unseen:
                belief = belief.predict()
        return belief


def _measured(box_px: FloatArray) -> FloatArray:
    return _shape(_middle_and_size(box_px))


def _shape(middle_and_size: FloatArray) -> FloatArray:
    x, y, width, height = middle_and_size.tolist()
    return np.array([x, y, width * height, width / (height + _TINY)])


def _middle_and_size(box_px: FloatArray) -> FloatArray:
    corner, size = box_px[:2], box_px[2:] - box_px[:2]
    return np.asarray(np.r_[corner + 0.5 * size, size])


def _direction(start_px: FloatArray, end_px: FloatArray) -> FloatArray:
    """Return the unit vectors (..., 2) from the centre of one box to those of others."""
    apart = 0.5 * (end_px[..., :2] + end_px[..., 2:] - start_px[:2] - start_px[2:])
    return np.asarray(apart / (np.linalg.norm(apart, axis=-1, keepdims=True) + _TINY))


def _matched(overlap: FloatArray, weight: FloatArray | float) -> list[tuple[int, int]]:
    """Return the assignment with the largest sum of overlap and weight, without pairs of low overlap."""
    cost = -(overlap + weight)
    return [(i, j) for i, j in gated_pairs(cost, overlap >= MIN_IOU, cost).tolist()]
