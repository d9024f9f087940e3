"""Detections of the vehicle after T0 in staged images: miss rates and awareness.

The reference vehicle is the moving vehicle of the clean boxes, from T0 to the last image that contains it.
Boxes of vehicles parked throughout a recording, and boxes that the library's own memory marks as parked, are
left out.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from worldstate.adapters.camera.detections import PARKED_S, DetectionFilter, DetectionLog, kept_and_parked
from worldstate.adapters.camera.detectors import ALL_MOTION
from worldstate.adapters.camera.miss_rates import FamilyCounts, MissRates
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.ground.typing import BoolArray, IndexArray
from worldstate.ground.values import nanoseconds
from worldstate.operations.detectors.miss_rate_measurement import AbsenceSettings, AbsenceTally
from worldstate_lab.degradation.beta_curves import BetaCurves, beta_curves, pooled, staged_levels
from worldstate_lab.degradation.conditions import FAMILIES, Condition, at_level
from worldstate_lab.metrics.intervals import middle, pooled_share
from worldstate_lab.report.table import Value

from .recordings import NANODET_BOXES, CornerRecording, only
from .staged_video import Staging

# Half the time between two images: a staged image is matched to the clean image of its time.
_NEAR_NS = nanoseconds(0.05)


def _scored(recording: CornerRecording, log: DetectionLog, seen: BoolArray) -> BoolArray:
    """Return which images are scored: from T0 to the last with the vehicle, or those with enough history."""
    if recording.hazard_free:
        return np.asarray(log.stamps_ns >= nanoseconds(PARKED_S))
    after = log.stamps_ns >= nanoseconds(recording.t0_s)
    last = np.flatnonzero(after & seen)
    return np.asarray(after & (np.arange(len(log)) <= (last[-1] if last.size else -1)))


def _share(counts: Iterable[Sequence[int]]) -> float:
    hits, images = np.array([(0, 0), *counts]).sum(axis=0).tolist()
    return hits / images if images else float("nan")


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
