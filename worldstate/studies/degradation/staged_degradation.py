"""Filter the same measured sound with its camera in every staged state and without one."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.adapters.acoustic import AcousticAdapter
from worldstate.adapters.camera.camera_channel import Watched
from worldstate.adapters.camera.detections import DetectionLog
from worldstate.adapters.camera.detector import overlaps
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.vision_query import VisionQuery, moving_boxes
from worldstate.adapters.listen import Source, measure_steps, unoccluded_sector
from worldstate.core.filter import WorldFilter
from worldstate.frontend.stream import AcousticFrame
from worldstate.ground.typing import FloatArray
from worldstate.measurement.measurement import Measurement
from worldstate.operations.detectors.miss_rate_measurement import AbsenceSettings
from worldstate.operations.recordings.hop_stream import hop_stream
from worldstate.operations.recordings.hop_table import HopTable

from .degraded_detections import OFF, Staging

Heard = tuple[AcousticFrame, Measurement]
# One recording in every state of its camera: a hop stream with `degradation`, d as it was estimated;
# `presence`, P(hidden) + P(visible) of the filter; and `found`, whether a moving object that is in view was
# detected, where `seen` takes any detection.
StagedHops = Mapping[str, HopTable]


def filter_in_states(
    source: Source, detections: Mapping[str, Watched], staging: Staging, *, name: str, label: str
) -> StagedHops:
    """Return what the filter made of one recording with its camera in every state, and without it."""
    # The sound is processed once. The last state is that of a camera that is never asked.
    measured = list(measure_steps(source))
    stamps_ns = [frame.stamp_ns for frame, _ in measured]
    there = [any(sighting.moving for sighting in m.sightings) for _, m in measured]
    reference, sight = _reference(source, staging, stamps_ns), unoccluded_sector(source.context)

    def in_state(query: VisionQuery | None, found: Sequence[bool], degradation: Sequence[float]) -> HopTable:
        asked = list(_asked(source, measured, query))
        stream = hop_stream(asked, name=name, label=label, t0_s=source.t0_s, there=there)
        presence = np.array(_presence(source, asked))
        return stream.replace(presence=presence, found=np.array(found), degradation=np.array(degradation))

    staged = {
        state: in_state(
            VisionQuery(
                staging.camera,
                seen.detections,
                staging.rates.table,
                seen.degradation,
                staging.settings,
                sight,
                staging.rates.clutter_rate,
            ),
            _found(reference, seen.detections, staging, stamps_ns),
            [seen.degradation(stamp_ns) for stamp_ns in stamps_ns],
        )
        for state, seen in detections.items()
    }
    return staged | {OFF: in_state(None, [False] * len(measured), [1.0] * len(measured))}


def _reference(source: Source, staging: Staging, stamps_ns: Sequence[int]) -> list[FloatArray]:
    """Return the reference's moving boxes at each stamp, in pixels of the video, which may be smaller."""
    if source.detections is None:
        return [np.empty((0, 4))] * len(stamps_ns)
    whole, camera = PinholeCamera(), staging.camera
    scale = np.tile([camera.width_px / whole.width_px, camera.height_px / whole.height_px], 2)
    return [boxes_px * scale for boxes_px in moving_boxes(source.detections, stamps_ns)]


def _found(
    reference: Sequence[FloatArray], log: DetectionLog, staging: Staging, stamps_ns: Sequence[int]
) -> list[bool]:
    """Whether a moving box of the reference was found again at each stamp, as a miss rate counts it."""
    detected, least = moving_boxes(log, stamps_ns, staging.settings), AbsenceSettings().min_overlap
    return [bool((overlaps(a, b) >= least).any()) for a, b in zip(reference, detected, strict=True)]


class _Again:
    """Repeats the evidence of every hop in the same order."""

    def __init__(self, measured: Sequence[Heard]) -> None:
        self._said = iter([measurement.signature for _, measurement in measured])

    def evidence(self, feature: ArrayLike, /) -> SignatureEvidence:
        return next(self._said)


def _asked(source: Source, measured: Sequence[Heard], query: VisionQuery | None) -> Iterator[Measurement]:
    """Query the camera again at every hop."""
    # Frames are only interpreted, so the rate of the sound does not matter here.
    adapter = AcousticAdapter(source.array, 48_000.0, _Again(measured), vision=query)
    return (adapter.interpret(frame) for frame, _ in measured)


def _presence(source: Source, measurements: Sequence[Measurement]) -> list[float]:
    """P(hidden) + P(visible) of the filter at every hop."""
    world, presence = WorldFilter(context=source.context, policy=source.policy), []
    for measurement in measurements:
        world = world.predict_to(measurement.stamp_ns).update(measurement)
        presence.append(1.0 - world.explanation.none)
    return presence
