"""What is staged on the camera, on the microphones, or on both at once."""

import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from scipy.special import ndtr

from worldstate.adapters.audio.sound_file import Audio, RawPcm, open_sound
from worldstate.adapters.camera.camera_health import (
    LEVELS,
    QUANTILES,
    Family,
    blurred,
    degrade,
    normal_quantiles,
    strength,
)
from worldstate.adapters.source import Source
from worldstate.ground.typing import Float32Array, ImageArray

# Conditions that every sweep has: the recording as it is, and no camera at all.
CLEAN, OFF = "clean", "off"
# Rain has two effects: it soils the lens and it drums on the roof. Each is staged alone as well.
LENS, ROOF, RAIN = "lens", "roof", "rain"
# The three families of the paper; those measured as miss rates, as the camera is not told that it rains.
FAMILIES: tuple[Family, ...] = ("blur", "darkness", "noise")
# What an image goes through, optics first. Drops on a lens smear the image and take some of its light.
STAGES: Mapping[str, tuple[Family, ...]] = MappingProxyType(
    {CLEAN: (), **{family: (family,) for family in FAMILIES}, LENS: ("blur", "darkness")}
)


@dataclass(frozen=True, slots=True)
class Condition:
    """One level of one family; level 0 for those without levels.

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
        """Unique in a sweep."""
        return f"{self.family} {self.degradation:g}" if self.level else self.family

    @property
    def degradation(self) -> float:
        """The staged d in [0, 1]."""
        return LEVELS[self.level]

    @property
    def camera(self) -> "Condition":
        """The condition whose images these are."""
        if self.family in STAGES:
            return self
        return Condition(LENS, self.level) if self.family == RAIN else Condition(CLEAN)

    @property
    def sound_level(self) -> int:
        """Level of the rain on the roof, 0 without."""
        return self.level if self.family in (ROOF, RAIN) else 0

    def stage(self, image: ImageArray, rng: np.random.Generator, reduced: float = 1.0) -> ImageArray:
        """Return an image as this camera would have taken it; `reduced` as in `degrade_reduced`."""
        for family in STAGES[self.family]:
            image = degrade_reduced(image, family, self.degradation, rng, reduced)
        return image


def degrade_reduced(
    image: ImageArray, family: Family, degradation: float, rng: np.random.Generator, reduced: float
) -> ImageArray:
    """Return a reduced image as if it had been reduced after the degradation.

    `reduced` is the number of the camera's pixels per side of one of the image, whose mean it holds.
    """
    # A detector that works on a reduced image sees the same either way, for a tenth of the time: blur and
    # darkness commute with the mean over pixels, and of the noise only the mean over pixels is left.
    if reduced == 1.0 or family == "darkness" or degradation == 0.0:
        return degrade(image, family, degradation, rng)
    staged = strength(family, degradation)
    if family == "blur":
        return blurred(image, staged / reduced, rng)
    # Clipping moves the mean of a dark or bright pixel and narrows its noise, before the mean is taken.
    mean, std = _clipped_noise(staged)
    # Cells that do not lie on whole pixels share those at their edges: the mean square of the weights of
    # cells anywhere is (r - 1/3) / r^2 a side.
    left = 1.0 / reduced if reduced.is_integer() else (reduced - 1.0 / 3.0) / reduced**2
    drawn = normal_quantiles().take(rng.integers(0, QUANTILES, image.shape, dtype=np.uint16))
    values = drawn * (std * np.float32(left)).take(image) + mean.take(image)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


@lru_cache(maxsize=16)
def _clipped_noise(sigma: float) -> tuple[Float32Array, Float32Array]:
    """Mean and standard deviation of each grey level with noise, as a camera stores it; shape (256,)."""
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
    """Return those of the camera, those of the sound, both at once, and no camera.

    Examples
    --------
    >>> [one.name for one in all_conditions()][::5]
    ['clean', 'darkness 0.25', 'noise 0.5', 'lens 0.75', 'roof 1', 'off']
    """
    return *camera_conditions(), *_levels(ROOF, RAIN), Condition(OFF)


def _levels(*families: str) -> list[Condition]:
    return [Condition(family, level) for family in families for level in range(1, len(LEVELS))]


# White noise over a recording's own level at the levels of d, dB. Most of that level lies below 100 Hz, where
# no evidence is: at -20 dB the noise is 17 dB below a street between .3 and 1 kHz, at +10 dB 13 dB above.
RAIN_DB = (-np.inf, -20.0, -10.0, 0.0, 10.0)


def rained(source: Source, level: int, dry_rms: float, rng: np.random.Generator) -> Source:
    """Return a source to be heard once, with rain on the roof over its sound, whose `level_rms` is `dry_rms`.

    Drops fall on each microphone's surroundings by themselves: unlike wind or traffic, what they add is not
    coherent between microphones.
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
    """Bytes of a sound with noise, block by block: a stream of an hour is never in memory."""

    def __init__(self, audio: Audio, noise_rms: float, rng: np.random.Generator) -> None:
        self._audio, self._noise_rms, self._rng = audio, np.float32(noise_rms), rng
        self._blocks: Iterator[Float32Array] = audio.blocks()
        self._left = memoryview(b"")

    def readable(self) -> bool:
        """Bytes can be read."""
        return True

    def readinto(self, buffer: memoryview, /) -> int:  # type: ignore[override]
        """Fill as much of the buffer as one block has left."""
        if not self._left and (block := next(self._blocks, None)) is not None:
            noise = self._rng.standard_normal(block.shape, dtype=np.float32) * self._noise_rms
            self._left = memoryview((block + noise).astype("<f4").tobytes())
        n = min(len(buffer), len(self._left))
        buffer[:n], self._left = self._left[:n], self._left[n:]
        return n

    def close(self) -> None:
        """Close the sound as well."""
        self._audio.close()
        super().close()
