"""The same recording with its camera staged in every state: sound once, vision again and again."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.adapters.acoustic import AcousticAdapter
from worldstate.adapters.camera import PinholeCamera
from worldstate.adapters.degradation import LEVELS, Family, degrade
from worldstate.adapters.detector import Detector
from worldstate.adapters.listen import Source, line_of_sight, measure_steps
from worldstate.adapters.miss_rates import MissRates
from worldstate.adapters.video import Video
from worldstate.adapters.vision import VisionQuery, VisionSettings
from worldstate.adapters.watched_camera import Watched, Watcher
from worldstate.evaluation.hop_stream import hop_stream
from worldstate.evaluation.staged_recording import CLEAN, OFF, StagedRecording
from worldstate.filter import WorldFilter
from worldstate.frontend.stream import AcousticFrame
from worldstate.measurement import Measurement
from worldstate.values import nanoseconds

Heard = tuple[AcousticFrame, Measurement]


@dataclass(frozen=True, slots=True)
class CameraState:
    """One staged state of the camera.

    Parameters
    ----------
    family : {"blur", "darkness", "noise", "all"}
        What is staged.
    degradation : float
        d in [0, 1]; 0 is the clean camera, whatever the family.

    Examples
    --------
    >>> str(CameraState("blur", 0.5)), str(CameraState("all", 0.0))
    ('blur 0.5', 'clean')
    """

    family: Family
    degradation: float

    def __str__(self) -> str:
        return f"{self.family} {self.degradation:g}" if self.degradation else CLEAN


@dataclass(frozen=True, slots=True)
class Staging:
    """Who looks at the staged frames.

    Parameters
    ----------
    make_detector : callable
        Makes a detector for each state.
    rates : MissRates
        Measured with the same detector, on other recordings.
    camera : PinholeCamera
        That took the video.
    settings : VisionSettings
        How it is asked.
    """

    make_detector: Callable[[], Detector]
    rates: MissRates
    camera: PinholeCamera
    settings: VisionSettings


def camera_states(families: Sequence[Family] = ("blur", "darkness", "noise")) -> tuple[CameraState, ...]:
    """Return the clean camera and every level of every family.

    Examples
    --------
    >>> len(camera_states()), [str(state) for state in camera_states(("noise",))][:3]
    (13, ['clean', 'noise 0.25', 'noise 0.5'])
    """
    staged = (CameraState(family, d) for family in families for d in LEVELS if d > 0.0)
    return CameraState("all", 0.0), *staged


def stage_recording(
    source: Source,
    video: Video,
    staging: Staging,
    states: Sequence[CameraState],
    rng: np.random.Generator,
    *,
    name: str,
    label: str,
    on_frame: Callable[[], None] = lambda: None,
) -> StagedRecording:
    """Return what the filter made of one recording with its camera in every state, and without it.

    The degradation is staged on the frames and nobody is told: the detector sees degraded frames, and d is
    estimated from them. The last row is that of a camera that is never asked.

    Parameters
    ----------
    source : Source
        The recording's sound and model; its detections are the reference of what is in view.
    video : Video
        Its clean frames, the first one at the start of the sound.
    staging : Staging
        Who looks.
    states : sequence of CameraState
        At least one.
    rng : numpy.random.Generator
        Draws the staged noise.
    name, label : str
        Of the recording.
    on_frame : callable
        Called after each frame, all states of it done.

    Raises
    ------
    InputFileError
        If a file is damaged.
    InvalidArgumentError
        If the miss rates hold no scale of health, or the sound is shorter than a second.
    """
    measured = list(measure_steps(source))
    there = [any(sighting.moving for sighting in m.sightings) for _, m in measured]
    watched = _watch(video, staging, states, rng, on_frame)
    sight = line_of_sight(source.context)
    queries = [seen.query(staging.camera, staging.settings, sight) for seen in watched]
    rows = [list(_asked(source, measured, query)) for query in (*queries, None)]
    streams = [hop_stream(row, name=name, label=label, t0_s=source.t0_s, there=there) for row in rows]
    degradation = [[seen.degradation(frame.stamp_ns) for frame, _ in measured] for seen in watched]
    return StagedRecording.of(
        streams,
        states=(*map(str, states), OFF),
        degradation=np.array([*degradation, [1.0] * len(measured)]),
        presence=np.array([_presence(source, row) for row in rows]),
    )


def _watch(
    video: Video,
    staging: Staging,
    states: Sequence[CameraState],
    rng: np.random.Generator,
    on_frame: Callable[[], None],
) -> list[Watched]:
    """Decode once, degrade and look in every state."""
    watchers = [Watcher(staging.make_detector(), staging.rates) for _ in states]
    for number, frame in enumerate(video.frames()):
        stamp_ns = nanoseconds(number / video.frame_rate_hz)
        for watcher, state in zip(watchers, states, strict=True):
            watcher.look(stamp_ns, degrade(frame, state.family, state.degradation, rng))
        on_frame()
    return [watcher.watched() for watcher in watchers]


class _Again:
    """What a signature model said of every hop, said once more in the same order."""

    def __init__(self, measured: Sequence[Heard]) -> None:
        self._said = iter([measurement.signature for _, measurement in measured])

    def evidence(self, feature: ArrayLike, /) -> SignatureEvidence:
        return next(self._said)


def _asked(source: Source, measured: Sequence[Heard], query: VisionQuery | None) -> Iterator[Measurement]:
    """Ask the camera again about what was heard."""
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
