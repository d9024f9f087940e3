"""What sensors that need line of sight say: the camera's detector, and a radar."""

import math
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.ground.checks import in_range
from worldstate.ground.typing import FloatArray
from worldstate.operations.recordings.hop_stream import HOP_S
from worldstate_lab.trials.trial import Decide, Decisions, Trial

from .images import SLACK_S, Images, sides


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


@dataclass(frozen=True, slots=True)
class RadarFieldOfView:
    """A forward radar that finds a vehicle in line of sight and within its field of view, scan by scan.

    It raises no false alarm, so that none can be counted, and names a side only: its bearing would be the
    true one, whose error says nothing.
    """

    # Field of view and range of the near scan of a common 77 GHz front radar (Continental ARS 408-21: 60 deg
    # to either side, 70 m, a scan in 72 ms); the probability is what tracking papers assume of such a radar.
    # The range decides nothing at a junction: whatever is in line of sight there is nearer than 70 m, and
    # a real recording does not say how far. Waves of 4 mm neither bend round a corner nor pass a wall; what
    # they reflect off one is clutter to a production radar, so hidden vehicles are not found at all.
    half_view_rad: float = math.radians(60.0)
    detection: float = 0.9
    name: str = "Radar field-of-view model"

    def __post_init__(self) -> None:
        in_range("half_view_rad", self.half_view_rad, 0.0, math.pi)
        in_range("detection", self.detection, 0.0, 1.0)

    def fit(self, calibration: Sequence[Trial], rng: np.random.Generator, /) -> Decide:
        """Return the model with the randomness of its misses: the same for a trial whoever asks, and when."""
        seed = int(rng.integers(1 << 32))
        return lambda trial: self._scanned(trial, seed)

    def _scanned(self, trial: Trial, seed: int) -> Decisions:
        bearing = np.full(len(trial.hops), np.nan)
        if len(trial.truth):
            missed = np.random.default_rng([seed, zlib.crc32(trial.name.encode())])
            found = missed.random(len(trial.truth)) < self.detection
            found &= trial.truth.in_view.astype(bool)
            found &= np.abs(trial.truth.azimuth_rad) <= self.half_view_rad
            time_s = trial.truth.time_s[found]
            # The first hop that ends after the scan reports it, if it is not a whole hop later.
            hop_s = trial.hops.time_s
            hop = np.searchsorted(hop_s + SLACK_S, time_s)
            near = (hop < len(hop_s)) & (hop_s[np.minimum(hop, len(hop_s) - 1)] - time_s < HOP_S - SLACK_S)
            bearing[hop[near]] = trial.truth.azimuth_rad[found][near]
        return Decisions.of(trial.hops.time_s, np.isfinite(bearing), side=sides(bearing))
