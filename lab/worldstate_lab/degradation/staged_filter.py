"""Filter one recording in every condition: its sound heard dry and in the rain, its camera as it was seen."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from worldstate.adapters.acoustic import asked_again
from worldstate.adapters.camera.box_linking import kept_and_parked, overlaps
from worldstate.adapters.camera.camera_health import DegradationLog
from worldstate.adapters.camera.detections import DetectionFilter, DetectionLog
from worldstate.adapters.camera.miss_rates import MissRates
from worldstate.adapters.camera.vision_query import VisionQuery, VisionSettings
from worldstate.adapters.listen import Source, measure_steps, unoccluded_sector
from worldstate.core.filter import WorldFilter
from worldstate.ground.blas_threads import one_blas_thread
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.ground.values import nanoseconds
from worldstate.measurement.measurement import Measurement
from worldstate.operations.detectors.miss_rate_measurement import AbsenceSettings
from worldstate.operations.recordings.hop_stream import hop_stream
from worldstate.operations.recordings.hop_table import HopTable, joined

from .conditions import OFF, Condition, all_conditions, level_rms, rained
from .looks import READINGS, StagedDetector, degradation_in, detections_in

# Changes whenever the same sound and looks would give other beliefs.
VERSION = 5


@dataclass(frozen=True, slots=True)
class Camera:
    """One detector behind the camera of one recording."""

    detector: StagedDetector
    rates: MissRates  # Of this detector, measured on other recordings
    boxes: HopTable  # What it reported; see `looks.look`
    readings: HopTable  # Quality of the images

    def look(self, source: Source, images: str, d: DegradationLog) -> VisionQuery:
        """Return the channel that is asked in a condition of the camera."""
        return VisionQuery(
            source.camera,
            detections_in(self.boxes, images),
            self.rates.table,
            d,
            VisionSettings(keep=self.detector.keep),
            unoccluded_sector(source.context),
            self.rates.clutter_rate,
        )


def cameras(
    detectors: Iterable[StagedDetector], rates: Mapping[str, MissRates], looks: Mapping[str, HopTable]
) -> list[Camera]:
    """Return every detector with what it reported of one recording."""
    return [Camera(one, rates[one.name], looks[one.name], looks[READINGS]) for one in detectors]


def filter_in_conditions(
    source: Source,
    behind: Sequence[Camera],
    seed: Sequence[int],
    conditions: Sequence[Condition] = all_conditions(),
) -> dict[str, HopTable]:
    """Return what the filter made of one recording with each detector, all conditions end to end.

    Columns are those of a hop stream and `condition`; `degradation`, d as it was estimated; `presence`, the
    chance that anybody is there, hidden or visible, by the entities that the filter publishes; and `found`,
    whether a moving object that is in view was detected, where `seen` takes any detection.
    """
    rms = level_rms(source)

    def at(level: int) -> Source:
        # The same drops at every level, only louder: what differs between levels is no draw of the noise.
        return rained(source, level, rms, np.random.default_rng(seed)) if level else source

    with one_blas_thread():
        levels = sorted({state.sound_level for state in conditions})
        heard = {level: [measured for _, measured in measure_steps(at(level))] for level in levels}
        reference = _reference(source, [one.stamp_ns for one in next(iter(heard.values()))])
        return {
            one.detector.name: joined(
                _filtered(source, one, heard[state.sound_level], reference, state) for state in conditions
            )
            for one in behind
        }


def by_condition(filtered: HopTable) -> dict[str, HopTable]:
    """Take the conditions apart that `filter_in_conditions` put end to end."""
    names = filtered.columns["condition"]
    first = np.sort(np.unique(names, return_index=True)[1])
    parts = {
        key: np.split(column, first[1:]) for key, column in filtered.columns.items() if key != "condition"
    }
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


def _reference(source: Source, stamps_ns: Sequence[int]) -> list[FloatArray]:
    """Return the moving boxes that are there at each stamp."""
    if source.detections is None:
        return [np.empty((0, 4))] * len(stamps_ns)
    return _moving_boxes(source.detections, stamps_ns, DetectionFilter())


def _moving_boxes(log: DetectionLog, stamps_ns: Sequence[int], keep: DetectionFilter) -> list[FloatArray]:
    """Return the moving boxes that count, shape (boxes, 4), of the frame at each stamp."""
    longest_ns, found = nanoseconds(VisionSettings().max_frame_age_s), []
    for number in (log.latest(stamp_ns, longest_ns) for stamp_ns in stamps_ns):
        boxes_px = np.empty((0, 4))
        if number is not None:
            kept, still = kept_and_parked(log, number, keep)
            boxes_px = log.frames[number].boxes_px[kept[~still]]
        found.append(boxes_px)
    return found


def _found(reference: Sequence[FloatArray], query: VisionQuery, stamps_ns: Sequence[int]) -> BoolArray:
    """Whether a moving box of the reference was found again at each stamp, as a miss rate counts it."""
    least = AbsenceSettings().min_overlap
    detected = _moving_boxes(query.detections, stamps_ns, query.settings.keep) if query.detections else []
    found = [
        (overlaps(there, boxes) >= least).any() for there, boxes in zip(reference, detected, strict=True)
    ]
    return np.array(found, dtype=bool)


def _presence(source: Source, measurements: Sequence[Measurement]) -> list[float]:
    r"""Return the chance that anybody is there at every hop, :math:`1 - \prod_i (1 - r_i)`.

    Of the entities, not of the explanations: what the camera has shown, or the sequence has told, stays in
    them while the window at hand tells nothing.
    """
    world, presence = WorldFilter(context=source.context, policy=source.policy), []
    for measurement in measurements:
        world = world.predict_to(measurement.stamp_ns).update(measurement)
        absent = (1.0 - one.existence_probability for one in world.state.entities if one.moving)
        presence.append(1.0 - math.prod(absent))
    return presence
