r"""Noise from many directions at once, and noise of every microphone by itself, block by block.

Every block of a weighted overlap-add is drawn in the frequency domain,

.. math:: X_m(f) = \sum_q \sqrt{G_q S(f)}\, e^{-2 \pi j f \tau_{qm}} W_q(f) + \sqrt{N(f)}\, V_m(f),

with W and V white: no wave exists as a signal, and the cost is one product and one transform per microphone.
Blocks know nothing of each other; the squares of their windows add up to one, so that the level is steady
while powers G may change from block to block.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.fft import irfft, next_fast_len

from worldstate.ground.typing import Complex64Array, Float32Array, FloatArray

# Long against the delays across an array (some 3 ms), which go round within a block, and short against the
# second in which a level changes.
BLOCK_S = 0.043
BLOCKS_AT_ONCE = 32
NORMALS = 2**16


@dataclass(frozen=True, slots=True)
class BlockGrid:
    """Blocks, half overlapping, that cover a recording."""

    samples: int
    sample_rate_hz: float

    @property
    def hop(self) -> int:
        """Samples from one block to the next."""
        return int(next_fast_len(round(0.5 * BLOCK_S * self.sample_rate_hz), real=True))

    @property
    def frequencies_hz(self) -> FloatArray:
        """Bins of a block, shape (F,)."""
        return np.asarray(np.fft.rfftfreq(2 * self.hop, 1.0 / self.sample_rate_hz))

    @property
    def middles_s(self) -> FloatArray:
        """When each block is in its middle, shape (B,); the first begins a hop before the recording."""
        return np.arange(-(-self.samples // self.hop) + 1) * self.hop / self.sample_rate_hz


@dataclass(frozen=True, slots=True, eq=False)
class WaveField:
    """Plane waves of independent noise of one spectrum, their changing powers, and noise beside them."""

    grid: BlockGrid
    delays_s: FloatArray  # shape (Q, M): Of every wave at every microphone
    density: FloatArray  # shape (F,): Power spectral density of a wave of power one, Pa^2/Hz
    power: FloatArray  # shape (B, Q): Of every wave in every block
    noise_density: FloatArray  # shape (F,): Of every microphone by itself, Pa^2/Hz

    def add_to(self, out: Float32Array, rng: np.random.Generator) -> None:
        """Draw the noise and add it to what every microphone hears, shape (M, n)."""
        at = 0
        for heard in self.stretches(rng):
            room = out[:, at : at + heard.shape[1]]
            room += heard[:, : room.shape[1]]
            at += heard.shape[1]

    def stretches(self, rng: np.random.Generator) -> Iterator[Float32Array]:
        """Draw the noise a few blocks at a time, shape (M, some hops) each, however long it gets."""
        hop, gains = self.grid.hop, np.sqrt(self.power).astype(np.float32)
        window = np.sin(np.pi * (np.arange(2 * hop) + 0.5) / (2 * hop)).astype(np.float32)
        steering, noise = self._steering(), self._amplitude(self.noise_density)[:, None, None]
        before = np.zeros((0, steering.shape[2], 2 * hop), np.float32)
        for start in range(0, len(gains), BLOCKS_AT_ONCE):
            gain = gains[start : start + BLOCKS_AT_ONCE]
            spectra = np.matmul(_white((len(steering), *gain.shape), rng) * gain, steering)
            if noise.any():
                spectra += noise * _white(spectra.shape, rng)
            blocks = irfft(spectra.transpose(1, 2, 0), 2 * hop)
            blocks *= window
            whole = np.concatenate([before, blocks])
            heard = np.empty((blocks.shape[1], len(whole) - 1, hop), np.float32)
            np.add(whole[:-1, :, hop:].swapaxes(0, 1), whole[1:, :, :hop].swapaxes(0, 1), out=heard)
            before = whole[-1:].copy()
            yield heard.reshape(len(heard), -1)

    def _steering(self) -> Complex64Array:
        phase = self.grid.frequencies_hz[:, None, None] * self.delays_s
        turned = np.exp(-2j * np.pi * phase).astype(np.complex64)
        return np.asarray(turned * self._amplitude(self.density)[:, None, None])

    def _amplitude(self, density: FloatArray) -> Float32Array:
        """Return the standard deviation of the real and of the imaginary part of a bin."""
        samples = 2 * self.grid.hop
        return np.sqrt(density * self.grid.sample_rate_hz * samples / 4.0).astype(np.float32)


def _white(shape: tuple[int, ...], rng: np.random.Generator) -> Complex64Array:
    """Draw complex normal numbers whose real and imaginary parts have unit variance."""
    # Drawn out of a fixed set that fills the plane evenly with that density: five times as fast as the
    # ziggurat, which took half the time of a background, and no sum of some hundred knows the difference.
    return np.asarray(_normal_plane()[rng.integers(0, NORMALS, shape, dtype=np.uint16)])


@cache
def _normal_plane() -> Complex64Array:
    """Quantiles of the radius of complex normal numbers, each turned on by the golden angle."""
    index = np.arange(NORMALS)
    radius = np.sqrt(-2.0 * np.log((index + 0.5) / NORMALS))
    return np.asarray(radius * np.exp(1j * np.pi * (np.sqrt(5.0) - 1.0) * index), np.complex64)
