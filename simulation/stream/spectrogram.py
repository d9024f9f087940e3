"""Spectrogram of one channel of a stream, made while the stream goes by."""

from dataclasses import dataclass, field

import numpy as np
from scipy.fft import rfft, rfftfreq

from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.scene.octave_bands import REFERENCE_PA

LINE_S = 0.5
FFT_SAMPLES = 256
HIGHEST_HZ = 3000.0


@dataclass(slots=True)
class Spectrogram:
    """Mean power of every line of half a second: an hour of it stays below 10 MB."""

    sample_rate_hz: float
    _rest: Float32Array = field(default_factory=lambda: np.zeros(0, np.float32))
    _lines: list[FloatArray] = field(default_factory=list)

    def add(self, samples_pa: Float32Array) -> None:
        """Take in the next samples of the channel, shape (n,)."""
        frames = round(LINE_S * self.sample_rate_hz) // FFT_SAMPLES
        length = frames * FFT_SAMPLES
        whole = np.concatenate([self._rest, samples_pa])
        cut = len(whole) // length * length
        # Blocks without overlap lose a third of the samples to the window, which a picture does not need.
        window = np.hanning(FFT_SAMPLES).astype(np.float32)
        blocks = whole[:cut].reshape(-1, frames, FFT_SAMPLES) * window
        for block in blocks:
            self._lines.append((np.abs(rfft(block, axis=-1)) ** 2).mean(axis=0)[self._shown])
        self._rest = whole[cut:]

    @property
    def _shown(self) -> slice:
        return slice(1, int(np.searchsorted(rfftfreq(FFT_SAMPLES, 1.0 / self.sample_rate_hz), HIGHEST_HZ)))

    @property
    def frequencies_hz(self) -> FloatArray:
        """Middle of the bins, shape (F,)."""
        return np.asarray(rfftfreq(FFT_SAMPLES, 1.0 / self.sample_rate_hz)[self._shown])

    @property
    def times_s(self) -> FloatArray:
        """Beginning of the lines, shape (T,)."""
        step = round(LINE_S * self.sample_rate_hz) // FFT_SAMPLES * FFT_SAMPLES / self.sample_rate_hz
        return step * np.arange(len(self._lines), dtype=np.float64)

    def levels_db(self) -> FloatArray:
        """Level of every bin, dB re 20 uPa, shape (T, F)."""
        scale = 2.0 / (FFT_SAMPLES * 0.375 * FFT_SAMPLES)  # one-sided, by the Hann window's power
        power = np.array(self._lines).reshape(-1, len(self.frequencies_hz)) * scale
        return np.asarray(10.0 * np.log10(np.maximum(power, REFERENCE_PA**2 * 1e-3) / REFERENCE_PA**2))
