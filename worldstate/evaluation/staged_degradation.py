"""The same recording with its camera staged at every degradation: sound once, vision again and again."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldstate.adapters.acoustic import AcousticAdapter
from worldstate.adapters.camera import PinholeCamera
from worldstate.adapters.degradation import Family, degrade
from worldstate.adapters.detector import Detector
from worldstate.adapters.listen import Source, line_of_sight, measure_steps
from worldstate.adapters.miss_rates import MissRates
from worldstate.adapters.video import Video
from worldstate.adapters.vision import VisionSettings
from worldstate.adapters.watched_camera import Watched, watch
from worldstate.evaluation.hop_stream import HopStream, hop_stream
from worldstate.frontend.stream import AcousticFrame
from worldstate.measurement import Measurement
from worldstate.values import nanoseconds


@dataclass(frozen=True, slots=True)
class Staging:
    """What is staged, and who looks at it.

    Parameters
    ----------
    family : {"blur", "darkness", "noise", "all"}
        Of the degradation.
    make_detector : callable
        Makes a detector for each pass.
    rates : MissRates
        Measured with the same detector.
    camera : PinholeCamera
        That took the video.
    settings : VisionSettings
        How it is asked.
    """

    family: Family
    make_detector: Callable[[], Detector]
    rates: MissRates
    camera: PinholeCamera
    settings: VisionSettings


def staged_streams(
    source: Source,
    video: Video,
    staging: Staging,
    levels: Sequence[float],
    rng: np.random.Generator,
    *,
    name: str,
    label: str,
) -> dict[float, HopStream]:
    """Return the streams of one recording at every degradation of its camera.

    The degradation is staged on the frames and nobody is told: the detector sees degraded frames, and d is
    estimated from them. Feed one such dictionary a recording, sorted by d, to
    `evaluation.ablations.degradation_sweep`.

    Parameters
    ----------
    source : Source
        The recording's sound and model; its detections are the reference of what is in view.
    video : Video
        Its clean frames, the first one at the start of the sound.
    staging : Staging
        What is staged.
    levels : sequence of float
        d in [0, 1].
    rng : numpy.random.Generator
        Draws the staged noise.
    name, label : str
        Of the recording.

    Raises
    ------
    InputFileError
        If a file is damaged.
    InvalidArgumentError
        If the miss rates hold no scale of health.
    """
    measured = list(measure_steps(source))
    heard = [frame for frame, _ in measured]
    there = [any(sighting.moving for sighting in m.sightings) for _, m in measured]
    streams = {}
    for d in levels:
        seen = watch(_stamped(video, staging.family, d, rng), staging.make_detector(), staging.rates)
        again = _asked(heard, seen, source, staging)
        streams[d] = hop_stream(again, name=name, label=label, t0_s=source.t0_s, there=there)
    return streams


def _stamped(
    video: Video, family: Family, d: float, rng: np.random.Generator
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    for number, frame in enumerate(video.frames()):
        yield nanoseconds(number / video.frame_rate_hz), degrade(frame, family, d, rng)


def _asked(
    heard: Sequence[AcousticFrame], seen: Watched, source: Source, staging: Staging
) -> Iterator[Measurement]:
    """Ask the camera again about what was heard."""
    query = seen.query(staging.camera, staging.settings, line_of_sight(source.context))
    # Frames are only interpreted, so the rate of the sound does not matter here.
    adapter = AcousticAdapter(source.array, 48_000.0, source.signature(), vision=query)
    return map(adapter.interpret, heard)
