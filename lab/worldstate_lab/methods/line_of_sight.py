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

# At 47,998 Hz a hop ends up to 10 us before the image that it belongs to.
SLACK_S = 1e-3
# An image speaks until the next one is due, and half a period longer.
PERIODS = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class Images:
    """When the images of a trial were taken, and which of them every hop sees last."""

    time_s: FloatArray  # shape (images,)
    of_hop: IntArray  # shape (hops,): -1 where no image is recent

    @classmethod
    def of(cls, trial: Trial) -> Self:
        """Return the images up to the last hop; none where the camera reported nothing at all.

        Examples
        --------
        >>> seen = {"frame": np.array([9, 12]), "time_s": np.array([0.9, 1.2])}
        >>> images = Images.of(Trial(HopTable({"time_s": np.array([1.0, 1.3, 1.5])}), HopTable(seen)))
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
        """Return what each hop sees of a value per image, NaN where it sees none."""
        return np.append(values, np.nan)[self.of_hop]


def _image_times(boxes: HopTable, until_s: float) -> FloatArray:
    # Only images with boxes have rows: those between are interpolated, those around follow at the same rate.
    known, first = np.unique(boxes.frame, return_index=True)
    times = boxes.time_s[first]
    period = float(np.median(np.diff(times) / np.diff(known))) if len(known) > 1 else HOP_S
    after = max(int((until_s - times[-1]) / period), 0)
    corners = np.r_[-1, known, known[-1] + after + 1]
    corner_s = np.r_[times[0] - (known[0] + 1) * period, times, times[-1] + (after + 1) * period]
    return np.asarray(np.interp(np.arange(corners[-1]), corners, corner_s))


def vehicles(boxes: HopTable, keep: DetectionFilter) -> BoolArray:
    """Return which boxes count by a filter, parked or moving, shape (n,)."""
    # The table says which boxes move, and those that do count already: only parked ones are looked up.
    high = boxes.box_px[:, 3] - boxes.box_px[:, 1] > keep.min_height_px
    return np.asarray(np.isin(boxes.class_name, list(keep.labels)) & (boxes.score >= keep.min_score) & high)


def sides(bearing_rad: FloatArray) -> IntArray:
    """Return the side of each bearing, none where it is NaN."""
    return np.nan_to_num(np.sign(bearing_rad)).astype(np.int64)  # Left is positive in both


@dataclass(frozen=True, slots=True)
class VisionOnly:
    """An advisory at every hop whose image shows a moving vehicle; bearing and side are the widest one's."""

    # It has nothing to fit: the detector and its filter are OVAD's. What it says before T0 is the tolerance
    # of the annotation, see `seen_early_s`; what it says of a hazard-free recording is a vehicle in view.

    name: str = "Vision-only"

    def fit(self, calibration: Sequence[Trial], rng: np.random.Generator, /) -> Decide:
        """Return the rule."""
        return _seen


def _seen(trial: Trial) -> Decisions:
    boxes, images = trial.boxes, Images.of(trial)
    azimuth = np.full(len(images.time_s), np.nan)
    if len(boxes):
        moving = np.flatnonzero(boxes.moving)
        widths = boxes.box_px[moving, 2] - boxes.box_px[moving, 0]
        # In the order of width, so that the widest box of an image is the one that stays.
        chosen = moving[np.argsort(widths, kind="stable")]
        azimuth[boxes.frame[chosen]] = boxes.azimuth_rad[chosen]
    bearing = images.at_hops(azimuth)
    return Decisions.of(trial.hops.time_s, np.isfinite(bearing), side=sides(bearing), bearing_rad=bearing)


def seen_early_s(trials: Iterable[Trial]) -> FloatArray:
    """Return by how much the first moving box precedes T0 in each occluded approach, 0 where none does.

    The paper counts 3 of 42 such approaches, puts them down to the tolerance of the T0 annotation, and
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
    # Before the first hop a parked car cannot be told from a moving one.
    scored = boxes.time_s >= trial.hops.time_s[0] - SLACK_S
    early_s = trial.t0_s - float(boxes.time_s[scored & boxes.moving.astype(bool)].min(initial=np.inf))
    # A box in the image of T0 itself is what T0 means.
    return early_s if early_s > SLACK_S else 0.0


# Field of view and range of the near scan of a common 77 GHz front radar (Continental ARS 408-21: 60 deg
# to either side, 70 m, a scan in 72 ms); the probability is what tracking papers assume of such a radar.
# The range decides nothing at a junction: whatever is in line of sight there is nearer than 70 m, and
# a real recording does not say how far. Waves of 4 mm neither bend round a corner nor pass a wall; what
# they reflect off one is clutter to a production radar, so hidden vehicles are not found at all.
RADAR_HALF_VIEW_RAD = math.radians(60.0)


@dataclass(frozen=True, slots=True)
class RadarFieldOfView:
    """A forward radar that finds a vehicle in line of sight and within its field of view, scan by scan.

    It raises no false alarm, so that none can be counted, and names a side only: its bearing would be the
    true one, whose error says nothing.
    """

    detection: float = 0.9
    name: str = "Radar field-of-view model"

    def fit(self, calibration: Sequence[Trial], rng: np.random.Generator, /) -> Decide:
        """Return the model with the randomness of its misses: the same for a trial in every order."""
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
            # The first hop that ends after the scan reports it, if it is not a whole hop later.
            hop_s = trial.hops.time_s
            hop = np.searchsorted(hop_s + SLACK_S, time_s)
            near = (hop < len(hop_s)) & (hop_s[np.minimum(hop, len(hop_s) - 1)] - time_s < HOP_S - SLACK_S)
            bearing[hop[near]] = trial.truth.azimuth_rad[found][near]
        return Decisions.of(trial.hops.time_s, np.isfinite(bearing), side=sides(bearing))


Reading = Literal["stock", "coasting"]


@dataclass(frozen=True, slots=True)
class OcSortRecovery:
    """An advisory while OC-SORT holds the track of a moving vehicle; bearing and side are the largest one's.

    In the reading `stock` a track is held while the published code emits it: in images where it has a box.
    In `coasting` it is held for as long as the tracker keeps it, up to 3 s after its last box at 10 Hz, at
    the place where the filter predicts it: that is what motion-model recovery can say of a hidden vehicle,
    and it is more than the authors emit. Before T0 neither can raise an alarm on a vehicle that was never
    seen, which is the paper's 0; on a hazard-free recording both report vehicles in view, and `coasting`
    those that have just left it.
    """

    reading: Reading
    camera: PinholeCamera = field(default_factory=PinholeCamera.ovad)
    keep: DetectionFilter = field(default_factory=DetectionFilter)  # Of OVAD's authors

    @property
    def name(self) -> str:
        """As in the report."""
        return f"OC-SORT recovery ({self.reading})"

    def fit(self, calibration: Sequence[Trial], rng: np.random.Generator, /) -> Decide:
        """Return the tracker at its published settings: nothing is fitted."""
        return self._decide

    def _decide(self, trial: Trial) -> Decisions:
        images, time_s = Images.of(trial), trial.hops.time_s
        # A box that flashed up once never was a track to coast on.
        counts = attrgetter("certain" if self.reading == "stock" else "known")
        held = [list(filter(counts, tracks)) for tracks in _moving_tracks(trial, images, self.keep)]
        rows = []
        for hop, image in enumerate(images.of_hop):
            for one in held[image] if image >= 0 else ():
                left, top, right, bottom = one.box_px.tolist()
                azimuth = float(self.camera.azimuth(0.5 * (left + right)))
                rows.append((hop, one.track, azimuth, (right - left) * (bottom - top)))
        bearing = np.full(len(time_s), np.nan)
        # In the order of area, so that the largest box of a hop is the one that stays.
        for hop, _, azimuth_rad, _ in sorted(rows, key=lambda row: row[3]):
            bearing[hop] = azimuth_rad
        tracks = HopTable.of_rows(TRACK_COLUMNS, [(time_s[hop], track, at) for hop, track, at, _ in rows])
        found = np.isfinite(bearing)
        return Decisions.of(time_s, found, side=sides(bearing), bearing_rad=bearing, tracks=tracks)


def _moving_tracks(trial: Trial, images: Images, keep: DetectionFilter) -> Iterator[list[TrackedBox]]:
    """Yield the tracks of moving vehicles in every image."""
    # A detector whose boxes count from a lower score would have hardly one left at the published least one.
    sort = OcSort(min(keep.min_score, MIN_SCORE))
    boxes, moving = trial.boxes, set[int]()
    # Parked vehicles are tracked as well and left out afterwards: given moving boxes alone, a parked car
    # would begin a track in the first second, before it is known to stand, and coast into scored time.
    counted = np.flatnonzero(vehicles(boxes, keep)) if len(boxes) else np.empty(0, np.intp)
    edges = np.searchsorted(boxes.frame[counted], np.arange(len(images.time_s) + 1))
    for image, time_s in enumerate(images.time_s):
        here = counted[edges[image] : edges[image + 1]]
        # A piece of a long stream begins long after its first image.
        tracks = (
            sort.step(boxes.box_px[here], boxes.score[here]) if time_s > trial.hops.time_s[0] - 1.5 else []
        )
        for one in tracks:
            if one.detection >= 0:
                (moving.add if boxes.moving[here[one.detection]] else moving.discard)(one.track)
        yield [one for one in tracks if one.track in moving]
