"""Staged degradations of camera, microphones or both, and the reports of detectors under them.

Running several detectors over one video in every condition is the expensive step, so its results are cached.
"""

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import pairwise
from types import MappingProxyType

import numpy as np
from scipy.special import ndtr

from worldstate.adapters.audio.sound_file import Audio, RawPcm, open_sound
from worldstate.adapters.camera.camera_health import (
    LARGEST_PX,
    LEVELS,
    QUANTILES,
    CameraHealth,
    DegradationLog,
    Family,
    HealthMonitor,
    ImageQuality,
    blurred,
    degrade,
    health_scale,
    image_quality,
    normal_quantiles,
    strength,
)
from worldstate.adapters.camera.detections import DetectionFilter, DetectionFrame, DetectionLog, Detector
from worldstate.adapters.camera.detectors import ALL_MOTION, Background, MotionDetector, reduced_to
from worldstate.adapters.camera.miss_rates import MissRates
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.video import Video
from worldstate.adapters.source import Source
from worldstate.ground.extras import optional
from worldstate.ground.typing import Float32Array, FloatArray, ImageArray
from worldstate.ground.values import nanoseconds
from worldstate.operations.recordings.hop_table import HopTable

# Conditions of every sweep: the unchanged recording, and no camera.
CLEAN, OFF = "clean", "off"
# Rain has two effects: water on the lens and noise on the roof. Each is also staged alone.
LENS, ROOF, RAIN = "lens", "roof", "rain"
# The three families of the paper. Miss rates are measured for these only: the camera has no rain sensor.
FAMILIES: tuple[Family, ...] = ("blur", "darkness", "noise")
# Processing steps of an image, optics first. Drops on a lens blur the image and reduce its light.
STAGES: Mapping[str, tuple[Family, ...]] = MappingProxyType(
    {CLEAN: (), **{family: (family,) for family in FAMILIES}, LENS: ("blur", "darkness")}
)


@dataclass(frozen=True, slots=True)
class Condition:
    """One level of one family; level 0 for families without levels.

    Examples
    --------
    >>> rain = Condition("rain", 3)
    >>> rain.name, rain.camera.name, rain.sound_level, rain.degradation
    ('rain 0.75', 'lens 0.75', 3, 0.75)
    >>> Condition("roof", 2).camera.name, Condition("blur", 2).sound_level
    ('clean', 0)
    """

    family: str
    level: int = 0

    @property
    def name(self) -> str:
        """Name that is unique in a sweep."""
        return f"{self.family} {self.degradation:g}" if self.level else self.family

    @property
    def degradation(self) -> float:
        """The staged d in [0, 1]."""
        return LEVELS[self.level]

    @property
    def camera(self) -> "Condition":
        """The condition of the camera alone, which has the same images."""
        if self.family in STAGES:
            return self
        return Condition(LENS, self.level) if self.family == RAIN else Condition(CLEAN)

    @property
    def sound_level(self) -> int:
        """Level of the rain on the roof, 0 if there is none."""
        return self.level if self.family in (ROOF, RAIN) else 0

    def stage(self, image: ImageArray, rng: np.random.Generator, reduced: float = 1.0) -> ImageArray:
        """Return an image as this camera would have taken it; `reduced` as in `degrade_reduced`."""
        for family in STAGES[self.family]:
            image = degrade_reduced(image, family, self.degradation, rng, reduced)
        return image


def degrade_reduced(
    image: ImageArray, family: Family, degradation: float, rng: np.random.Generator, reduced: float
) -> ImageArray:
    """Degrade a reduced image as if the full image had been degraded and then reduced.

    Each pixel of the image is the mean of `reduced` x `reduced` pixels of the camera.
    """
    # For a detector on reduced images the result is the same, at a tenth of the time: blur and darkness
    # commute with the mean over pixels, and the noise enters only by its mean over pixels.
    if reduced == 1.0 or family == "darkness" or degradation == 0.0:
        return degrade(image, family, degradation, rng)
    staged = strength(family, degradation)
    if family == "blur":
        return blurred(image, staged / reduced, rng)
    # Clipping occurs before the mean: it shifts the mean of a dark or bright pixel and reduces its noise.
    mean, std = _clipped_noise(staged)
    # Cells that are not aligned with whole pixels share the pixels at their edges: the mean square of the
    # weights of randomly placed cells is (r - 1/3) / r^2 per side.
    left = 1.0 / reduced if reduced.is_integer() else (reduced - 1.0 / 3.0) / reduced**2
    drawn = normal_quantiles().take(rng.integers(0, QUANTILES, image.shape, dtype=np.uint16))
    values = drawn * (std * np.float32(left)).take(image) + mean.take(image)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


@lru_cache(maxsize=16)
def _clipped_noise(sigma: float) -> tuple[Float32Array, Float32Array]:
    """Return mean and standard deviation of each stored grey level with noise, shape (256,) each."""
    grey = np.arange(256.0)
    edges = ndtr((grey[:-1] + 0.5 - grey[:, None]) / sigma)
    share = np.diff(edges, axis=1, prepend=0.0, append=1.0)
    mean = share @ grey
    return mean.astype(np.float32), np.sqrt(share @ grey**2 - mean**2).astype(np.float32)


def camera_conditions() -> tuple[Condition, ...]:
    """Return the conditions of the camera alone: the clean one, and every level of every family."""
    return Condition(CLEAN), *_levels(*FAMILIES, LENS)


def at_level(family: str, level: int) -> Condition:
    """Return a level of a family; level 0 of every family is the clean recording."""
    return Condition(family, level) if level else Condition(CLEAN)


def all_conditions() -> tuple[Condition, ...]:
    """Return the conditions of the camera, of the sound, of both together, and no camera.

    Examples
    --------
    >>> [one.name for one in all_conditions()][::5]
    ['clean', 'darkness 0.25', 'noise 0.5', 'lens 0.75', 'roof 1', 'off']
    """
    return *camera_conditions(), *_levels(ROOF, RAIN), Condition(OFF)


def _levels(*families: str) -> list[Condition]:
    return [Condition(family, level) for family in families for level in range(1, len(LEVELS))]


# White noise relative to the recording's own level at the levels of d, in dB. Most of that level is below 100
# Hz, which is not used as evidence: at -20 dB the noise is 17 dB below a street's level between 0.3 and 1
# kHz, at +10 dB it is 13 dB above.
RAIN_DB = (-np.inf, -20.0, -10.0, 0.0, 10.0)


def rained(source: Source, level: int, dry_rms: float, rng: np.random.Generator) -> Source:
    """Return a source that can be read once, with rain on the roof; `dry_rms` is its `level_rms`.

    Drops hit the surroundings of each microphone independently: unlike wind or traffic noise, this noise is
    not coherent between microphones.
    """
    noise_rms = dry_rms * 10.0 ** (RAIN_DB[level] / 20.0)
    audio = open_sound(source.sound)
    stream = io.BufferedReader(_Rain(audio, noise_rms, rng))
    return replace(source, sound=RawPcm(stream, audio.sample_rate_hz, audio.channels, "f32", str(audio.path)))


def level_rms(source: Source) -> float:
    """Return the root mean square over all channels, without their means."""
    with open_sound(source.sound, source.array.n_microphones) as audio:
        n, total, squares = 0, np.zeros(audio.channels), np.zeros(audio.channels)
        for block in audio.blocks():
            n += len(block)
            total += block.sum(axis=0, dtype=np.float64)
            squares += np.square(block, dtype=np.float64).sum(axis=0)
    return float(np.sqrt(np.mean(squares / n - (total / n) ** 2)))


class _Rain(io.RawIOBase):
    """Bytes of a sound with added noise, block by block: a stream of an hour does not fit in memory."""

    def __init__(self, audio: Audio, noise_rms: float, rng: np.random.Generator) -> None:
        self._audio, self._noise_rms, self._rng = audio, np.float32(noise_rms), rng
        self._blocks: Iterator[Float32Array] = audio.blocks()
        self._left = memoryview(b"")

    def readable(self) -> bool:
        """Return True: the bytes are readable."""
        return True

    def readinto(self, buffer: memoryview, /) -> int:  # type: ignore[override]
        """Fill the buffer with as much as the current block still contains."""
        if not self._left and (block := next(self._blocks, None)) is not None:
            noise = self._rng.standard_normal(block.shape, dtype=np.float32) * self._noise_rms
            self._left = memoryview((block + noise).astype("<f4").tobytes())
        n = min(len(buffer), len(self._left))
        buffer[:n], self._left = self._left[:n], self._left[n:]
        return n

    def close(self) -> None:
        """Close the underlying sound too."""
        self._audio.close()
        super().close()


# Increased whenever the same video would give different detections.
VERSION = 1
# The staged degradation is constant within a recording, and estimating it costs as much as two detections.
HEALTH_PERIOD_S = 2.0
# Margin around the part of an image in which quality is measured: three standard deviations of the widest
# blur, 16 px.
_MARGIN_PX = 48
READINGS = "readings"
_BOX_COLUMNS = ("condition", "frame", "box_px", "score", "class_name")
_READING_COLUMNS = ("condition", "time_s", "brightness", "noise", "sharpness")


@dataclass(frozen=True, slots=True)
class StagedDetector:
    """A detector to be evaluated in every condition.

    Examples
    --------
    >>> [detector.name for detector in motion_detectors()]
    ['mog2', 'knn']
    """

    name: str  # Name in tables and files; includes the name of its model
    make: Callable[[], Detector]  # Returns a new detector for each video and condition, in any process
    keep: DetectionFilter = ALL_MOTION  # Filter for its boxes


def motion_detectors() -> tuple[StagedDetector, ...]:
    """Return background subtraction by mixtures and by neighbours, which need no model file."""
    kinds: tuple[Background, ...] = ("mog2", "knn")
    return tuple(StagedDetector(kind, partial(MotionDetector, kind)) for kind in kinds)


def look(
    video: Video,
    detectors: Sequence[StagedDetector],
    rng: np.random.Generator,
    width_px: int,
    conditions: Sequence[Condition] = camera_conditions(),
) -> dict[str, HopTable]:
    """Decode a video once, degrade it once per condition, and run every detector.

    The result has one table per detector with its boxes in pixels of OVAD's camera, and `READINGS` with the
    image quality.
    """
    makers = {(one.name, state): one.make() for one in detectors for state in conditions}
    boxes: dict[str, list[tuple[object, ...]]] = {one.name: [] for one in detectors}
    readings: list[tuple[object, ...]] = []
    rate_hz, number = video.frame_rate_hz, -1
    period = max(round(HEALTH_PERIOD_S * rate_hz), 1)
    with one_opencv_thread():
        for number, frame in enumerate(video.frames()):
            small = reduced_to(frame, width_px)  # Reduced once for all detectors
            for state in conditions:
                staged = state.stage(small, rng, frame.shape[1] / small.shape[1])
                for name, rows in boxes.items():
                    found = makers[name, state].detect(staged)
                    rows += ((state.name, number, *box) for box in _reported(found, small))
                if number % period == 0:
                    read = image_quality(state.stage(_centre(frame), rng))
                    sharpness = np.nan if read.sharpness is None else read.sharpness
                    readings.append((state.name, number / rate_hz, read.brightness, read.noise, sharpness))
    about = {"frames": number + 1, "frame_rate_hz": rate_hz}
    tables = {name: HopTable.of_rows(_BOX_COLUMNS, rows).replace(about=about) for name, rows in boxes.items()}
    return {**tables, READINGS: HopTable.of_rows(_READING_COLUMNS, readings)}


def _reported(found: DetectionFrame, image: ImageArray) -> Iterator[tuple[FloatArray, float, str]]:
    """Yield the boxes in pixels of OVAD's camera, for any size of the image."""
    height, width = image.shape[:2]
    whole = PinholeCamera.ovad()
    scale = np.array([whole.width_px / width, whole.height_px / height] * 2)
    return zip(found.boxes_px * scale, found.scores.tolist(), found.labels, strict=True)


def detections_in(looks: HopTable, condition: str) -> DetectionLog:
    """Return the detections in one condition, empty images included."""
    n = int(looks.about["frames"])
    chosen = looks.condition == condition
    # An empty column has neither the right shape nor the text type.
    boxes, scores = looks.box_px[chosen].reshape(-1, 4), looks.score[chosen]
    labels = looks.class_name[chosen].tolist()
    edges = np.searchsorted(looks.frame[chosen], np.arange(n + 1)).tolist()
    frames = [DetectionFrame(boxes[a:b], scores[a:b], tuple(labels[a:b])) for a, b in pairwise(edges)]
    return DetectionLog.at_rate(frames, float(looks.about["frame_rate_hz"]), source=f"{condition} camera")


def health_of(readings: Sequence[HopTable]) -> CameraHealth:
    """Return the scale of d from the images of several recordings."""
    levels = range(len(LEVELS))
    noise = [_measured(readings, at_level("noise", level), "noise") for level in levels]
    sharpness = [_measured(readings, at_level("blur", level), "sharpness") for level in levels]
    brightness = _measured(readings, Condition(CLEAN), "brightness")
    return health_scale(brightness, np.stack(sharpness, axis=1), np.stack(noise, axis=1))


def degradation_in(readings: HopTable, condition: str, rates: MissRates) -> DegradationLog:
    """Return d as estimated from the camera's own images, without knowledge of the staged degradation."""
    assert rates.health is not None  # `pooled_rates` measures it
    monitor, chosen = HealthMonitor(rates.health), readings.condition == condition
    stamps_ns = [nanoseconds(time_s) for time_s in readings.time_s[chosen].tolist()]
    columns = (readings.columns[name][chosen].tolist() for name in _READING_COLUMNS[2:])
    levels = [
        rates.level(monitor.update(stamp_ns, ImageQuality(bright, noise, None if np.isnan(sharp) else sharp)))
        for stamp_ns, bright, noise, sharp in zip(stamps_ns, *columns, strict=True)
    ]
    return DegradationLog(np.array(stamps_ns, dtype=np.int64), np.array(levels))


def _measured(readings: Sequence[HopTable], condition: Condition, name: str) -> FloatArray:
    return np.concatenate([one.columns[name][one.condition == condition.name] for one in readings])


def _centre(frame: ImageArray) -> ImageArray:
    """Return the part of an image in which quality is measured, in the required colour space."""
    side = LARGEST_PX + 2 * _MARGIN_PX
    top, left = (max((length - side) // 2, 0) for length in frame.shape[:2])
    return np.ascontiguousarray(frame[top : top + side, left : left + side, 1])


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """Restrict OpenCV to the calling thread: the parallel processes work on different recordings."""
    cv2 = optional("cv2")
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
