"""Days drawn from streams, on which the watch over an alarm's budget has to speak up, or to keep quiet.

Time in which no vehicle comes into view, and bets on the chances, are cut into blocks of six minutes. A day
is drawn from them, block by block and with replacement. For more onsets an hour as many blocks lie upon each
other as a Poisson number says, so that onsets come in the clusters in which the alarm raised them. What a
day brings is taken in by the watch's own evidence; of onsets all hours are of quiet time.
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

BLOCK_S, STEP_S, BLOCKS, LATER_BLOCKS = 360.0, 10.0, 240, 60  # A day, and six hours


def quiet_blocks(streams: Sequence[PassedStream]) -> FloatArray:
    """Return the false onsets of every ten seconds of quiet time, shape (blocks, 36)."""
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
    """Return what outcomes bring against the chances, a bet every two seconds, shape (blocks, 180, 2)."""
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
    """Yield how often the watch calls its claims broken, in so many days of each kind, and how soon.

    Parameters
    ----------
    streams : sequence of PassedStream
        From which days are drawn.
    onsets_per_hour : float
        The budget.
    days : int
        Of each kind.
    rng : numpy.random.Generator
        Draws them.

    Raises
    ------
    InvalidArgumentError
        If the streams have no false onset in six minutes of quiet time or more.
    """
    quiet, chances = quiet_blocks(streams), chance_blocks(streams)
    if not quiet.sum():
        found = f"got none in {len(quiet) * BLOCK_S / 60.0:g} minutes"
        raise InvalidArgumentError(f"streams: expected false onsets in quiet time, {found}: more streams")
    rate = float(quiet.mean() * SECONDS_PER_HOUR / STEP_S)
    factors = [onset_factors(n, STEP_S, onsets_per_hour) for n in range(round(STEP_S / HOP_S) + 1)]

    def onsets(per_hour: float, later: int = 0) -> Figures:
        """Return the figures of days with so many onsets an hour, after some blocks as they are."""
        times_s = []
        for _ in range(days):
            before = quiet[rng.integers(len(quiet), size=later)]
            many = rng.poisson(per_hour / rate, BLOCKS).tolist()
            upon = [quiet[rng.integers(len(quiet), size=n)].sum(axis=0) for n in many]
            counts = np.concatenate([before.ravel(), *upon]).astype(int).tolist()
            times_s.append(broken_after_s((factors[n] for n in counts), STEP_S) - later * BLOCK_S)
        return _figures(times_s, per_hour)

    def bets(blocks: FloatArray) -> Figures:
        """Return the figures of days with such outcomes of chances."""
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
    """Return after how long a claim is broken, infinite where it never is."""
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
