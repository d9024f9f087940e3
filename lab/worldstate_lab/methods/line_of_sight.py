"""Rows of Table I that need line of sight: the camera's detector, a radar, and a tracker's recovery."""

import math
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Literal, Self

import numpy as np

from worldstate.adapters.camera.detections import DetectionFilter
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.ground.typing import BoolArray, FloatArray, IntArray
from worldstate.operations.recordings.hop_table import HOP_S, HopTable
from worldstate_lab.trials.trial import TRACK_COLUMNS, Decide, Decisions, Trial

from .oc_sort import MIN_SCORE, OcSort, TrackedBox

# At 47,998 Hz a hop ends up to 10 us before its image.
SLACK_S = 1e-3
# An image is valid until the next one is due, plus half a period.
PERIODS = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class TrialImages:
    """Times of the images of a trial, and the latest image at every hop."""

    time_s: FloatArray  # shape (images,)
    of_hop: IntArray  # shape (hops,): -1 if no image is recent

    @classmethod
    def of(cls, trial: Trial) -> Self:
        """Return the images up to the last hop; none if the camera reported nothing.

        Examples
        --------
        >>> seen = {"frame": np.array([9, 12]), "time_s": np.array([0.9, 1.2])}
        >>> images = TrialImages.of(Trial(HopTable({"time_s": np.array([1.0, 1.3, 1.5])}), HopTable(seen)))
        >>> images.time_s.round(1)[-4:].tolist(), images.of_hop.tolist()
        ([1.2, 1.3, 1.4, 1.5], [10, 13, 15])
        """
        hop_s = trial.hops.time_s
        if not len(trial.boxes):
            return cls(np.empty(0), np.full(len(hop_s), -1))
        taken_s = _image_times(trial.boxes, hop_s[-1] + SLACK_S)
        last = np.searchsorted(taken_s, hop_s + SLACK_S, side="right") - 1
        longest_s = PERIODS * (np.median(np.diff(taken_s)) if len(taken_s) > 1 else HOP_S)
        recent = (last >= 0) & (hop_s - taken_s[last] < longest_s)
        return cls(taken_s, np.where(recent, last, -1))

    def at_hops(self, values: FloatArray) -> FloatArray:
        """Return the value of the latest image per hop, given one value per image; NaN without an image."""
        return np.append(values, np.nan)[self.of_hop]


def _image_times(boxes: HopTable, until_s: float) -> FloatArray:
    # Only images with boxes have rows. The times between are interpolated, those outside extrapolated at the
    # same rate.
    known, first = np.unique(boxes.frame, return_index=True)
    times = boxes.time_s[first]
    period = float(np.median(np.diff(times) / np.diff(known))) if len(known) > 1 else HOP_S
    after = max(int((until_s - times[-1]) / period), 0)
    corners = np.r_[-1, known, known[-1] + after + 1]
    corner_s = np.r_[times[0] - (known[0] + 1) * period, times, times[-1] + (after + 1) * period]
    return np.asarray(np.interp(np.arange(corners[-1]), corners, corner_s))


def vehicles(boxes: HopTable, keep: DetectionFilter) -> BoolArray:
    """Return which boxes a filter accepts, parked or moving, shape (n,)."""
    # The table already marks accepted boxes that move: only parked ones must be tested.
    high = boxes.box_px[:, 3] - boxes.box_px[:, 1] > keep.min_height_px
    return np.asarray(np.isin(boxes.class_name, list(keep.labels)) & (boxes.score >= keep.min_score) & high)


def sides(bearing_rad: FloatArray) -> IntArray:
    """Return the side of each bearing, 0 if it is NaN."""
    return np.nan_to_num(np.sign(bearing_rad)).astype(np.int64)  # Left is positive in both


@dataclass(frozen=True, slots=True)
class VisionOnly:
    """An advisory at every hop whose image has a moving vehicle; bearing and side are of the widest box."""

    # Nothing is fitted: the detector and its filter are OVAD's. Alarms before T0 are within the tolerance of
    # the annotation, see `seen_early_s`; alarms on hazard-free recordings are vehicles in view.

    name: str = "Vision-only"

    def fit(self, calibration: Sequence[Trial], rng: np.random.Generator, /) -> Decide:
        """Return the rule."""
        return _seen


def _seen(trial: Trial) -> Decisions:
    boxes, images = trial.boxes, TrialImages.of(trial)
    azimuth = np.full(len(images.time_s), np.nan)
    if len(boxes):
        moving = np.flatnonzero(boxes.moving)
        widths = boxes.box_px[moving, 2] - boxes.box_px[moving, 0]
        # Boxes are in order of width, so that the widest box of an image is kept.
        chosen = moving[np.argsort(widths, kind="stable")]
        azimuth[boxes.frame[chosen]] = boxes.azimuth_rad[chosen]
    bearing = images.at_hops(azimuth)
    return Decisions.of(trial.hops.time_s, np.isfinite(bearing), side=sides(bearing), bearing_rad=bearing)


def seen_early_s(trials: Iterable[Trial]) -> FloatArray:
    """Return the time from the first moving box to T0 in each occluded approach, 0 if none precedes T0.

    The paper counts 3 of 42 such approaches, attributes them to the tolerance of the T0 annotation, and
    prints 0 in the row of vision-only.

    Examples
    --------
    >>> from worldstate.operations.recordings.hop_table import HopTable
    >>> hops = HopTable({"time_s": np.array([1.0, 1.1])}, "a", "left", 1.3)
    >>> boxes = HopTable({"time_s": np.array([1.1, 1.2]), "moving": np.array([False, True])})
    >>> seen_early_s([Trial(hops), Trial(hops, boxes)]).round(3).tolist()
    [0.0, 0.1]
    """
    return np.array([_early_s(trial) for trial in trials if np.isfinite(trial.t0_s)])


def _early_s(trial: Trial) -> float:
    boxes = trial.boxes
    # Before the first hop, parked and moving cars cannot be distinguished.
    scored = boxes.time_s >= trial.hops.time_s[0] - SLACK_S
    early_s = trial.t0_s - float(boxes.time_s[scored & boxes.moving.astype(bool)].min(initial=np.inf))
    # T0 is defined by a box in its image, so such a box is not early.
    return early_s if early_s > SLACK_S else 0.0


# Field of view and range of the near scan of a common 77 GHz front radar (Continental ARS 408-21: 60 deg to
# either side, 70 m, a scan in 72 ms); the detection probability is a usual assumption for such a radar. The
# range is irrelevant at a junction: everything in line of sight is nearer than 70 m, and real recordings
# contain no distances. Waves of 4 mm are neither diffracted around a corner nor transmitted by a wall, and
# production radars treat their reflections as clutter, so hidden vehicles are never detected.
RADAR_HALF_VIEW_RAD = math.radians(60.0)


@dataclass(frozen=True, slots=True)
class RadarFieldOfView:
    """A forward radar that detects a vehicle in line of sight and within its field of view, scan by scan.

    It never raises a false alarm, so its false alarms are not scored. It gives only a side, because its
    bearing would be the true one.
    """

    detection: float = 0.9
    name: str = "Radar field-of-view model"

    def fit(self, calibration: Sequence[Trial], rng: np.random.Generator, /) -> Decide:
        """Return the model with its random misses, which are the same for a trial in any order."""
        seed = int(rng.integers(1 << 32))
        return lambda trial: self._scanned(trial, seed)

    def _scanned(self, trial: Trial, seed: int) -> Decisions:
        bearing = np.full(len(trial.hops), np.nan)
        if len(trial.truth):
            missed = np.random.default_rng([seed, zlib.crc32(trial.name.encode())])
            found = missed.random(len(trial.truth)) < self.detection
            found &= trial.truth.in_view.astype(bool)
            found &= np.abs(trial.truth.azimuth_rad) <= RADAR_HALF_VIEW_RAD
            time_s = trial.truth.time_s[found]
            # The first hop that ends after the scan reports it, if it is less than one hop later.
            hop_s = trial.hops.time_s
            hop = np.searchsorted(hop_s + SLACK_S, time_s)
            near = (hop < len(hop_s)) & (hop_s[np.minimum(hop, len(hop_s) - 1)] - time_s < HOP_S - SLACK_S)
            bearing[hop[near]] = trial.truth.azimuth_rad[found][near]
        return Decisions.of(trial.hops.time_s, np.isfinite(bearing), side=sides(bearing))


Reading = Literal["stock", "coasting"]


@dataclass(frozen=True, slots=True)
class OcSortRecovery:
    """An advisory while OC-SORT has the track of a moving vehicle; bearing and side are of the largest box.

    In the variant `stock` a track counts while the published code returns it, which is in images with a box.
    In `coasting` it counts as long as the tracker keeps it, up to 3 s after its last box at 10 Hz, at the
    position predicted by the filter. This is the most that recovery by a motion model can do for a hidden
    vehicle, and more than the authors return. Before T0 neither variant can raise an alarm for a vehicle that
    was never detected, so the paper's value is 0. On a hazard-free recording both report vehicles in view,
    and `coasting` also those that have just left it.
    """

    reading: Reading
    camera: PinholeCamera = field(default_factory=PinholeCamera.ovad)
    keep: DetectionFilter = field(default_factory=DetectionFilter)  # The filter of OVAD's authors

    @property
    def name(self) -> str:
        """Name in the report."""
        return f"OC-SORT recovery ({self.reading})"

    def fit(self, calibration: Sequence[Trial], rng: np.random.Generator, /) -> Decide:
        """Return the tracker with its published settings: nothing is fitted."""
        return self._decide

    def _decide(self, trial: Trial) -> Decisions:
        images, time_s = TrialImages.of(trial), trial.hops.time_s
        # A single box is not a confirmed track and must not coast.
        counts = attrgetter("certain" if self.reading == "stock" else "known")
        held = [list(filter(counts, tracks)) for tracks in _moving_tracks(trial, images, self.keep)]
        rows = []
        for hop, image in enumerate(images.of_hop):
            for one in held[image] if image >= 0 else ():
                left, top, right, bottom = one.box_px.tolist()
                azimuth = float(self.camera.azimuth(0.5 * (left + right)))
                rows.append((hop, one.track, azimuth, (right - left) * (bottom - top)))
        bearing = np.full(len(time_s), np.nan)
        # Boxes are in order of area, so that the largest box of a hop is kept.
        for hop, _, azimuth_rad, _ in sorted(rows, key=lambda row: row[3]):
            bearing[hop] = azimuth_rad
        tracks = HopTable.of_rows(TRACK_COLUMNS, [(time_s[hop], track, at) for hop, track, at, _ in rows])
        found = np.isfinite(bearing)
        return Decisions.of(time_s, found, side=sides(bearing), bearing_rad=bearing, tracks=tracks)


def _moving_tracks(trial: Trial, images: TrialImages, keep: DetectionFilter) -> Iterator[list[TrackedBox]]:
    """Yield the tracks of moving vehicles in every image."""
    # Detectors with a lower minimum score would have almost no boxes above the published one.
    sort = OcSort(min(keep.min_score, MIN_SCORE))
    boxes, moving = trial.boxes, set[int]()
    # Parked vehicles are tracked too and left out afterwards: with moving boxes only, a parked car would
    # start a track in the first second, before it is known to be parked, and coast into scored time.
    counted = np.flatnonzero(vehicles(boxes, keep)) if len(boxes) else np.empty(0, np.intp)
    edges = np.searchsorted(boxes.frame[counted], np.arange(len(images.time_s) + 1))
    for image, time_s in enumerate(images.time_s):
        here = counted[edges[image] : edges[image + 1]]
        # A piece of a long stream begins long after the first image of the stream.
        tracks = (
            sort.step(boxes.box_px[here], boxes.score[here]) if time_s > trial.hops.time_s[0] - 1.5 else []
        )
        for one in tracks:
            if one.detection >= 0:
                (moving.add if boxes.moving[here[one.detection]] else moving.discard)(one.track)
        yield [one for one in tracks if one.track in moving]
