"""What an alarm makes of the approaches of a stream, and how far off stated times to visible are."""

import math
from dataclasses import dataclass

import numpy as np

from worldstate.abduction.sequence.sequence_model import COMING_S
from worldstate.ground.checks import check_shape
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.operations.metrics.approach_table import (
    AFTER_S,
    SLACK_S,
    ApproachOutcome,
    StreamApproach,
    rising_edges,
)

HORIZON_S = COMING_S[-1]  # Of the risk: an alarm earlier than that is about something else


def hop_outcome(
    approach: StreamApproach, time_s: FloatArray, raised: BoolArray, longest_s: float = HORIZON_S
) -> ApproachOutcome:
    """Return the outcome of one approach of a stream: time_s (n,), alarm of either side (n, 2).

    Alarms count from `longest_s` before T0 on.

    Examples
    --------
    >>> time_s = 0.1 * np.arange(100)
    >>> left = np.column_stack([time_s > 5.55, np.zeros(100, bool)])
    >>> found = hop_outcome(StreamApproach("single", (8.0,), (1,)), time_s, left)
    >>> round(found.lead_s, 1), found.own_side, found.other_side
    (2.4, False, True)
    """
    first_s, last_s = approach.entries_s[0], max(approach.entries_s)
    before, any_side = shortly_before(time_s, first_s, longest_s), np.asarray(raised.any(axis=1))
    alarms_s, onsets_s = time_s[before & any_side], time_s[rising_edges(any_side)]
    named = np.asarray(raised[before].any(axis=0))
    pairs = zip(approach.entries_s, approach.sides, strict=True)
    return ApproachOutcome(
        lead_s=first_s - float(alarms_s[0]) if alarms_s.size else 0.0,
        onsets=int(((onsets_s > first_s - longest_s) & (onsets_s < first_s)).sum()),
        onsets_after=int(((onsets_s >= last_s) & (onsets_s < last_s + AFTER_S)).sum()),
        own_side=bool(named[approach.sides[0]]),
        other_side=bool(named[1 - approach.sides[0]]),
        every_side=all(raised[shortly_before(time_s, t0_s, longest_s), side].any() for t0_s, side in pairs),
        approach=approach,
    )


def shortly_before(time_s: FloatArray, entry_s: float, longest_s: float = HORIZON_S) -> BoolArray:
    """Return the hops of the last seconds before a T0, shape (n,)."""
    return np.asarray((time_s > entry_s - longest_s) & (time_s < entry_s - SLACK_S))


@dataclass(frozen=True, slots=True)
class VisibleErrors:
    """Errors of stated times, and what the constants that fit these very truths best would reach.

    Examples
    --------
    >>> stated = np.array([[0.5, 1.0, 1.5], [1.0, 2.0, 3.0], [2.0, 3.0, 4.0]])
    >>> errors = visible_errors(stated, np.array([1.1, 2.5, 5.0]))
    >>> errors.count, round(errors.rmse_s, 2), round(errors.coverage, 2), round(errors.constant_rmse_s, 2)
    (3, 1.19, 0.67, 1.61)
    >>> stated[:, [0, 2]] = np.nan
    >>> without = visible_errors(stated, np.array([1.1, 2.5, 5.0]))
    >>> round(without.rmse_s, 2), without.coverage
    (1.19, nan)
    """

    count: int  # Times that were stated and can be checked
    intervals: int  # Of these, with an interval
    rmse_s: float  # Of the best value
    coverage: float  # Share of truths within the stated interval
    width_s: float  # Mean width of the stated interval
    # Fitted to the truths themselves, so that no constant known beforehand does better.
    constant_rmse_s: float


def visible_errors(stated: FloatArray, true_s: FloatArray) -> VisibleErrors:
    """Compare stated times to visible, low, best and high (n, 3), with the true seconds (n,).

    Rows without a best value, or that never come into view, are left out. Coverage and width are those of
    the rows that have an interval, NaN where none has: a method may state a time alone.

    Examples
    --------
    >>> visible_errors(np.full((2, 3), np.nan), np.ones(2)).count
    0
    """
    check_shape("stated", np.shape(stated), (len(true_s), 3))
    known = np.isfinite(stated[:, 1]) & np.isfinite(true_s)
    if not known.any():
        return VisibleErrors(0, 0, *[math.nan] * 4)
    best, true = stated[known, 1], true_s[known]
    bounded = known & np.isfinite(stated).all(axis=1)
    low, high = stated[bounded][:, [0, 2]].T
    inside = (low <= true_s[bounded]) & (true_s[bounded] <= high)
    return VisibleErrors(
        count=true.size,
        intervals=inside.size,
        rmse_s=float(np.sqrt(np.mean((best - true) ** 2))),
        coverage=float(inside.mean()) if inside.size else math.nan,
        width_s=float(np.mean(high - low)) if inside.size else math.nan,
        constant_rmse_s=float(true.std()),
    )
