"""The images of a trial in the order of time, those without boxes included."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from worldstate.adapters.camera.detections import DetectionFilter
from worldstate.ground.typing import BoolArray, FloatArray, IntArray
from worldstate.operations.recordings.hop_stream import HOP_S
from worldstate.operations.recordings.hop_table import HopTable
from worldstate_lab.trials.trial import Trial

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


def vehicles(boxes: HopTable) -> BoolArray:
    """Return which boxes count by the filter of OVAD's authors, parked or moving, shape (n,)."""
    # The table says which boxes move, and those that do count already: only parked ones are looked up.
    keep = DetectionFilter()
    high = boxes.box_px[:, 3] - boxes.box_px[:, 1] > keep.min_height_px
    return np.asarray(np.isin(boxes.class_name, list(keep.labels)) & (boxes.score >= keep.min_score) & high)


def sides(bearing_rad: FloatArray) -> IntArray:
    """Return the side of each bearing, none where it is NaN."""
    return np.nan_to_num(np.sign(bearing_rad)).astype(np.int64)  # Left is positive in both
