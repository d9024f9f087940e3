"""Simulated days for the watch over the budget: kept budgets, broken ones, and the time to detection."""

from dataclasses import dataclass

import numpy as np
import pytest
from worldstate_lab.passes.budget_days import broken_after_s, budget_days, chance_blocks, quiet_blocks

from worldstate.abduction.sequence.sequence_model import HORIZONS_S
from worldstate.core.budget_watch import onset_factors
from worldstate.ground.errors import InvalidArgumentError
from worldstate.state.cue import Tally

HOPS = 36_000  # One hour
BUDGET = 25.0


@dataclass(frozen=True)
class MadeUp:
    """The fields of a stream and of its beliefs from which days are drawn."""

    tallies: tuple[Tally, ...]
    within: np.ndarray
    coming_s: np.ndarray
    hazard_free: bool = False

    followed = truth = heard = property(lambda self: self)


def street(per_hour: float, seed: int, chance: float = 0.05, true: float = 0.05) -> MadeUp:
    """Return an hour with random onsets, and chances for two seconds of which a share comes true."""
    rng = np.random.default_rng(seed)
    false = np.cumsum(rng.random(HOPS) < per_hour / HOPS).tolist()
    tallies = tuple(Tally(quiet_ns=100_000_000 * k, false_onsets=n) for k, n in enumerate(false, 1))
    came = np.repeat(rng.random((HOPS // 20, 2)) < true, 20, axis=0)
    within = np.full((HOPS, 2, len(HORIZONS_S)), chance)
    return MadeUp(tallies, within, np.where(came, 1.0, np.inf))


def test_every_onset_of_whole_blocks_is_in_the_block_in_which_it_came() -> None:
    streams = [street(60.0, seed) for seed in (1, 2)]
    blocks = quiet_blocks(streams)
    assert blocks.shape == (20, 36)
    assert blocks.sum() == sum(one.tallies[-1].false_onsets for one in streams)
    assert blocks[0].sum() == streams[0].tallies[3599].false_onsets
    assert chance_blocks(streams).shape == (20, 180, 2)


def test_a_kept_budget_is_not_reported_and_larger_excess_is_detected_sooner() -> None:
    streams = [street(12.0, seed) for seed in range(6)]
    found = dict(budget_days(streams, BUDGET, 40, np.random.default_rng(0)))
    assert found["as they are"]["broken"] == found["chances"]["broken"] == 0.0
    assert found["the budget"]["broken"] <= 0.1
    twice, ten, later = (found[name] for name in ("2 times", "10 times", "2 times, after six hours"))
    assert twice["broken"] == ten["broken"] == later["broken"] == 1.0
    assert ten["median_h"] < 0.25 < twice["median_h"] < later["median_h"] < 6.0


@pytest.mark.parametrize(("chance", "true"), [(0.4, 0.02), (0.02, 0.4)])
def test_chances_that_do_not_come_true_are_detected(chance: float, true: float) -> None:
    streams = [street(12.0, 1, chance, true)]
    found = dict(budget_days(streams, BUDGET, 5, np.random.default_rng(0)))
    assert found["chances"]["broken"] == 1.0


def test_no_onset_never_breaks_a_budget() -> None:
    assert broken_after_s([onset_factors(0, 10.0, BUDGET)] * 8640, 10.0) == np.inf


def test_streams_without_a_false_onset_are_rejected() -> None:
    with pytest.raises(InvalidArgumentError, match=r"expected false onsets .*, got none in 60 minutes"):
        next(budget_days([street(0.0, 1)], BUDGET, 1, np.random.default_rng(0)))
