"""Signals that arrive late, and later every moment: retarded time with fractional delays.

A source is a table, oversampled so that linear interpolation between its values is exact enough (for factor
4 at 48 kHz the error is below -50 dB up to 4 kHz). Emission times are known at knots and linear in between,
which is smooth enough for anything on wheels and makes Doppler a consequence, not a factor.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

KNOT_SAMPLES = 128
OVERSAMPLING = 4


@dataclass(frozen=True, slots=True)
class Table:
    """An oversampled emitted signal and when it begins.

    Parameters
    ----------
    values : ndarray, shape (n,)
        float32.
    start_s : float
        Emission time of the first value.
    rate_hz : float
        Rate of the table, `OVERSAMPLING` times the sample rate.
    """

    values: NDArray[np.float32]
    start_s: float
    rate_hz: float


def emission_times(
    receive_s: NDArray[np.float64],
    emit_s: NDArray[np.float64],
    travel_m: NDArray[np.float64],
    speed_mps: float,
) -> NDArray[np.float64]:
    """Solve t = t_e + r(t_e) / c for the emission times t_e of given receive times.

    Parameters
    ----------
    receive_s : ndarray, shape (K,)
        Receive times.
    emit_s, travel_m : ndarray, shape (T,)
        Path length at increasing emission times; the source must be slower than sound.
    speed_mps : float
        Speed of sound.

    Returns
    -------
    ndarray, shape (K,)
        NaN where the answer lies outside `emit_s`.

    Examples
    --------
    >>> emission_times(np.array([1.0]), np.array([0.0, 2.0]), np.array([34.3, 34.3]), 343.0)
    array([0.9])
    """
    return np.interp(receive_s, emit_s + travel_m / speed_mps, emit_s, left=np.nan, right=np.nan)


def add_delayed(
    out: NDArray[np.float32], table: Table, emit_s: NDArray[np.float64], gain: NDArray[np.float64]
) -> None:
    """Add a delayed signal to `out`, block by block between knots.

    Parameters
    ----------
    out : ndarray, shape (K * KNOT_SAMPLES,)
        float32, added to in place.
    table : Table
        What was emitted.
    emit_s : ndarray, shape (K + 1,)
        Emission times at the knots; NaN where nothing arrives.
    gain : ndarray, shape (K + 1,)
        Amplitude factor at the knots.
    """
    at = (emit_s - table.start_s) * table.rate_hz
    low, high = at[:-1], at[1:]
    with np.errstate(invalid="ignore"):
        heard = np.flatnonzero((low >= 0.0) & (high < len(table.values) - 2))
    if not len(heard):
        return
    first, last = heard[0], heard[-1] + 1  # one span: emission times increase
    whole, fraction = _positions(low[first:last], high[first:last])
    start = table.values[whole]
    value = start + fraction * (table.values[whole + 1] - start)
    value *= _ramps(gain[first:last], gain[first + 1 : last + 1])
    out.reshape(-1, KNOT_SAMPLES)[first:last] += value


def _positions(
    low: NDArray[np.float64], high: NDArray[np.float64]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Table index and fraction of every sample, shape (K, KNOT_SAMPLES)."""
    base = np.floor(low)
    offset = _ramps(low - base, high - base)
    step = offset.astype(np.int32)
    offset -= step
    step += base.astype(np.int32)[:, None]
    return step, offset


def _ramps(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float32]:
    """Straight lines from `low` to `high` over one knot interval, shape (K, KNOT_SAMPLES)."""
    ramp = np.arange(KNOT_SAMPLES, dtype=np.float32) / np.float32(KNOT_SAMPLES)
    return low.astype(np.float32)[:, None] + (high - low).astype(np.float32)[:, None] * ramp
