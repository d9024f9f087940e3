"""Rain on the roof: noise at every microphone, independent of that at the others."""

import io
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from worldstate.adapters.audio.open_sound import RawPcm, open_sound
from worldstate.adapters.audio.sound_file import Audio
from worldstate.adapters.listen import Source
from worldstate.ground.typing import Float32Array

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
