"""Signals that arrive late, and later every moment: retarded time with fractional delays.

A source is a table, oversampled so that linear interpolation between its values is exact enough (for factor
4 at 48 kHz the error is below -50 dB up to 4 kHz). Emission times are known at knots and linear in between,
which is smooth enough for anything on wheels and makes Doppler a consequence, not a factor.
"""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import Float32Array, FloatArray, IndexArray

KNOT_SAMPLES = 128
OVERSAMPLING = 4
ROWS_AT_ONCE = 256
RAMP = np.arange(KNOT_SAMPLES, dtype=np.float32) / np.float32(KNOT_SAMPLES)


@dataclass(frozen=True, slots=True)
class Table:
    """An oversampled emitted signal and when it begins."""

    values: Float32Array  # shape (n,): float32
    start_s: float  # Emission time of the first value
    rate_hz: float  # Rate of the table, `OVERSAMPLING` times the sample rate


def emission_times(
    receive_s: FloatArray, emit_s: FloatArray, travel_m: FloatArray, speed_mps: float
) -> FloatArray:
    """Solve t = t_e + r(t_e) / c for the emission times t_e of given receive times.

    Shapes: receive_s (K,), emit_s, travel_m (T,).
    """
    return np.interp(receive_s, emit_s + travel_m / speed_mps, emit_s, left=np.nan, right=np.nan)


def add_delayed(out: Float32Array, table: Table, emit_s: FloatArray, gain: FloatArray) -> None:
    """Add a delayed signal to `out`, block by block between knots.

    Shapes: out (K * KNOT_SAMPLES,), emit_s (K + 1,), gain (K + 1,).
    """
    at = (emit_s - table.start_s) * table.rate_hz
    low, high = at[:-1], at[1:]
    with np.errstate(invalid="ignore"):
        heard = np.flatnonzero((low >= 0.0) & (high < len(table.values) - 2))
    if not len(heard):
        return
    span = slice(int(heard[0]), int(heard[-1]) + 1)  # one span: emission times increase
    base = np.floor(low[span])
    lines = _Lines(low[span] - base, high[span] - base), _Lines(gain[:-1][span], gain[1:][span])
    _add_between_knots(out.reshape(-1, KNOT_SAMPLES)[span], table, base.astype(np.intp)[:, None], *lines)


class _Lines:
    """Straight lines over knot intervals, each from `low` (K,) to `high` (K,)."""

    def __init__(self, low: FloatArray, high: FloatArray) -> None:
        self._start = low.astype(np.float32)[:, None]
        self._rise = (high - low).astype(np.float32)[:, None]

    def into(self, out: Float32Array, rows: slice) -> None:
        """Write the samples of some intervals, shape (rows, KNOT_SAMPLES)."""
        np.multiply(self._rise[rows], RAMP, out=out)
        out += self._start[rows]


def _add_between_knots(
    rows: Float32Array, table: Table, base: IndexArray, places: _Lines, gains: _Lines
) -> None:
    """Interpolate the table; a few intervals at a time, so that everything stays in the cache."""
    left, right, fraction = np.empty((3, ROWS_AT_ONCE, KNOT_SAMPLES), np.float32)
    index, later = np.empty((ROWS_AT_ONCE, KNOT_SAMPLES), np.intp), table.values[1:]
    for first in range(0, len(rows), ROWS_AT_ONCE):
        some = slice(first, min(first + ROWS_AT_ONCE, len(rows)))
        count = some.stop - first
        low, high, part, at = left[:count], right[:count], fraction[:count], index[:count]
        places.into(part, some)
        np.floor(part, out=low)
        np.copyto(at, low, casting="unsafe")
        part -= low
        at += base[some]
        table.values.take(at, out=low, mode="clip")
        later.take(at, out=high, mode="clip")
        high -= low
        high *= part
        high += low
        gains.into(low, some)
        high *= low
        rows[some] += high
