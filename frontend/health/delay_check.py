r"""Delayed channels and cards with a clock of their own, by the delays that no plane wave explains.

Sharp beams show where the sound comes from. Each channel is then turned until it agrees best with all others
in these beams,

.. math:: \hat\tau_m = \arg\max_\tau \sum_k \mathrm{Re}\, e^{j \omega_k \tau} \sum_d w_d\, g_{kmd}

and what a tilt of all waves explains is taken out, because another direction of the sound would give it, too.
Repeated with the turned channels this is the self-calibration of radio astronomy.

References
----------
T. Pearson and A. Readhead, "Image formation by self-calibration in radio astronomy", Annu. Rev. Astron.
Astrophys. 22, 1984.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import BoolArray, Complex64Array, FloatArray, IndexArray

from .channel_health import ChannelFault, Fault
from .plane_waves import PlaneWaves, direction_weights, log_sharpness

_FLAT = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Card:
    """Consecutive channels, such as those of one sound card, and the amount by which they differ."""

    channels: BoolArray  # shape (M,)
    amount: float
    sensitivity: float  # Length of its pattern, of which a tilt of all waves explains nothing


def untilted(positions_m: FloatArray, known: BoolArray) -> FloatArray:
    r"""Return the matrix that takes from values of channels what another direction of sound explains.

    .. math:: Q = I - X (X^T X)^+ X^T, \qquad X = [1, p]

    over the known channels, zero elsewhere. Shapes: positions_m (M, 3), known (M,), returns (M, M).
    """
    if not known.any():
        return np.zeros((len(known), len(known)))
    centred = (positions_m - positions_m[known].mean(axis=0)) * known[:, None]
    design = np.column_stack([known.astype(float), centred])
    basis, size, _ = np.linalg.svd(design, full_matrices=False)
    basis = basis[:, size > 1e-6 * max(float(size[0]), _FLAT)]
    return np.asarray(np.diag(known.astype(float)) - basis @ basis.T)


def runs(n_channels: int) -> FloatArray:
    """All runs of consecutive channels up to half of them, (R, M) of ones and zeros.

    Examples
    --------
    >>> runs(3)
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]])
    """
    index = np.arange(n_channels)
    found = [
        (index >= first) & (index < first + length)
        for length in range(1, n_channels // 2 + 1)
        # Of two halves only the later one: that the others differ from it is the same.
        for first in range(n_channels // 2 if 2 * length == n_channels else 0, n_channels - length + 1)
    ]
    return np.asarray(found, np.float64)


def best_card(values: FloatArray, projection: FloatArray, candidates: FloatArray) -> Card:
    r"""Return the run of channels that explains most of the projected values.

    .. math:: \hat c = \arg\max_c \frac{(c^T v)^2}{c^T Q c}, \qquad \hat a = \frac{c^T v}{c^T Q c}

    Shapes: values (M,), projection Q (M, M), candidates (R, M).
    """
    power = np.einsum("rm,mn,rn->r", candidates, projection, candidates, optimize=True)
    # A pattern that a tilt explains but for a twentieth would turn any noise into a large amount.
    power = np.where(power > 0.05 * candidates.sum(axis=1), power, np.inf)
    found = candidates @ values
    best = int((found**2 / power).argmax())
    return Card(candidates[best] > 0.0, float(found[best] / power[best]), float(np.sqrt(power[best])))


# Delays searched in one second, beyond those known from the seconds before: half a period of 700 Hz.
_SEARCH_S = np.arange(-8e-4, 8.01e-4, 2e-5)
# Seconds remembered, and the fewest with a verdict on delays and on drifts.
_MEMORY_S, _MIN_DELAY_S, _MIN_DRIFT_S = 30, 6, 8
# Share of the median channel's agreement below which a channel's delay means nothing.
_GOOD = 0.3
# Share of the seconds in which a channel must be good.
_MOSTLY = 0.7
# More of the sound than this from steeply above or below: the own vehicle, whose near sources have delays
# of up to 0.15 ms that no plane wave has. They are steady, so that drifts can still be judged; among many
# channels the pattern of a card is three times as long as theirs.
_NEAR = 0.5
# Fewer free delays than this, and any scatter looks like a card.
_MIN_FREEDOM = 3.0
# Least delay of a card and of one channel, and least length of its pattern over the root of the number of
# channels. Scattering at the roof delays a vehicle's sound by 0.1 ms at random. Simulated streets, 8
# microphones, 10 s: lengths of 0.135 ms and more with a card 0.3 ms late, of 0.14 ms at most and mostly below
# 0.09 ms without.
_DELAY_S, _LONE_DELAY_S, _DELAY_RMS_S = 1.5e-4, 4e-4, 4.6e-5
# Least drift, 20 millionths, and least length of its pattern over twenty seconds. A passing vehicle, whose
# sound is scattered by the roof, looks like a drift for some seconds: the error falls as the time to the 3/2.
_DRIFT, _DRIFT_LENGTH, _DRIFT_SPAN_S = 2e-5, 2e-5, 20.0
# Streams of 8 microphones: 11 where a siren passes a healthy array, 17 and more within 30 s at 50 millionths.
_SIGMAS = 12.0
# Small arrays are compared in several rounds a second; the beams of large ones hardly change by one card.
_ROUNDS, _FEW_CHANNELS = 3, 16


class DelayCheck:
    """Follow the delay of every channel, second by second."""

    def __init__(self, array: MicrophoneArray, waves: PlaneWaves, frequencies_hz: FloatArray) -> None:
        n = array.n_microphones
        self._positions = array.positions_m
        self._waves = waves
        self._omega = 2.0 * np.pi * frequencies_hz
        self._search = np.exp(1j * self._omega[:, None] * _SEARCH_S)
        self._delays = np.zeros(n)
        self.log_sharpness = 0.0  # In the last second, of the channels without their delays
        self._runs = runs(n)
        # A clock drives two channels at least; one alone that moves is one that stands elsewhere.
        self._cards = self._runs[self._runs.sum(axis=1) > 1.0]
        self._rounds = _ROUNDS if n <= _FEW_CHANNELS else 1
        self._values: deque[FloatArray] = deque(maxlen=_MEMORY_S)
        self._far: deque[bool] = deque(maxlen=_MEMORY_S)

    def push(self, coherence: Complex64Array, active: BoolArray) -> None:
        r"""Take the coherence (K, M, M) of one second, its diagonal zero, and the active channels (M,).

        .. math:: \hat\tau \leftarrow Q (\hat\tau + \Delta\tau)
        """
        for _ in range(self._rounds):
            turn = np.exp(1j * self._omega[:, None] * self._delays).astype(np.complex64)
            agreement = self._waves.agreement(coherence * turn[:, :, None] * turn.conj()[:, None, :])
            weights = direction_weights(agreement)
            moved, good = self._peaks(agreement @ weights, active)
            found = untilted(self._positions, good) @ (self._delays + moved)
            self._delays = np.where(good, found, self._delays)
        self.log_sharpness = log_sharpness(agreement)
        self._values.append(np.where(good, self._delays, np.nan))
        near = float(weights @ self._waves.is_steep) > _NEAR
        self._far.append(not near or len(good) > _FEW_CHANNELS)

    @property
    def incoherent(self) -> BoolArray:
        """Channels that agreed with no wave in the last two seconds, (M,)."""
        latest = list(self._values)[-2:]
        return np.asarray(np.isnan(latest).all(axis=0)) if latest else np.ones(len(self._delays), bool)

    def _peaks(self, agreement: Complex64Array, active: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Return the delay at which every channel agrees best, (M,), and the channels that agree with any."""
        table = (agreement.T @ self._search).real
        at = np.clip(table.argmax(axis=1), 1, len(_SEARCH_S) - 2)
        rows = np.arange(len(at))
        before, peak, after = (table[rows, at + step] for step in (-1, 0, 1))
        # A channel that agrees with nothing has no bend.
        bend = np.minimum(before - 2.0 * peak + after, -1e-12)
        step = _SEARCH_S[1] - _SEARCH_S[0]
        moved = _SEARCH_S[at] + step * np.clip(0.5 * (before - after) / bend, -1.0, 1.0)
        good = active & (peak > _GOOD * np.median(peak[active])) if active.any() else active
        return np.where(good, moved, 0.0), good

    def faults(self) -> list[ChannelFault]:
        """Return the channels of a card that drifts, or else those of one that is late."""
        if not self._values:
            return []
        values = np.array(self._values)
        known = np.isfinite(values).mean(axis=0) > _MOSTLY
        free = untilted(self._positions, known)
        if np.trace(free) < _MIN_FREEDOM or not len(self._cards):
            return []
        whole = np.isfinite(values[:, known]).all(axis=1)
        values = np.where(known, values, 0.0)
        return self._drift(values[whole], np.flatnonzero(whole), free) or self._late(
            values[whole & np.array(self._far)], free
        )

    def _drift(self, values: FloatArray, seconds: IndexArray, free: FloatArray) -> list[ChannelFault]:
        if len(seconds) < _MIN_DRIFT_S:
            return []
        time = seconds - seconds.mean()
        card = best_card(free @ (time @ values) / (time @ time), free, self._cards)
        error = _slope_error(time, values @ card.channels / card.sensitivity**2)
        length = abs(card.amount) * card.sensitivity * (np.ptp(seconds) / _DRIFT_SPAN_S) ** 1.5
        if abs(card.amount) < max(_DRIFT, _SIGMAS * error) or length < _DRIFT_LENGTH:
            return []
        return _named(card, Fault.DRIFT, error)

    def _late(self, values: FloatArray, free: FloatArray) -> list[ChannelFault]:
        if len(values) < _MIN_DELAY_S:
            return []
        card = best_card(free @ np.median(values, axis=0), free, self._runs)
        amount, root = abs(card.amount), float(np.sqrt(np.count_nonzero(card.channels)))
        if amount < max(_DELAY_S, _LONE_DELAY_S / root) or amount * card.sensitivity < _DELAY_RMS_S * np.sqrt(
            len(free)
        ):
            return []
        paths = values @ card.channels / card.sensitivity**2
        # Standard deviation of a median.
        return _named(card, Fault.DELAY, 1.25 * float(paths.std()) / np.sqrt(len(paths)))


def _slope_error(time: FloatArray, path: FloatArray) -> float:
    r"""Return the standard deviation of the slope of a line through (n,) points.

    .. math:: \sigma^2 = \frac{\sum e^2}{(n - 2) \sum (t - \bar t)^2}
    """
    rest = path - path.mean() - (time @ path) / (time @ time) * time
    return float(np.sqrt((rest @ rest) / (len(time) - 2) / (time @ time)))


def _named(card: Card, fault: Fault, std: float) -> list[ChannelFault]:
    channels = np.flatnonzero(card.channels).tolist()
    return [ChannelFault(channel, fault, card.amount, std=std) for channel in channels]
