"""Learning of a street from the passes of a recording and from the sound before them."""

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worldstate.abduction.sequence.sequence_model import SequenceModel
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.abduction.sequence.street_sides import PassSound, arrival_pattern, coming_probability
from worldstate.adapters.camera.detections import DetectionFilter, DetectionLog
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.files.acoustic_domain import heard_with
from worldstate.adapters.files.file_io import read_record, write_json
from worldstate.adapters.files.model_file import Model
from worldstate.adapters.listener import measure_steps
from worldstate.adapters.source import Source, open_source
from worldstate.ground import NotUsable, OutOfDomainError, seconds
from worldstate.ground.serialisation import encode
from worldstate.ground.typing import FloatArray
from worldstate.smoothing.learned_street import LearnedStreet, StreetPass, watched, with_pass

from .pass_labels import PassLabel, box_tracks, label_passes

# No vehicle comes from an arm closer to the axis: such a track is an overtaking vehicle, or two vehicles.
_LEAST_EDGE_RAD = math.radians(5.0)
# Slower vehicles turn off or park behind the corner; faster tracks are two vehicles.
_SLOWEST_HZ, _FASTEST_HZ = 0.05, 3.0
# Time before T0 in which a vehicle is audible.
_HEARD_S = 3.0

_UNHEARD = "what the arms sound like is not learned: %s"
_LOG = logging.getLogger(__name__)


def street_pass(one: PassLabel, sound: PassSound | None = None) -> StreetPass:
    """Return the contribution of a labelled pass to its arm: edge, pace, and the sound before it."""
    x, y, vx, vy = (float(np.interp(one.t0.time_s, one.track.time_s, row)) for row in one.track.states.T)
    pace_hz = abs(vy * x - y * vx) / max(x * x, 1e-9)
    # The first box may not be at the edge of this arm.
    outwards_rad = one.edge_rad if one.arm == "left" else -one.edge_rad
    edge_rad = one.edge_rad if outwards_rad >= _LEAST_EDGE_RAD else None
    usual_hz = pace_hz if _SLOWEST_HZ <= pace_hz <= _FASTEST_HZ else None
    return StreetPass("left" if one.arm == "left" else "right", edge_rad, usual_hz, sound)


@dataclass(frozen=True, slots=True, eq=False)
class HeardStreet:
    """Arrival pattern of the sound at every hop, and the probability that a vehicle was coming."""

    time_s: FloatArray  # shape (n,)
    patterns: FloatArray  # shape (n, 12), from `arrival_pattern`
    coming: FloatArray  # shape (n,)
    heard_by: str

    def before(self, one: PassLabel, every: Sequence[PassLabel]) -> PassSound | None:
        """Return the sound of a pass while it was hidden; None if a vehicle came from the other arm."""
        t0_s = one.t0.time_s
        if any(other.arm != one.arm and abs(other.t0.time_s - t0_s) < _HEARD_S for other in every):
            return None
        hidden = (self.time_s >= t0_s - _HEARD_S) & (self.time_s < t0_s)
        if not hidden.any():
            return None
        return PassSound(self.patterns[hidden], self.coming[hidden], self.heard_by)


@dataclass(frozen=True, slots=True, eq=False)
class WatchedRecording:
    """Passes that a camera saw on a street in one recording, and the sound."""

    passes: Sequence[PassLabel]
    duration_s: float
    heard: HeardStreet | None = None  # Sound of the same time, if available


def watched_recording(
    log: DetectionLog, camera: PinholeCamera, keep: DetectionFilter, duration_s: float
) -> WatchedRecording:
    """Return the smoothed passes of a recording."""
    return WatchedRecording(label_passes(box_tracks(log, camera, keep), camera.position_m[0]), duration_s)


def streets_after(street: LearnedStreet, recording: WatchedRecording) -> Iterator[LearnedStreet]:
    """Yield a street after every pass of a recording, and once more at the end of the recording."""
    before_s = 0.0
    for one in sorted(recording.passes, key=lambda one: one.t0.time_s):
        now_s = min(max(one.t0.time_s, before_s), recording.duration_s)
        sound = None if recording.heard is None else recording.heard.before(one, recording.passes)
        street = with_pass(watched(street, now_s - before_s), street_pass(one, sound))
        before_s = now_s
        yield street
    yield watched(street, recording.duration_s - before_s)


def heard_street(source: Source, model: Model) -> HeardStreet | None:
    """Apply a model to a whole recording; return None with a warning if the sound is outside its domain.

    Hops without a result of the sequence are skipped.
    """
    try:
        listened = open_source(source.sound, array=source.array, model=model)
    except OutOfDomainError as error:
        _LOG.warning(_UNHEARD, error)
        return None
    if model.domain is None or not isinstance(listened.sequence, SequenceModel):
        told = listened.sequence
        _LOG.warning(_UNHEARD, told.reason if isinstance(told, NotUsable) else "the model file has no array")
        return None
    read = [
        (seconds(frame.stamp_ns), frame.feature, measured.sequence.groups)
        for frame, measured in measure_steps(listened)
        if isinstance(measured.sequence, SequenceReading)
    ]
    if not read:
        _LOG.warning(_UNHEARD, "the recording is too short")
        return None
    time_s, features, groups = map(np.array, zip(*read, strict=True))
    patterns, coming = arrival_pattern(features), coming_probability(groups)
    return HeardStreet(time_s, patterns, coming, heard_with(model.domain))


def write_street(path: str | Path, street: LearnedStreet) -> None:
    """Write a street to a file, atomically."""
    write_json(path, encode(street))


def read_street(path: str | Path) -> LearnedStreet:
    """Read a file written by `write_street`.

    Raises
    ------
    InputFileError
        If the file is missing or not JSON, or a value is missing or out of range.
    SchemaVersionError
        If the file has another major version, or is not a street.
    """
    return read_record(LearnedStreet, path, "learned street")
