"""Simulated days on which the budget watch of an alarm should, or should not, report a broken budget.

Time without a vehicle coming into view, and bets on the published chances, are cut into blocks of six
minutes. A day consists of blocks drawn with replacement. For a higher onset rate, a Poisson number of blocks
is superimposed, so that the clusters of onsets are preserved. The watch processes each day as in operation.
Days of onsets consist of quiet time only.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from worldstate.abduction.sequence.sequence_model import HORIZONS_S
from worldstate.core.budget_watch import BET_S, RATES, BudgetWatch, chance_factors, onset_factors
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import SECONDS_PER_HOUR, seconds
from worldstate.operations.metrics.approach_table import Figures, share_interval
from worldstate.operations.recordings.hop_table import HOP_S

from .followed_stream import PassedStream

# Seconds of a block and of a step; blocks of a day and of six hours
BLOCK_S, STEP_S, BLOCKS, LATER_BLOCKS = 360.0, 10.0, 240, 60


def quiet_blocks(streams: Sequence[PassedStream]) -> FloatArray:
    """Return the number of false onsets per ten seconds of quiet time, shape (blocks, 36)."""
    start_s, onsets_s = 0.0, list[float]()
    for tallies in (one.followed.tallies for one in streams):
        quiet_s = start_s + np.array([seconds(tally.quiet_ns) for tally in tallies])
        onsets_s += np.repeat(quiet_s, np.diff([tally.false_onsets for tally in tallies], prepend=0)).tolist()
        start_s = float(quiet_s[-1])
    steps = round(BLOCK_S / STEP_S)
    whole = int(start_s // BLOCK_S) * steps
    counts = np.histogram(onsets_s, STEP_S * np.arange(whole + 1))[0]
    return counts.reshape(-1, steps).astype(np.float64)


def chance_blocks(streams: Sequence[PassedStream]) -> FloatArray:
    """Return the evidence of outcomes against the chances, one bet per 2 s, shape (blocks, 180, 2)."""
    bets, every = list[list[float]](), round(BET_S / HOP_S)
    for one in streams:
        chances = one.followed.within[::every, :, HORIZONS_S.index(BET_S)]
        came, said = one.truth.coming_s[::every] <= BET_S, np.isfinite(chances).all(axis=1)
        bets += map(chance_factors, chances[said].tolist(), came[said].tolist())
    each = round(BLOCK_S / BET_S)
    return np.array(bets[: len(bets) // each * each]).reshape(-1, each, 2)


def budget_days(
    streams: Sequence[PassedStream], onsets_per_hour: float, days: int, rng: np.random.Generator
) -> Iterator[tuple[str, Figures]]:
    """Yield how often and how soon the watch reports a broken claim, on days of each kind.

    Parameters
    ----------
    streams : sequence of PassedStream
        Source of the blocks.
    onsets_per_hour : float
        The budget.
    days : int
        Number of days of each kind.
    rng : numpy.random.Generator
        Draws the days.

    Raises
    ------
    InvalidArgumentError
        If the streams have no false onset in six minutes of quiet time or more.
    """
    quiet, chances = quiet_blocks(streams), chance_blocks(streams)
    if not quiet.sum():
        found = f"got none in {len(quiet) * BLOCK_S / 60.0:g} minutes"
        raise InvalidArgumentError(f"streams: expected false onsets in quiet time, {found}; add streams")
    rate = float(quiet.mean() * SECONDS_PER_HOUR / STEP_S)
    factors = [onset_factors(n, STEP_S, onsets_per_hour) for n in range(round(STEP_S / HOP_S) + 1)]

    def onsets(per_hour: float, later: int = 0) -> Figures:
        """Return the figures of days with this onset rate, after some blocks with the original rate."""
        times_s = []
        for _ in range(days):
            before = quiet[rng.integers(len(quiet), size=later)]
            many = rng.poisson(per_hour / rate, BLOCKS).tolist()
            upon = [quiet[rng.integers(len(quiet), size=n)].sum(axis=0) for n in many]
            counts = np.concatenate([before.ravel(), *upon]).astype(int).tolist()
            times_s.append(broken_after_s((factors[n] for n in counts), STEP_S) - later * BLOCK_S)
        return _figures(times_s, per_hour)

    def bets(blocks: FloatArray) -> Figures:
        """Return the figures of days that consist of these blocks of bets."""
        drawn = (blocks[rng.integers(len(blocks), size=BLOCKS)].reshape(-1, 2).tolist() for _ in range(days))
        return _figures([broken_after_s(one, BET_S) for one in drawn])

    yield "as they are", onsets(rate)
    yield "the budget", onsets(onsets_per_hour)
    for ratio in RATES:
        yield f"{ratio:g} times", onsets(ratio * onsets_per_hour)
    yield f"{RATES[0]:g} times, after six hours", onsets(RATES[0] * onsets_per_hour, LATER_BLOCKS)
    empty = chance_blocks([one for one in streams if one.heard.hazard_free])
    for name, blocks in (("chances", chances), ("chances without hazards", empty)):
        if len(blocks):
            yield name, bets(blocks)


def broken_after_s(factors: Iterable[Sequence[float]], step_s: float) -> float:
    """Return the time after which a claim is broken, infinite if it never is."""
    evidence = BudgetWatch().onsets
    for number, one in enumerate(factors, 1):
        evidence = evidence.after(one, step_s)
        if evidence.broken:
            return number * step_s
    return np.inf


def _figures(times_s: Sequence[float], onsets_per_hour: float | None = None) -> Figures:
    hours = np.array(times_s) / SECONDS_PER_HOUR
    broken = int(np.isfinite(hours).sum())
    low, high = share_interval(broken, len(hours))
    median = float(np.median(hours))
    return {
        "onsets_per_hour": onsets_per_hour,
        "broken": broken / len(hours),
        "broken_low": low,
        "broken_high": high,
        "median_h": median if np.isfinite(median) else None,
    }
