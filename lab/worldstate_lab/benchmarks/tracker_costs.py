"""Processing time of a world-state update, compared with a numpy batch and Stone Soup's JPDA.

The batch is the minimum work of a tracker: predict and update n Kalman filters with four states and two
measurements, with known association, by einsum.

Stone Soup's GM-PHD and JPDA filters over azimuth use peaks of a microphone array and boxes of a camera. They
receive the parameters that their theory requires: detection probability and clutter of each sensor, a nearly
constant turn rate, and the sector that the camera searches. In Stone Soup the detection probability is a
single number, so a target outside that sector is excluded from the camera's scan.
"""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import partial
from typing import Any

import numpy as np

from worldstate import Measurement, Present, Sighting, SignatureEvidence, WorldFilter
from worldstate.ground import FloatArray, NotUsable
from worldstate.ground.errors import MissingExtraError
from worldstate.measurement.measurement import Bearing

from .hop_costs import Milliseconds, elapsed_ms

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
END_STD = 0.1  # Standard deviation at the ends of the view: half the width of a car at 9 m
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

    New vehicles appear anywhere ahead or, if the ends of the view are given, at these ends (J. Menezes and M.
    Campbell, arXiv 2605.20666, without its semantic part).
    """

    def __init__(self, ends_rad: Sequence[float] = ()) -> None:
        self._born = [(end, END_STD) for end in ends_rad] or [(0.0, START_STD)]
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
        births = [
            TaggedWeightedGaussianState(
                [[azimuth], [0.0]],
                np.diag([std**2, START_RATE_STD**2]),
                when,
                weight=BIRTHS / len(self._born),
                tag=TaggedWeightedGaussianState.BIRTH,
            )
            for azimuth, std in self._born
        ]
        updater = PHDUpdater(
            _UPDATER,
            clutter_spatial_density=scan.clutter_density,
            prob_detection=scan.detection_probability,
            prob_survival=survival,
        )
        hypotheses = self._hypothesiser.hypothesise([*components, *births], scan.detections, when)
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


ENTITIES = 1, 20
CROWD = 64, 600  # Boxes per image; the filter accepts 64
HOPS, WARM_UP = 40, 20  # Timed hops, and hops before them until tracks are established
_SILENT, _EVEN = NotUsable("not measured"), SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)


def tracker_times(rng: np.random.Generator) -> dict[str, Milliseconds]:
    """Return the processor time of every hop in milliseconds, by method and number of entities."""
    times = dict[str, Milliseconds]()
    for n in (*ENTITIES, *CROWD):
        times[f"update_{n}"], times[f"state_{n}"] = _world_times(hops(n, rng))
    for n in ENTITIES:
        steps = [partial(_batch_step, *_batch(n, rng)) for _ in range(HOPS)]
        times[f"numpy_batch_{n}"] = [elapsed_ms(step, time.process_time) for step in steps]
    return times | {"jpda_1": list(_jpda_times(hops(1, rng)))}


def hops(n: int, rng: np.random.Generator) -> list[Measurement]:
    """Return hops in which a camera detects the same n vehicles, side by side."""
    stand = np.linspace(-0.5, 0.5, n) if n > 1 else np.zeros(1)
    # The deviation falls with the number of vehicles, so that neighbouring boxes remain distinguishable.
    std = min(0.02, 0.2 / n)
    azimuth_rad = stand + rng.normal(0.0, 0.25 * std, (HOPS, n))
    return [
        Measurement(
            100_000_000 * hop,
            _EVEN,
            Present(0.06, 0.01),
            _SILENT,
            _SILENT,
            tuple(Sighting(one, std, "car", 0.9, 0.03) for one in row),
        )
        for hop, row in enumerate(azimuth_rad.tolist(), 1)
    ]


def _world_times(measured: list[Measurement]) -> tuple[Milliseconds, Milliseconds]:
    world, updates, states = WorldFilter(), Milliseconds(), Milliseconds()
    for one in measured:
        start = time.process_time()
        world = world.update(one)
        updates.append(1e3 * (time.process_time() - start))
        states.append(elapsed_ms(partial(getattr, world, "state"), time.process_time))
    return updates[WARM_UP:], states[WARM_UP:]


def _batch(n: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray]:
    return rng.normal(size=(n, 4)), np.tile(np.eye(4), (n, 1, 1)), rng.normal(size=(n, 2))


def _batch_step(mean: FloatArray, covariance: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    flow, row = np.eye(4) + 0.1 * np.eye(4, k=2), np.eye(2, 4)
    mean = np.einsum("ij,nj->ni", flow, mean)
    covariance = np.einsum("ij,njk,lk->nil", flow, covariance, flow) + 0.01 * np.eye(4)
    spread = np.einsum("ij,njk,lk->nil", row, covariance, row) + 0.1 * np.eye(2)
    gain = np.einsum("nij,kj,nkl->nil", covariance, row, np.linalg.inv(spread))
    mean = mean + np.einsum("nij,nj->ni", gain, z - mean @ row.T)
    return mean, covariance - np.einsum("nij,jk,nkl->nil", gain, row, covariance)


def _jpda_times(measured: list[Measurement]) -> Iterator[float]:
    from .tracker_costs import Jpda, scan_time, scans

    tracker = Jpda()
    for hop, one in enumerate(measured):
        taken, when = scans(one, (-0.5, 0.5)), scan_time(one)
        spent_ms = elapsed_ms(partial(tracker.step, taken, when), time.process_time)
        if hop >= WARM_UP:
            yield spent_ms
