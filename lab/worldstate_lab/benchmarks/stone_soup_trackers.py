"""Stone Soup's GM-PHD and JPDA filters over azimuth, on peaks of a microphone array and boxes of a camera.

They receive the parameters that their theory requires: detection probability and clutter of each sensor, a
nearly constant turn rate, and the sector that the camera searches. In Stone Soup the detection probability is
a single number, so a target outside that sector is excluded from the camera's scan.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from worldstate import Measurement, Sighting
from worldstate.ground.errors import MissingExtraError
from worldstate.measurement.measurement import Bearing

try:
    from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
    from stonesoup.dataassociator.probability import JPDA
    from stonesoup.deleter.time import UpdateTimeDeleter
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.hypothesiser.gaussianmixture import GaussianMixtureHypothesiser
    from stonesoup.hypothesiser.probability import PDAHypothesiser
    from stonesoup.initiator.simple import MultiMeasurementInitiator
    from stonesoup.measures import Mahalanobis
    from stonesoup.mixturereducer.gaussianmixture import GaussianMixtureReducer
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.state import GaussianState, TaggedWeightedGaussianState
    from stonesoup.updater.kalman import KalmanUpdater
    from stonesoup.updater.pointprocess import PHDUpdater
    from stonesoup.updater.probability import PDAUpdater
except ImportError as error:
    raise MissingExtraError("stonesoup", "oracles") from error

# A peak comes from a hidden vehicle in one of four windows, as in the filter. In the other three, and in an
# empty street, its direction is uniform ahead.
PEAK_DETECTION, PEAK_CLUTTER = 0.25, 1.0 / np.pi
BOX_DETECTION, BOX_CLUTTER = 0.94, 0.01
TURN_PSD = 0.014  # 2 m^2/s^3 at 12 m, rad^2/s^3
START_STD, START_RATE_STD = 0.7, 0.4  # Vehicles start ahead within 80 degrees, with 5 m/s at 12 m
BIRTHS = 0.01  # Rate per hop: one vehicle in ten seconds
HITS = 3  # Boxes that confirm a track, as in OC-SORT
# Longest times without a box: while the camera searches there, and in any case
MISSED_S, UNSEEN_S = 0.35, 3.0
_EPOCH = datetime(2000, 1, 1)
_TURN = CombinedLinearGaussianTransitionModel([ConstantVelocity(TURN_PSD)])
_PREDICTOR, _UPDATER = KalmanPredictor(_TURN), KalmanUpdater(None)


@dataclass(frozen=True, slots=True)
class SensorScan:
    """The detections of one sensor at one hop."""

    detections: tuple[Any, ...]
    detection_probability: float
    clutter_density: float  # False detections per radian
    sector_rad: tuple[float, float]  # Searched sector, from right to left

    def searches(self, state: Any) -> bool:
        """Return whether the estimated target is in the sector."""
        return bool(self.sector_rad[0] <= float(state.state_vector[0]) <= self.sector_rad[1])


def scans(measurement: Measurement, view_rad: tuple[float, float]) -> tuple[SensorScan, SensorScan]:
    """Return the detections of the array and of the camera at a hop."""
    when = scan_time(measurement)
    heard = [measurement.bearing] if isinstance(measurement.bearing, Bearing) else []
    view = max(view_rad[1] - view_rad[0], 0.1)
    return (
        SensorScan(_detected(heard, when), PEAK_DETECTION, PEAK_CLUTTER, (-np.inf, np.inf)),
        SensorScan(_detected(measurement.sightings, when), BOX_DETECTION, BOX_CLUTTER / view, view_rad),
    )


def scan_time(measurement: Measurement) -> datetime:
    """Return the time of a measurement as a `datetime`, as Stone Soup requires."""
    return _EPOCH + timedelta(microseconds=measurement.stamp_ns // 1000)


def _detected(found: Iterable[Bearing | Sighting], when: datetime) -> tuple[Any, ...]:
    return tuple(
        Detection([one.azimuth_rad], when, measurement_model=LinearGaussian(2, (0,), [[one.std_rad**2]]))
        for one in found
    )


class GmPhd:
    """The Gaussian-mixture PHD filter: azimuths of the components with a weight above one half.

    New vehicles appear anywhere ahead.
    """

    def __init__(self) -> None:
        self._reducer = GaussianMixtureReducer(
            prune_threshold=1e-3, merge_threshold=4.0, max_number_components=20
        )
        gated = DistanceHypothesiser(_PREDICTOR, _UPDATER, Mahalanobis(), missed_distance=4.0)
        self._hypothesiser = GaussianMixtureHypothesiser(gated, order_by_detection=True)
        self._components: list[Any] = []

    def step(self, scans: Iterable[SensorScan], when: datetime) -> list[float]:
        """Process the scans of a hop."""
        # Stone Soup applies survival at every update, but it must apply once per hop, not once per sensor.
        for scan, survival in zip(scans, (0.99, 1.0), strict=True):
            searched = [one for one in self._components if scan.searches(one)]
            others = [one for one in self._components if not scan.searches(one)]
            self._components = others + self._updated(searched, scan, survival, when)
        return [float(one.state_vector[0]) for one in self._components if one.weight > 0.5]

    def _updated(self, components: list[Any], scan: SensorScan, survival: float, when: datetime) -> list[Any]:
        birth = TaggedWeightedGaussianState(
            [[0.0], [0.0]],
            np.diag([START_STD**2, START_RATE_STD**2]),
            when,
            weight=BIRTHS,
            tag=TaggedWeightedGaussianState.BIRTH,
        )
        updater = PHDUpdater(
            _UPDATER,
            clutter_spatial_density=scan.clutter_density,
            prob_detection=scan.detection_probability,
            prob_survival=survival,
        )
        hypotheses = self._hypothesiser.hypothesise([*components, birth], scan.detections, when)
        return list(self._reducer.reduce(list(updater.update(hypotheses))))


class Jpda:
    """Joint probabilistic data association: azimuths of its tracks, which only boxes start and keep alive."""

    # Every hop has a peak: if peaks could start tracks, the first one would never end, because JPDA has no
    # existence probability.
    def __init__(self) -> None:
        nearest = GNNWith2DAssignment(
            DistanceHypothesiser(_PREDICTOR, _UPDATER, Mahalanobis(), missed_distance=4.0)
        )
        start = GaussianState(np.zeros((2, 1)), np.diag([0.0, START_RATE_STD**2]))
        late = UpdateTimeDeleter(timedelta(seconds=MISSED_S))
        self._initiator = MultiMeasurementInitiator(start, late, nearest, _UPDATER, min_points=HITS)
        self._reducing = PDAUpdater(None, gm_method=True)
        self._seen: dict[Any, datetime] = {}

    def step(self, scans: Iterable[SensorScan], when: datetime) -> list[float]:
        """Process the scans of a hop."""
        peaks, boxes = scans
        self._associated(peaks, when)
        named = self._associated(boxes, when)
        started = self._initiator.initiate(set(boxes.detections) - named, when)
        self._seen |= dict.fromkeys(started, when)
        for track, seen in list(self._seen.items()):
            patience_s = MISSED_S if boxes.searches(track) else UNSEEN_S
            if (when - seen).total_seconds() > patience_s:
                del self._seen[track]
        return [float(track.state_vector[0]) for track in self._seen]

    def _associated(self, scan: SensorScan, when: datetime) -> set[Any]:
        """Update the tracks with a scan; return the detections that are more likely assigned than not."""
        tracks = {track for track in self._seen if scan.searches(track)}
        hypothesiser = PDAHypothesiser(
            _PREDICTOR, _UPDATER, scan.clutter_density, scan.detection_probability, prob_gate=0.999
        )
        named: set[Any] = set()
        for track, hypotheses in JPDA(hypothesiser).associate(tracks, set(scan.detections), when).items():
            track.append(self._reducing.update(hypotheses))
            missed = next(one.probability for one in hypotheses if not one)
            mine = {one.measurement for one in hypotheses if one and one.probability > missed}
            # Only boxes keep a track alive.
            if mine and scan.detection_probability == BOX_DETECTION:
                self._seen[track] = when
            named |= mine
        return named
