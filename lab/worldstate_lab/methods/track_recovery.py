"""Recovery of a lost vehicle by a tracker's motion model, as a row of Table I."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.operations.recordings.hop_table import HopTable
from worldstate_lab.trials.trial import TRACK_COLUMNS, Decide, Decisions, Trial

from .images import Images, sides, vehicles
from .oc_sort import OcSort, TrackedBox

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
    camera: PinholeCamera = field(default_factory=PinholeCamera)

    @property
    def name(self) -> str:
        """As in the report."""
        return f"OC-SORT recovery ({self.reading})"

    def fit(self, calibration: Sequence[Trial], rng: np.random.Generator, /) -> Decide:
        """Return the tracker at its published settings: nothing is fitted."""
        return self._decide

    def _decide(self, trial: Trial) -> Decisions:
        images, time_s = Images.of(trial), trial.hops.time_s
        held = [[one for one in tracks if self._holds(one)] for tracks in _moving_tracks(trial, images)]
        rows = [
            (hop, one.track, self._azimuth_rad(one), _area(one))
            for hop, image in enumerate(images.of_hop)
            for one in (held[image] if image >= 0 else ())
        ]
        bearing = np.full(len(time_s), np.nan)
        # In the order of area, so that the largest box of a hop is the one that stays.
        for hop, _, azimuth_rad, _ in sorted(rows, key=lambda row: row[3]):
            bearing[hop] = azimuth_rad
        tracks = HopTable.of_rows(TRACK_COLUMNS, [(time_s[hop], track, at) for hop, track, at, _ in rows])
        found = np.isfinite(bearing)
        return Decisions.of(time_s, found, side=sides(bearing), bearing_rad=bearing, tracks=tracks)

    def _holds(self, one: TrackedBox) -> bool:
        # A box that flashed up once never was a track: nobody would coast on it.
        return one.certain if self.reading == "stock" else one.known

    def _azimuth_rad(self, one: TrackedBox) -> float:
        return float(self.camera.azimuth(0.5 * (one.box_px[0] + one.box_px[2])))


def _area(one: TrackedBox) -> float:
    return float(np.prod(one.box_px[2:] - one.box_px[:2]))


def _moving_tracks(trial: Trial, images: Images) -> Iterator[list[TrackedBox]]:
    """Yield the tracks of moving vehicles in every image."""
    boxes, sort, moving = trial.boxes, OcSort(), set[int]()
    # Parked vehicles are tracked as well and left out afterwards: given moving boxes alone, a parked car
    # would begin a track in the first second, before it is known to stand, and coast into scored time.
    counted = np.flatnonzero(vehicles(boxes)) if len(boxes) else np.empty(0, np.intp)
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
