r"""Harmonic sum: the evidence of every candidate fundamental, and its most evident track.

A candidate f in window k is scored by the power P of its partials over the noise floor,

.. math:: Q_k(f) = \sum_h \big[\ln(1 + P_k(h f) / \nu_k(h f)) - q\big],

where the price q per partial keeps f / 2, half of whose partials are empty, from winning over f. The track is
the most evident one whose rate of change is limited.

Source: A. M. Noll, "Pitch determination of human speech by the harmonic product spectrum, the harmonic sum
spectrum and a maximum likelihood estimate", 1969; the track by A. J. Viterbi's algorithm, 1967.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from worldstate.ground.checks import in_range
from worldstate.ground.typing import FloatArray, IndexArray

# The Hann window loses 1.4 dB half way between two unpadded bins; with four times as many 0.1 dB.
ZERO_PADDING = 4
# Median of an exponential variable over its mean: from a median of powers to the noise power.
MEDIAN_OF_EXPONENTIAL = float(np.log(2.0))
BAND_HIGH_HZ = 1200.0  # Highest partial used
WINDOW_S, STEP_S = 0.25, 0.1  # Analysis window (Hann) and its step
_MOST_RATE_HZ = 0.4  # Largest relative change of the fundamental, |df/dt| / f, per second
# q, nats per partial. An empty partial has 0.6 nats of evidence on average: a lower price lets f / 2 win, a
# much higher one 2 f where upper harmonics are missing.
_PARTIAL_PRICE = 1.0
_FLOOR_WIDTH_HZ = 250.0  # Width of the running median that estimates the noise floor


@dataclass(frozen=True, slots=True)
class HarmonicSettings:
    """Range of the fundamental and number of partials of the harmonic sum.

    Examples
    --------
    >>> HarmonicSettings(low_hz=40.0).low_hz
    40.0
    """

    low_hz: float = 25.0  # Range of the fundamental; a firing frequency is 20 to 200 Hz
    high_hz: float = 200.0
    max_harmonics: int = 20  # Largest number of partials used; 1 tracks a single tone

    def __post_init__(self) -> None:
        # The fundamental must be resolved.
        in_range("low_hz", self.low_hz, 4.0 / WINDOW_S, np.inf)
        in_range("high_hz", self.high_hz, self.low_hz, BAND_HIGH_HZ, open_low=True)
        in_range("max_harmonics", self.max_harmonics, 1, 1000)


def spectrum_and_floor(frames: FloatArray, rate: float) -> tuple[FloatArray, FloatArray]:
    r"""Return the power of zero-padded windows and its noise floor, (K, bins) each, to the highest partial.

    .. math:: P_k[b] = \Big| \sum_n x_k[n]\, e^{-j 2\pi b n / 4N} \Big|^2, \qquad
              \nu_k[b] = \frac{1}{\ln 2}\, \mathrm{median}_{b'}\, P_k[b'] \text{ around } b

    Shapes: frames (K, n).
    """
    size = ZERO_PADDING * frames.shape[1]
    keep = int(np.ceil(BAND_HIGH_HZ * 1.02 * size / rate)) + 2
    power = np.abs(np.fft.rfft(frames, size)[:, :keep]) ** 2
    # A running median as the floor (ordered statistics, as in Rohling 1983): a mean would rise under a
    # partial. The padded bins are interpolations: every fourth is enough for the median.
    width = round(_FLOOR_WIDTH_HZ * frames.shape[1] / rate) | 1
    floor = ndimage.median_filter(power[:, ::ZERO_PADDING], size=(1, width), mode="nearest")
    grid = np.arange(keep)
    spread = np.stack([np.interp(grid, grid[::ZERO_PADDING], row) for row in floor])
    least = np.finfo(float).tiny + 1e-12 * power.max()
    return power, np.maximum(spread / MEDIAN_OF_EXPONENTIAL, least)


def best_path(ratio: FloatArray, bin_hz: float, settings: HarmonicSettings) -> FloatArray:
    r"""Return the most evident track of the fundamental on a logarithmic grid, shape (K,), Hz.

    .. math:: \hat f = \arg\max_{f_1 .. f_K} \sum_k \Big[ Q_k(f_k) - \frac{(i_k - i_{k-1})^2}{r^2} \Big],
              \qquad |i_k - i_{k-1}| \le r

    with Q above, i_k the index of f_k on the grid, and r the largest change from window to window.

    Shapes: ratio (K, bins).
    """
    # Half a resolution at the highest partial, so that no partial falls between two candidates.
    step = 0.5 / (WINDOW_S * BAND_HIGH_HZ)
    count = int(np.log(settings.high_hz / settings.low_hz) / step) + 2
    grid = np.geomspace(settings.low_hz, settings.high_hz, count)
    evidence = _harmonic_evidence(ratio, grid, bin_hz, settings)
    reach = max(1, int(np.ceil(_MOST_RATE_HZ * STEP_S / step)))
    return np.asarray(grid[_viterbi(evidence, reach)])


def _harmonic_evidence(
    ratio: FloatArray, grid: FloatArray, bin_hz: float, settings: HarmonicSettings
) -> FloatArray:
    gain = np.log1p(ratio) - _PARTIAL_PRICE
    evidence = np.zeros((len(ratio), len(grid)))
    for h in range(1, settings.max_harmonics + 1):
        inside = h * grid <= BAND_HIGH_HZ
        evidence[:, inside] += gain[:, np.round(h * grid[inside] / bin_hz).astype(np.intp)]
    return evidence


def _viterbi(evidence: FloatArray, reach: int) -> IndexArray:
    """Return the indices of the best path with steps of at most `reach`; a full step costs one nat."""
    offsets = np.arange(-reach, reach + 1)
    cost = (offsets / reach) ** 2
    columns = np.arange(evidence.shape[1])
    score, back = evidence[0], np.zeros(evidence.shape, dtype=np.intp)
    for k in range(1, len(evidence)):
        padded = np.pad(score, reach, constant_values=-np.inf)
        reached = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1) - cost
        best = np.argmax(reached, axis=1)
        back[k] = columns + offsets[best]
        score = evidence[k] + reached[columns, best]
    path = np.empty(len(evidence), dtype=np.intp)
    path[-1] = np.argmax(score)
    for k in range(len(evidence) - 1, 0, -1):
        path[k - 1] = back[k, path[k]]
    return path
