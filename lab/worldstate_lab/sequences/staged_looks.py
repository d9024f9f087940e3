"""Detections of the vehicle after T0, clean and staged: accepted boxes, miss rates, awareness.

The reference vehicle is the moving vehicle of the clean boxes, from T0 to the last image that contains it.
Boxes of vehicles parked throughout a recording, and boxes that the library's own memory marks as parked, are
left out.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from pathlib import Path

import numpy as np

from worldstate.adapters.camera.detections import PARKED_S, DetectionFilter, DetectionLog, kept_and_parked
from worldstate.adapters.camera.detectors import ALL_MOTION
from worldstate.adapters.camera.miss_rates import FamilyCounts, MissRates
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.ground.values import nanoseconds
from worldstate.operations.detectors.miss_rate_measurement import AbsenceSettings, AbsenceTally
from worldstate_lab.degradation.beta_curves import BetaCurves, beta_curves, pooled, staged_levels
from worldstate_lab.degradation.conditions import FAMILIES, Condition, at_level
from worldstate_lab.metrics.intervals import middle, pooled_share
from worldstate_lab.report.table import Value

from .recordings import NANODET_BOXES, CornerRecording, only
from .staged_video import Staging

# Candidates; the detector reports no score below the first.
LEAST_SCORES = (0.3, 0.35, 0.4, 0.45, 0.5, 0.6, 0.75)
LEAST_HEIGHTS_PX = (0.0, 20.0, 30.0, 40.0, 60.0, 80.0, 100.0)
# Half the time between two images: a staged image is matched to the clean image of its time.
_NEAR_NS = nanoseconds(0.05)
_EVERY_BOX = DetectionFilter(NANODET_BOXES.labels, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class BoxChoice:
    """Minimum score and height of a box, and the shares of images that they accept.

    Examples
    --------
    >>> round(BoxChoice(0.3, 60.0, found=0.84, false=0.02).gain, 2)
    0.82
    """

    min_score: float
    min_height_px: float
    found: float  # Share of the images after T0 with a moving vehicle
    false: float  # Share of the hazard-free images with one

    @property
    def gain(self) -> float:
        """The difference that the choice maximises."""
        return self.found - self.false


@dataclass(frozen=True, slots=True)
class WatchedImages:
    """Score and height of the moving vehicles, shape (n, 2), in each scored image of a recording."""

    junction: str
    hazard_free: bool
    images: tuple[FloatArray, ...]

    def seen(self, min_score: float, min_height_px: float) -> int:
        """Return the number of images with an accepted box."""
        scored = ((one[:, 0] >= min_score, one[:, 1] > min_height_px) for one in self.images)
        return sum(bool((likely & high).any()) for likely, high in scored)


def watched_images(recording: CornerRecording) -> WatchedImages:
    """Return the moving vehicles in the clean boxes of a recording."""
    log = recording.boxes()
    moving = [_scores_and_heights(log, at) for at in range(len(log))]
    seen = np.array([bool(len(one)) for one in moving])
    kept = np.flatnonzero(_scored(recording, log, seen)).tolist()
    return WatchedImages(recording.junction, recording.hazard_free, tuple(moving[at] for at in kept))


def _scores_and_heights(log: DetectionLog, at: int) -> FloatArray:
    kept, still = kept_and_parked(log, at, _EVERY_BOX)
    here, moving = log.frames[at], kept[~still]
    heights = here.boxes_px[moving, 3] - here.boxes_px[moving, 1]
    return np.column_stack([here.scores[moving], heights])


def _scored(recording: CornerRecording, log: DetectionLog, seen: BoolArray) -> BoolArray:
    """Return which images are scored: from T0 to the last with the vehicle, or those with enough history."""
    if recording.hazard_free:
        return np.asarray(log.stamps_ns >= nanoseconds(PARKED_S))
    after = log.stamps_ns >= nanoseconds(recording.t0_s)
    last = np.flatnonzero(after & seen)
    return np.asarray(after & (np.arange(len(log)) <= (last[-1] if last.size else -1)))


def box_choices(watched: Sequence[WatchedImages]) -> tuple[BoxChoice, ...]:
    """Return the accepted shares of every minimum score and height, the largest gain first.

    Examples
    --------
    >>> high, low = (np.array([[0.5, height]]) for height in (90.0, 25.0))
    >>> watched = [WatchedImages("SA1", False, (high, high)), WatchedImages("SA1", True, (low, low[:0]))]
    >>> best = box_choices(watched)[0]
    >>> best.min_height_px, best.found, best.false
    (30.0, 1.0, 0.0)
    """
    tried = [_choice(watched, *pair) for pair in product(LEAST_SCORES, LEAST_HEIGHTS_PX)]
    return tuple(sorted(tried, key=lambda one: -one.gain))


def _choice(watched: Sequence[WatchedImages], min_score: float, min_height_px: float) -> BoxChoice:
    counts = [(one.hazard_free, one.seen(min_score, min_height_px), len(one.images)) for one in watched]
    found, false = (_share(two for free, *two in counts if free is kind) for kind in (False, True))
    return BoxChoice(min_score, min_height_px, found, false)


def _share(counts: Iterable[Sequence[int]]) -> float:
    hits, images = np.array([(0, 0), *counts]).sum(axis=0).tolist()
    return hits / images if images else float("nan")


def left_out_choices(watched: Sequence[WatchedImages]) -> dict[str, BoxChoice]:
    """Return the best choice without each junction, with its shares at that junction."""
    found = {}
    for junction in sorted({one.junction for one in watched}):
        best = box_choices([one for one in watched if one.junction != junction])[0]
        there = [one for one in watched if one.junction == junction]
        found[junction] = _choice(there, best.min_score, best.min_height_px)
    return found


def kept_boxes(detector: str) -> DetectionFilter:
    """Return the filter for the boxes of a detector."""
    return ALL_MOTION if detector == "motion" else NANODET_BOXES


def moving_in(log: DetectionLog, keep: DetectionFilter) -> BoolArray:
    """Return which images contain a moving vehicle, shape (n,)."""
    return np.array([not kept_and_parked(log, at, keep)[1].all() for at in range(len(log))], bool)


@dataclass(frozen=True, slots=True)
class VisionRow:
    """Detections of a camera alone in one state."""

    state: str
    looks: int  # Number of searched images after T0
    aware: Value  # Share of these images with a moving vehicle
    hazard_free: dict[str, float]  # The same share of hazard-free images, by junction


def vision_row(
    staging: Staging, state: Condition, recordings: Sequence[CornerRecording], draws: IndexArray
) -> VisionRow:
    """Return the awareness from staged boxes; `draws` (draws, approaches) lists each draw's approaches."""
    counted = [_looks(staging, state, one) for one in recordings]
    hits, looks = np.array(
        [two for two, one in zip(counted, recordings, strict=True) if not one.hazard_free], np.float64
    ).T
    share, drawn = pooled_share(hits, looks, draws)
    free = [(one.junction, two) for one, two in zip(recordings, counted, strict=True) if one.hazard_free]
    names = sorted({junction for junction, _ in free})
    shares = {name: _share(two for junction, two in free if junction == name) for name in names}
    return VisionRow(state.name, int(looks.sum()), Value(share, *middle(drawn)), shares)


def _looks(staging: Staging, state: Condition, recording: CornerRecording) -> tuple[int, int]:
    """Return the number of scored images with a moving vehicle, and of searched images."""
    staged = _boxes_in(staging.folder(state), recording)
    asked = np.array([at is not None for at in _clean_images(recording, staged)], bool)
    return int((moving_in(staged, kept_boxes(staging.detector)) & asked).sum()), int(asked.sum())


def _clean_images(recording: CornerRecording, staged: DetectionLog) -> list[int | None]:
    """Return the number of the clean image of each staged image, None if it is not scored."""
    clean, scored = _clean_boxes(recording)
    numbers = (clean.latest(stamp_ns, _NEAR_NS) for stamp_ns in staged.stamps_ns.tolist())
    return [at if at is not None and scored[at] else None for at in numbers]


# Parked vehicles are searched for in every image (0.2 s per file), and both vision and beta need the result.
@lru_cache(maxsize=1024)
def _boxes_in(folder: Path, recording: CornerRecording) -> DetectionLog:
    return recording.boxes(folder.absolute())


@lru_cache(maxsize=128)
def _clean_boxes(recording: CornerRecording) -> tuple[DetectionLog, BoolArray]:
    """Return the clean boxes, and which images are scored."""
    clean = recording.boxes()
    return clean, _scored(recording, clean, moving_in(clean, NANODET_BOXES))


def staged_beta(staging: Staging, approaches: Sequence[CornerRecording], draws: IndexArray) -> BetaCurves:
    """Return beta(theta, d) of the reference vehicle after T0, by family of the paper."""
    return beta_curves([_beta_counts(staging, one) for one in approaches], draws)


def staged_miss_rates(staging: Staging, approaches: Sequence[CornerRecording]) -> MissRates:
    """Return the same counts in the library's format: the miss rates of this detector."""
    families = pooled([_beta_counts(staging, one) for one in approaches])
    edges_deg = AbsenceSettings(FAMILIES, NANODET_BOXES).edges_deg(PinholeCamera.ovad())
    return MissRates(edges_deg, families, {"detector": staging.detector, "images": "staged real videos"})


def _beta_counts(staging: Staging, recording: CornerRecording) -> dict[str, FamilyCounts]:
    tally = AbsenceTally(PinholeCamera.ovad(), AbsenceSettings(FAMILIES, NANODET_BOXES))
    clean, _ = _clean_boxes(recording)
    keep = kept_boxes(staging.detector)
    for family, level in staged_levels():
        staged = _boxes_in(staging.folder(at_level(family, level)), recording)
        for at, found in zip(_clean_images(recording, staged), staged.frames, strict=True):
            if at is not None:
                tally.count(clean, at, only(found, found.select(keep)), family, level)
    return tally.counts()
