r"""The engine line of a stream: one tone per hop, fitted by maximum likelihood after decimation.

A few microphones near the centre of the array are averaged: at engine frequencies they lie within a fraction
of a wavelength, so that a tone from any direction adds up. `decimator` keeps the band, at some 1200 samples
per second. In the last second the peak with the highest ratio to the noise around it is searched under a Hann
window, so that neither harmonics nor rumble leak into it, and refined as in `tone`.

The noise floor is the median power around the line, or what is left beside the line where that is more: a
line that wanders, and a hump of coloured noise, leave most of themselves. The standard deviation is the bound
of Rife and Boorstyn at that signal-to-noise ratio, with what a wandering line leaves counted for more.
"""

from dataclasses import dataclass

import numpy as np
import scipy.fft

from worldstate.frontend.array.channel_mask import ChannelMask
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.bounds.cramer_rao import tone_crb_hz2
from worldstate.frontend.spectra.decimator import Decimator
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, Float32Array, FloatArray
from worldstate.ground.values import NotUsable

from .harmonic_sum import MEDIAN_OF_EXPONENTIAL
from .tone import climb, tone_wave

# Firing frequencies of road vehicles, idling motorcycle single to a car at high revolutions.
ENGINE_BAND_HZ = (20.0, 400.0)
# Bins per resolution (a grid this fine starts the climb within its lobe), resolutions per block of the coarse
# floor, and the ring of resolutions around the line whose median is its floor: beyond its own side lobes.
_PADDING = 2
_BLOCK = 24
_RING = (5, 40)
# Least ratio of the peak to the floor, A^2 N / 4 sigma^2, or 15.6 dB for eta N: white noise exceeds it in one
# window of a thousand.
_EVIDENT = 18.0
# What white noise leaves beside a line is up to twice what is around it. More is the line's own: of a
# frequency that wanders by .2 to 1 %, the error is 2.5 times what white noise of that power would make.
_CHANCE, _WANDER = 2.0, 6.0
# Tolerance of the refinement as a share of a resolution, the bound for eta N of 80 dB. From the vertex of a
# parabola two steps suffice; where three do not converge there is no tone.
_TOLERANCE, _STEPS = 1e-4, 3
# Lowest frequency, periods in the window: below, a tone is not distinguishable from an offset.
_FEWEST_PERIODS = 4.0


@dataclass(frozen=True, slots=True)
class ToneReading:
    """A tone above the noise.

    Examples
    --------
    >>> ToneReading(61.2, 0.02, 0.5, 1e-4, 0.5).frequency_hz
    61.2
    """

    frequency_hz: float  # Mean over the window, by the stream's own sample rate
    frequency_std_hz: float  # Of that mean
    snr: float  # eta = A^2 / 2 sigma^2 per decimated sample, sigma^2 from what is around and beside the line
    mean_square: float  # A^2 / 2 of the averaged microphones, squared units of the samples
    age_s: float  # From the middle of the window to the end of the hop, seconds


class ToneStage:
    """Keep the decimated band of one averaged channel over the window and fit a tone."""

    def __init__(
        self,
        array: MicrophoneArray,
        sample_rate_hz: float,
        band_hz: tuple[float, float] = ENGINE_BAND_HZ,
        window_s: float = 1.0,
        n_channels: int = 4,
    ) -> None:
        low, high = band_hz
        in_range("tone_band_hz: lower end", low, _FEWEST_PERIODS / window_s, high, open_high=True)
        in_range("tone_band_hz: upper end", high, low, 0.5 * sample_rate_hz, open_high=True)
        self._nearest = np.argsort(np.linalg.norm(array.centred_m, axis=1), kind="stable")
        self._n_channels = n_channels
        self._weights, self._keep = self._mean_of(np.ones(array.n_microphones, bool))
        self._sample_rate_hz = sample_rate_hz
        self._decimator = Decimator(sample_rate_hz, high)
        self._rate = self._decimator.rate_hz
        self._n_pushed = 0
        self._n_out = 0
        self._band_samples: FloatArray = np.zeros(_window(window_s * sample_rate_hz, self._decimator))
        self._spectrum = _Spectrum(len(self._band_samples), self._rate, band_hz)

    def push(self, samples: Float32Array, mask: ChannelMask) -> None:
        r"""Take the samples of a hop (n, M), of which the microphones of a mask count.

        .. math:: y[m] = \sum_n h[n]\, \frac1{|C|} \sum_{i \in C} x_i[m D + n]

        """
        # C are the usable microphones nearest to the centre.
        if not np.array_equal(mask.keep, self._keep):
            self._weights, self._keep = self._mean_of(mask.keep)
        new = self._decimator.push(samples @ self._weights)
        self._n_pushed += len(samples)
        self._n_out += len(new)
        self._band_samples = np.concatenate([self._band_samples, new])[len(new) :]

    def read(self) -> ToneReading | NotUsable:
        r"""Fit the line of the window that ends with the last hop.

        .. math:: \hat f = \arg\max_f \; y^H H (H^H H)^{-1} H^H y, \qquad
                  \eta = \frac{|\hat A|^2}{2 \hat\sigma^2}, \qquad
                  \sigma_f^2 = \frac{12\, f_s^2}{(2\pi)^2\, \eta\, N (N^2 - 1)}

        where :math:`\eta N / 2 > 18`.
        """
        if self._n_out < len(self._band_samples):
            return NotUsable(f"needs {len(self._band_samples) / self._rate:.2f} s of sound")
        if not self._band_samples.any():
            return NotUsable("silence")
        sound = self._band_samples - self._spectrum.offset(self._band_samples)
        power = self._spectrum.power(sound)
        begin, band = self._spectrum.peak(power), self._spectrum.omega_range
        omega, amplitude = climb(sound, begin, band, _TOLERANCE, _STEPS)
        rest = sound - (amplitude * tone_wave(omega, len(sound))).real
        around, beside = self._spectrum.floor_near(power, omega), self._spectrum.beside(rest, omega)
        snr = 0.5 * abs(amplitude) ** 2 / max(around, beside)
        if not 0.5 * snr * len(sound) > _EVIDENT:
            return NotUsable("no tone above the noise")
        noise = around + _WANDER * max(beside - _CHANCE * around, 0.0)
        std = float(np.sqrt(tone_crb_hz2(0.5 * abs(amplitude) ** 2 / noise, len(sound), self._rate)))
        frequency = omega * self._rate / (2.0 * np.pi)
        return ToneReading(frequency, std, snr, 0.5 * abs(amplitude) ** 2, self._age_s())

    def _mean_of(self, keep: BoolArray) -> tuple[Float32Array, BoolArray]:
        """Return weights of the usable microphones nearest to the centre, and their mask."""
        usable = self._nearest[keep[self._nearest]] if keep.any() else self._nearest
        chosen = usable[: self._n_channels]
        weights = np.zeros(len(keep), np.float32)
        weights[chosen] = 1.0 / len(chosen)
        return weights, keep.copy()

    def _age_s(self) -> float:
        """Return the time from the middle of the window to the last sample pushed."""
        middle = self._n_out - 0.5 * (len(self._band_samples) + 1)
        centre = middle * self._decimator.factor + 0.5 * self._decimator.n_taps
        return float((self._n_pushed - centre) / self._sample_rate_hz)


def _window(n_samples: float, decimator: Decimator) -> int:
    """Return the number of outputs that always fit into this many input samples."""
    count = int((n_samples - decimator.n_taps) // decimator.factor)
    if count < 2 * _PADDING * _RING[1]:
        raise InvalidArgumentError(
            f"tone_hops: expected a window well above the filter's {decimator.n_taps} samples, "
            f"got {n_samples:.0f}"
        )
    return count


class _Spectrum:
    """Hann-windowed, zero-padded power around a band, in units of the mean square of white noise."""

    def __init__(self, n_samples: int, rate: float, band_hz: tuple[float, float]) -> None:
        hann = np.hanning(n_samples + 2)[1:-1]
        self._window = hann / np.sqrt(np.square(hann).sum())
        self._size = scipy.fft.next_fast_len(_PADDING * n_samples, real=True)
        self._step = float(2.0 * np.pi / self._size)
        low, high = (2.0 * np.pi * f / rate for f in band_hz)
        self.omega_range = (low, high)
        self._band = slice(int(np.ceil(low / self._step)), int(high / self._step) + 1)

    def offset(self, sound: FloatArray) -> float:
        """Mean under the window, to which a tone of a few periods does not contribute."""
        return float(self._window @ sound) / float(self._window.sum())

    def power(self, sound: FloatArray) -> FloatArray:
        spectrum = scipy.fft.rfft(sound * self._window, self._size)
        return np.asarray(np.square(spectrum.real) + np.square(spectrum.imag))

    def peak(self, power: FloatArray) -> float:
        """Return the frequency (rad per sample) of the highest power over its block median."""
        inside = power[self._band]
        width = min(_PADDING * _BLOCK, len(inside))
        n_blocks = len(inside) // width
        blocks = inside[: n_blocks * width].reshape(n_blocks, width)
        floor = np.partition(blocks, width // 2, axis=1)[:, width // 2] + _least(power)
        ratio = inside / np.repeat(floor, width)[np.minimum(np.arange(len(inside)), n_blocks * width - 1)]
        index = self._band.start + int(np.argmax(ratio))
        near = np.log(power[index - 1 : index + 2] + _least(power))
        return self._step * (index + _vertex(float(near[0]), float(near[1]), float(near[2])))

    def floor_near(self, power: FloatArray, omega: float) -> float:
        """Return the mean square of white noise that would have the median power around a line."""
        centre = round(omega / self._step)
        inner, outer = (_PADDING * r for r in _RING)
        below = power[max(centre - outer, 1) : max(centre - inner, 1)]
        above = power[centre + inner : centre + outer]
        around = np.sort(np.concatenate([below, above]))
        return float(around[len(around) // 2]) / MEDIAN_OF_EXPONENTIAL + _least(power)

    def beside(self, rest: FloatArray, omega: float) -> float:
        """Return the mean power beside a line that was taken out, as far as its own lobes reach."""
        centre, reach = round(omega / self._step), _PADDING * _RING[0]
        return float(self.power(rest)[max(centre - reach, 1) : centre + reach + 1].mean())


def _vertex(left: float, middle: float, right: float) -> float:
    """Vertex of a parabola through three points, in steps from the second, at most half a step."""
    bend = left - 2.0 * middle + right
    return min(max(0.5 * (left - right) / bend, -0.5), 0.5) if bend < 0.0 else 0.0


def _least(power: FloatArray) -> float:
    """Return the rounding noise of single-precision input."""
    return float(np.finfo(np.float32).eps ** 2 * power.max()) + np.finfo(np.float64).tiny
