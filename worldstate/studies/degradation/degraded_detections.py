"""Detections of one recording in every staged camera state: expensive, cached, independent of audio."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.adapters.camera.camera_channel import Watched, Watcher
from worldstate.adapters.camera.degradation import LEVELS, Family, degrade
from worldstate.adapters.camera.detector import Detector
from worldstate.adapters.camera.miss_rates import MissRates
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.video import Video
from worldstate.adapters.camera.vision_query import VisionSettings
from worldstate.ground.values import nanoseconds

# States that every sweep has: the camera as it is, and no camera at all.
CLEAN, OFF = "clean", "off"


@dataclass(frozen=True, slots=True)
class CameraState:
    """One staged state of the camera."""

    family: Family  # What is staged
    degradation: float  # d in [0, 1]; 0 is the clean camera, whatever the family

    def __str__(self) -> str:
        return f"{self.family} {self.degradation:g}" if self.degradation else CLEAN


def camera_states(families: Sequence[Family] = ("blur", "darkness", "noise")) -> tuple[CameraState, ...]:
    """Return the clean camera and every level of every family."""
    staged = (CameraState(family, d) for family in families for d in LEVELS if d > 0.0)
    return CameraState("all", 0.0), *staged


@dataclass(frozen=True, slots=True)
class Staging:
    """What detects on the staged frames."""

    make_detector: Callable[[], Detector]  # Makes a detector for each state
    rates: MissRates  # Measured with the same detector, on other recordings
    camera: PinholeCamera  # That took the video
    settings: VisionSettings  # How it is asked


def detect_in_states(
    video: Video, staging: Staging, states: Sequence[CameraState], rng: np.random.Generator
) -> dict[str, Watched]:
    """Decode once, degrade and detect in every state."""
    # The degradation is staged on the frames and not passed on: the detector sees degraded frames, and d is
    # estimated from them.
    watchers = [Watcher(staging.make_detector(), staging.rates) for _ in states]
    for number, frame in enumerate(video.frames()):
        stamp_ns = nanoseconds(number / video.frame_rate_hz)
        for watcher, state in zip(watchers, states, strict=True):
            watcher.look(stamp_ns, degrade(frame, state.family, state.degradation, rng))
    return {str(state): watcher.watched() for state, watcher in zip(states, watchers, strict=True)}
