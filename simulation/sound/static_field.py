"""Many sources that do not move, heard by all microphones at once.

Delays across an array are a few milliseconds at most, so every source is a phase ramp per block of a weighted
overlap-add; all sources reach all microphones in one batched matrix product. Most of the cost is the way back
from the spectra, once per microphone however many sources there are: sources are best rendered together.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.fft import irfft, rfft

from worldstate.ground.typing import Complex64Array, Float32Array, FloatArray

from .diffraction import SPEED_OF_SOUND_MPS

BLOCK = 4096
HOP = BLOCK // 2
BINS, FINE_BINS = HOP + 1, 64
BLOCKS_AT_ONCE = 16
PENDING = 160  # as many sources wait, with their signals, to be rendered together


def plane_wave_delays(directions: FloatArray, offsets_m: FloatArray) -> FloatArray:
    """Delay of plane waves at every microphone against the array's centre, shape (Q, M), s.

    Shapes: directions (Q, 3), offsets_m (M, 3).
    """
    return -(directions @ offsets_m.T) / SPEED_OF_SOUND_MPS


def azimuths_all_round(count: int, rng: np.random.Generator) -> FloatArray:
    """Draw evenly spaced azimuths, the first of them anywhere within a step."""
    return np.asarray(2.0 * np.pi * (np.arange(count) + rng.random()) / count)


def unit_vectors(azimuth_rad: FloatArray, elevation_rad: FloatArray) -> FloatArray:
    """Directions in `base_link`, shape (Q, 3)."""
    flat = np.cos(elevation_rad)
    return np.stack([flat * np.cos(azimuth_rad), flat * np.sin(azimuth_rad), np.sin(elevation_rad)], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class StaticSources:
    """Sources that wait to be rendered together."""

    out: Float32Array  # shape (M, n): What every microphone hears, added to
    sample_rate_hz: float
    _waiting: list[tuple[Float32Array, FloatArray, FloatArray]] = field(default_factory=list)

    def add(self, signals: Float32Array, delays_s: FloatArray, gains: FloatArray | None = None) -> None:
        """Let sources wait whose delayed copies are added to every microphone.

        Shapes: signals (Q, n), delays_s (Q, M), gains (Q, M).
        """
        factors = np.ones_like(delays_s) if gains is None else gains
        self._waiting.append((signals, delays_s, factors))
        if sum(len(delays) for _, delays, _ in self._waiting) > PENDING:
            self.render()

    def render(self) -> None:
        """Render what waits."""
        if not self._waiting:
            return
        delays, gains = (np.concatenate([one[i] for one in self._waiting]) for i in (1, 2))
        signals = [one for one, _, _ in self._waiting]
        self._waiting.clear()
        steering, samples = _phase_ramps(delays, gains, self.sample_rate_hz), self.out.shape[1]
        for start, spectra in _analyse(signals):
            heard = np.matmul(spectra, steering).transpose(1, 2, 0)  # (blocks, M, F)
            for i, block in enumerate(irfft(heard, BLOCK)):
                first, last = max((start + i - 1) * HOP, 0), min((start + i + 1) * HOP, samples)
                at = (start + i - 1) * HOP
                self.out[:, first:last] += block[:, first - at : last - at]


def _phase_ramps(delays_s: FloatArray, gains: FloatArray, sample_rate_hz: float) -> Complex64Array:
    r"""Return :math:`g\, e^{-2 \pi j f \tau}` at the bins of a block, shapes (Q, M) -> (F, Q, M)."""
    # Bin k = 64 i + j is a product of two powers of the first: a tenth of the time of an exponential for
    # each, which takes longer than all the rest of a recording of half a second.
    first = -2j * np.pi * sample_rate_hz / BLOCK * delays_s
    fine = np.exp(np.arange(FINE_BINS)[:, None, None] * first)
    ramps = np.empty((-(-BINS // FINE_BINS), *fine.shape), np.complex64)
    for i, bins in enumerate(ramps):
        np.multiply(fine, gains * np.exp(i * FINE_BINS * first), out=bins, casting="same_kind")
    return ramps.reshape(-1, *delays_s.shape)[:BINS]


def _blocks(samples: int) -> int:
    """Blocks that cover `samples`, beginning one hop before the first."""
    return -(-samples // HOP) + 1


def _analyse(signals: list[Float32Array]) -> Iterator[tuple[int, Complex64Array]]:
    """Spectra (F, blocks, Q) of Hann-windowed blocks, which sum to the signal, a few blocks at a time."""
    window = (0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(BLOCK) / BLOCK)).astype(np.float32)
    sources, samples = sum(len(one) for one in signals), signals[0].shape[1]
    blocks = _blocks(samples)
    cut = np.empty((sources, BLOCK), np.float32)
    for start in range(0, blocks, BLOCKS_AT_ONCE):
        stop = min(start + BLOCKS_AT_ONCE, blocks)
        spectra = np.empty((BINS, stop - start, sources), np.complex64)
        for i in range(start, stop):
            at = (i - 1) * HOP  # the first block begins one hop before the signals
            first, last = max(at, 0), min(at + BLOCK, samples)
            cut[:, : first - at], cut[:, last - at :] = 0.0, 0.0
            np.concatenate([one[:, first:last] for one in signals], out=cut[:, first - at : last - at])
            cut *= window
            # Turned while it is in the cache: of all blocks at once that took as long as the transforms.
            spectra[:, i - start] = rfft(cut, axis=-1).T
        yield start, spectra
