"""Filter results on recordings in staged states: dry or rainy sound, clean or degraded camera."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from worldstate.adapters.acoustic import asked_again
from worldstate.adapters.camera.box_linking import overlaps
from worldstate.adapters.camera.camera_health import DegradationLog
from worldstate.adapters.camera.detections import DetectionFilter, DetectionLog, kept_and_parked
from worldstate.adapters.camera.miss_rates import MissRates
from worldstate.adapters.camera.vision_query import MAX_IMAGE_AGE_S, VisionQuery
from worldstate.adapters.listener import measure_steps
from worldstate.adapters.source import Source, unoccluded_sector
from worldstate.core.filter import WorldFilter
from worldstate.frontend.array.steering import one_blas_thread
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.ground.values import nanoseconds
from worldstate.measurement.measurement import Measurement
from worldstate.operations.detectors.miss_rate_measurement import MIN_OVERLAP
from worldstate.operations.recordings.hop_table import HopTable, hop_stream, joined

from .conditions import (
    OFF,
    Condition,
    StagedDetector,
    all_conditions,
    degradation_in,
    detections_in,
    level_rms,
    rained,
)

# Increased whenever the same sound and looks would give different beliefs.
VERSION = 7


@dataclass(frozen=True, slots=True)
class Camera:
    """One detector on the camera of one recording."""

    detector: StagedDetector
    rates: MissRates  # Miss rates of this detector, measured on other recordings
    boxes: HopTable  # Its detections; see `conditions.look`
    readings: HopTable  # Quality of the images

    def look(self, source: Source, images: str, d: DegradationLog) -> VisionQuery:
        """Return the channel to be queried in a condition of the camera."""
        seen, sector = detections_in(self.boxes, images), unoccluded_sector(source.context)
        rates = self.rates
        return VisionQuery(
            source.camera, seen, rates.table, d, self.detector.keep, sector, rates.clutter_rate
        )


def filter_in_conditions(
    source: Source,
    behind: Sequence[Camera],
    seed: Sequence[int],
    conditions: Sequence[Condition] = all_conditions(),
) -> dict[str, HopTable]:
    """Return the filter's results on one recording with each detector, all conditions concatenated.

    Columns are those of a hop stream and four more. `condition` is the name. `degradation` is the estimated
    d. `presence` is the probability of a hidden or visible vehicle, from the entities that the filter
    publishes. `found` is true if a moving object in view was detected, whereas `seen` is true for any
    detection.
    """
    assert source.detections is not None  # They are the reference of a sweep
    rms = level_rms(source)
    with one_blas_thread():
        levels = sorted({state.sound_level for state in conditions})
        heard = {level: _heard(source, level, rms, seed) for level in levels}
        stamps_ns = [one.stamp_ns for one in next(iter(heard.values()))]
        reference = _moving_boxes(source.detections, stamps_ns, DetectionFilter())
        return {
            one.detector.name: joined(
                _filtered(source, one, heard[state.sound_level], reference, state) for state in conditions
            )
            for one in behind
        }


def _heard(source: Source, level: int, dry_rms: float, seed: int | Sequence[int]) -> list[Measurement]:
    """Return the measurements of a recording or stream at a level of rain on the roof."""
    # Every level has the same noise, only louder, so that differences between levels do not come from the
    # noise.
    wet = rained(source, level, dry_rms, np.random.default_rng(seed)) if level else source
    return [measured for _, measured in measure_steps(wet)]


def by_condition(filtered: HopTable) -> dict[str, HopTable]:
    """Split the concatenated conditions of `filter_in_conditions`."""
    names = filtered.columns["condition"]
    first = np.sort(np.unique(names, return_index=True)[1])
    parts = {key: np.split(one, first[1:]) for key, one in filtered.columns.items() if key != "condition"}
    return {
        str(names[start]): replace(filtered, columns={key: split[i] for key, split in parts.items()})
        for i, start in enumerate(first)
    }


def _filtered(
    source: Source,
    camera: Camera,
    measured: Sequence[Measurement],
    reference: Sequence[FloatArray],
    state: Condition,
) -> HopTable:
    stamps_ns = [one.stamp_ns for one in measured]
    query, found, d = None, np.zeros(len(measured), bool), np.ones(len(measured))
    if state.family != OFF:
        read = degradation_in(camera.readings, state.camera.name, camera.rates)
        query = camera.look(source, state.camera.name, read)
        found, d = _found(reference, query, stamps_ns), np.array([read(stamp_ns) for stamp_ns in stamps_ns])
    asked = [asked_again(one, query) for one in measured]
    there = [any(sighting.moving for sighting in m.sightings) for m in measured]
    return hop_stream(asked, name=state.name, there=there).replace(
        presence=np.array(_presence(source, asked)),
        found=found,
        degradation=d,
        condition=np.full(len(asked), state.name),
    )


def _moving_boxes(log: DetectionLog, stamps_ns: Sequence[int], keep: DetectionFilter) -> list[FloatArray]:
    """Return the accepted moving boxes, shape (boxes, 4), of the frame at each stamp."""
    longest_ns, found = nanoseconds(MAX_IMAGE_AGE_S), []
    for number in (log.latest(stamp_ns, longest_ns) for stamp_ns in stamps_ns):
        boxes_px = np.empty((0, 4))
        if number is not None:
            kept, still = kept_and_parked(log, number, keep)
            boxes_px = log.frames[number].boxes_px[kept[~still]]
        found.append(boxes_px)
    return found


def _found(reference: Sequence[FloatArray], query: VisionQuery, stamps_ns: Sequence[int]) -> BoolArray:
    """Return whether a moving reference box was detected at each stamp, counted as for a miss rate."""
    pairs = zip(reference, _moving_boxes(query.detections, stamps_ns, query.keep), strict=True)
    return np.array([(overlaps(there, boxes) >= MIN_OVERLAP).any() for there, boxes in pairs], dtype=bool)


def _presence(source: Source, measurements: Sequence[Measurement]) -> list[float]:
    r"""Return the probability of any vehicle at every hop, :math:`1 - \prod_i (1 - r_i)`.

    It uses the entities and not the explanations: entities keep the evidence of the camera and of the
    sequence while the current window is uninformative.
    """
    world, presence = WorldFilter(context=source.context, policy=source.policy), []
    for measurement in measurements:
        world = world.predict_to(measurement.stamp_ns).update(measurement)
        absent = (1.0 - one.existence_probability for one in world.state.entities if one.moving)
        presence.append(1.0 - math.prod(absent))
    return presence
