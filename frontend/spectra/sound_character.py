r"""Character of the sound at one microphone, independent of its level: modulation, tones, harmonics.

Band levels are computed a hundred times per second. Over the last two seconds, their modulation spectrum and
the share of it that is common to the bands distinguish steps, speech and impacts from tyres and engines,
whose bands fluctuate independently as in noise. A finer spectrum, once per hop, shows tones and harmonic
series. The distribution of the level over the bands distinguishes a van from a car.
"""

import math
from itertools import pairwise

import numpy as np
from numpy.fft import rfft
from numpy.typing import NDArray

from worldstate.ground import FloatArray, IntArray, NotUsable, in_range, mean

from .resampling import Decimator
from .stft import fast_length, power

HOPS_A_SECOND = 10
EDGES_HZ = (80.0, 160.0, 240.0, 340.0, 450.0, 580.0, 740.0, 940.0, 1200.0, 1500.0, 1850.0, 2250.0, 2700.0)
_HIGH = 4  # First high band: below 450 Hz, wind and engines are modulated too
_FRAMES, _SECOND, _MEMORY = 10, 100, 200  # Number of levels per hop, per second, and in the window
_SHORT_S, _LONG_S = 0.032, 0.1706  # Frames that resolve syllables, and partials of a bell 6 Hz apart
# Modulation rates, Hz: swell, beats and steps, syllables (two ranges), roughness (three ranges).
_RATES_HZ = (0.4, 1.3, 2.8, 6.2, 10.2, 16.2, 30.2, 50.1)
_TOGETHER_HZ = (0.4, 2.2, 8.2, 16.2, 50.1)
_TONES_HZ = (80.0, 300.0, 900.0, 2700.0)
_AROUND_HZ = 150.0  # Half the width of the average that is the floor under a tone
_COMB_S = (1.0 / 400.0, 1.0 / 75.0)  # Periods of voices, strings and motors
_EXCESS = (-2.0, 4.0)  # Limits of an excess, nats: a single strong line is no harmonic series
_HEIGHTS = (4.0, 8.0)  # Nats above the floor: a line that noise rarely has, and the largest weight
_PAUSE, _LAG, _SMOOTH = 0.7, 5, 5  # Nats below the median; frames between two levels, and in a mean
_QUANTILES = (0.05, 0.5, 0.95)
_FORGET_LINES, _FORGET_PEAKS = 0.1, 0.05  # Weight of a hop: means over one and over two seconds
_STILL = 1e-6  # Modulation of a constant level, far below that of any noise
_LEAST = 1e-14  # Power of a silent band, far below that of a 24-bit converter

MEASURES = (
    *(f"modulation {part} {low:g}" for part in ("low", "high") for low in _RATES_HZ[:-1]),
    *(f"together {low:g}" for low in _TOGETHER_HZ[:-1]),
    *("rise", "fall", "pause", "flux low", "flux high"),
    *(f"{name} {low:g}" for name in ("steady", "tonal", "peak") for low in _TONES_HZ[:-1]),
    *("comb", "comb varies", "line", "line varies", "line holds"),
)
# Levels of the last second relative to their mean. No guard uses them, because they depend on the street.
BANDS = tuple(f"band {low:g}" for low in EDGES_HZ[:-1])


class SoundCharacter:
    """Measures the sound of one microphone over the last two seconds, hop by hop."""

    def __init__(self, sample_rate_hz: float) -> None:
        in_range("sample_rate_hz", sample_rate_hz, 2.0 * EDGES_HZ[-1], np.inf)
        self._decimator = Decimator(sample_rate_hz, EDGES_HZ[-1])
        rate = self._decimator.rate_hz
        short, long = (round(length_s * rate) for length_s in (_SHORT_S, _LONG_S))
        ends = np.round(np.arange(1 - _FRAMES, 1) * rate / (HOPS_A_SECOND * _FRAMES)).astype(int)
        self._sound: FloatArray = np.zeros(max(long, short - ends[0]))
        self._frames = len(self._sound) + ends[:, None] + np.arange(-short, 0)
        self._window = np.hanning(short + 1)[:-1] / np.sqrt(short)
        self._size = fast_length(short)
        # Means, because the number of bins in a band depends on the sample rate.
        self._means = np.ascontiguousarray(_means(EDGES_HZ, np.fft.rfftfreq(self._size, 1.0 / rate)).T)
        self._lines = _Lines(long, rate)
        self._levels: FloatArray = np.zeros((_MEMORY, len(EDGES_HZ) - 1))
        self._n_hops = 0

    def push(self, samples: NDArray[np.floating]) -> None:
        """Process the samples of the next hop of 0.1 s, shape (n,)."""
        new = self._decimator.push(samples)
        self._sound = np.concatenate([self._sound, new])[len(new) :]
        self._levels[:-_FRAMES] = self._levels[_FRAMES:]
        powers = power(rfft(self._sound[self._frames] * self._window, self._size))
        self._levels[-_FRAMES:] = np.log(powers @ self._means + _LEAST)
        self._lines.push(self._sound)
        self._n_hops += 1

    def read(self) -> FloatArray | NotUsable:
        """Return `MEASURES` of the last two seconds and `BANDS` of the last second, (measures + bands,)."""
        if self._n_hops <= _MEMORY // _FRAMES:
            return NotUsable("needs two seconds of sound")
        bands = mean(self._levels[-_SECOND:], 0)
        texture = (_modulation(self._levels), _swings(self._levels), self._lines.read())
        return np.concatenate([*texture, bands - mean(bands)])


class _Lines:
    """Tones and harmonic series in spectra of long frames, as running means."""

    def __init__(self, length: int, rate_hz: float) -> None:
        self._window = np.hanning(length + 1)[:-1] / np.sqrt(length)
        hz = np.fft.rfftfreq(length, 1.0 / rate_hz)
        first, last = np.searchsorted(hz, (EDGES_HZ[0], EDGES_HZ[-1]))
        self._band, self._step_hz = slice(first, last), float(hz[1])
        self._starts: IntArray = np.searchsorted(hz[self._band], _TONES_HZ[:-1])
        self._counts = np.diff([*self._starts.tolist(), last - first])
        half, count = round(_AROUND_HZ / self._step_hz), last - first
        self._left = np.maximum(np.arange(count) - half, 0)
        self._right = np.minimum(np.arange(count) + half + 1, count)
        self._taper = np.hanning(count + 2)[1:-1]
        # Twice as long as the band, so that its two ends are not neighbours.
        self._comb_size = fast_length(2 * count)
        low, high = (round(period * self._comb_size * self._step_hz) for period in _COMB_S)
        self._combs = slice(low, high)
        self._excess, self._ratio = np.zeros(count), np.ones(count)
        self._peaks: FloatArray = np.zeros(len(self._starts))
        self._log_hz = np.log(hz[self._band])
        # Running means: the height of the harmonic series and its square; the weight of the strongest line,
        # its weighted pitch and squared pitch; whether this line is clearly above the floor.
        self._moments: FloatArray = np.zeros(6)

    def push(self, sound: FloatArray) -> None:
        """Process the sound that ends now, at least one frame."""
        frame = sound[-len(self._window) :]
        level = np.log(power(rfft(frame * self._window)[self._band]) + _LEAST)
        sums = np.concatenate([[0.0], level.cumsum()])
        excess = level - (sums[self._right] - sums[self._left]) / (self._right - self._left)
        self._excess += _FORGET_LINES * (excess - self._excess)
        self._ratio += _FORGET_LINES * (np.exp(excess) - self._ratio)
        self._peaks += _FORGET_PEAKS * (np.maximum.reduceat(excess, self._starts) - self._peaks)
        self._moments += _FORGET_PEAKS * (self._moment(excess) - self._moments)

    def read(self) -> FloatArray:
        """Return steady lines, energy above the floor, peaks, harmonic series and strongest line."""
        steady = np.maximum.reduceat(self._excess, self._starts)
        tonal = np.log(np.add.reduceat(self._ratio, self._starts) / self._counts)
        comb, comb_square, weight, pitch, pitch_square, holds = self._moments.tolist()
        pitch, pitch_square = pitch / weight, pitch_square / weight
        spreads = [math.sqrt(max(comb_square - comb**2, 0.0)), math.sqrt(max(pitch_square - pitch**2, 0.0))]
        return np.concatenate([steady, tonal, self._peaks, [comb, spreads[0], pitch, spreads[1], holds]])

    def _moment(self, excess: FloatArray) -> FloatArray:
        # The log of the highest line in the spectrum of the spectrum, relative to its mean.
        low, high = _EXCESS
        clipped = np.minimum(np.maximum(excess, low), high)
        spectrum = power(rfft(clipped * self._taper, self._comb_size))
        highest = float(np.maximum.reduce(spectrum[self._combs]))
        comb = 0.5 * math.log((highest + _LEAST) / (float(mean(spectrum)) + _LEAST))
        strongest = int(excess.argmax())
        height, pitch = float(excess[strongest]), float(self._log_hz[strongest])
        weight, stands_out = math.exp(min(height, _HEIGHTS[1])), height > _HEIGHTS[0]
        return np.array([comb, comb * comb, weight, weight * pitch, weight * pitch * pitch, stands_out])


def _modulation(levels: FloatArray) -> FloatArray:
    r"""Return modulation by rate for low and high bands, and the share that is common to the high bands.

    .. math:: m_r = \ln \langle |E_b(f)|^2 \rangle_{b, f \in r}, \qquad
              c_r = \ln \frac{\sum_{f \in r} |\sum_b E_b(f)|^2}{\sum_{f \in r} \sum_b |E_b(f)|^2}
    """
    spectrum = rfft((levels - mean(levels, 0)).T * _TAPER)
    powers = power(spectrum)
    low, high = mean(powers[:_HIGH], 0), mean(powers[_HIGH:], 0)
    all_bands = power(np.add.reduce(spectrum[_HIGH:])) / (len(spectrum) - _HIGH)
    shared = np.log((_TOGETHER @ all_bands + _LEAST) / (_TOGETHER @ high + _LEAST))
    return np.concatenate([np.log(_RATES @ low + _STILL), np.log(_RATES @ high + _STILL), shared])


def _swings(levels: FloatArray) -> FloatArray:
    """Return rise and fall of the level, share of pauses, and change in low and high bands."""
    sums = mean(levels[:, _HIGH:], 1).cumsum()
    smooth = (sums[_SMOOTH:] - sums[:-_SMOOTH]) / _SMOOTH
    smooth.sort()
    low, middle, high = smooth[[int(q * len(smooth)) for q in _QUANTILES]]
    pause = smooth.searchsorted(middle - _PAUSE) / len(smooth)
    change = mean(np.abs(levels[_LAG:] - levels[:-_LAG]), 0)
    return np.array([high - middle, middle - low, pause, mean(change[:_HIGH]), mean(change[_HIGH:])])


def _means(edges_hz: tuple[float, ...], hz: np.ndarray) -> FloatArray:
    """Return the weights of means over the frequencies between edges, shape (bands, frequencies)."""
    inside = np.stack([(hz >= low) & (hz < high) for low, high in pairwise(edges_hz)])
    return np.asarray(inside / inside.sum(axis=1, keepdims=True))


_TAPER = np.hanning(_MEMORY + 2)[1:-1] / np.sqrt(0.375 * _MEMORY)
_RATES, _TOGETHER = (
    _means(edges_hz, np.fft.rfftfreq(_MEMORY, 1.0 / (_FRAMES * HOPS_A_SECOND)))
    for edges_hz in (_RATES_HZ, _TOGETHER_HZ)
)
