r"""The Markov chain of explanations in continuous time.

Its states are, in order: hidden in direction 1 .. K, in view having come from direction 1 .. K, in view from
elsewhere, none. All visible states leave at the same rates, so the chain lumps exactly onto (hidden_1 ..
hidden_K, visible, none) and, with equal rates for all directions, onto the three explanations. What the finer
chain adds is whether a source in view is the one that was heard while hidden.
"""

from functools import lru_cache

import numpy as np

from worldstate.abduction.rate_matrix import transitions
from worldstate.ground.typing import FloatArray

RatesHz = tuple[float, ...]
"""arrival (each), emergence, departure, reocclusion (all together), visible arrival, visible departure"""


@lru_cache(maxsize=64)
def generator(rates_hz: RatesHz, directions: int) -> FloatArray:
    r"""Return Q, shape (2K + 2, 2K + 2), 1/s: row i holds the rates out of state i and sums to zero."""
    arrival, emergence, departure, reocclusion, visible_arrival, visible_departure = rates_hz
    hidden, emerged = np.arange(directions), np.arange(directions, 2 * directions)
    elsewhere, none = 2 * directions, 2 * directions + 1
    rate = np.zeros((none + 1, none + 1))
    rate[hidden, emerged] = emergence
    rate[hidden, none] = departure
    rate[directions:none, :directions] = reocclusion / directions
    rate[directions:none, none] = visible_departure
    rate[none, hidden] = arrival
    rate[none, elsewhere] = visible_arrival
    np.fill_diagonal(rate, -rate.sum(axis=1))
    rate.flags.writeable = False
    return rate


@lru_cache(maxsize=256)
def transition(rates_hz: RatesHz, directions: int, step_ns: int) -> FloatArray:
    r"""Return exp(Q dt), shape (2K + 2, 2K + 2), rows sum to one; cached, hops repeat a few lengths only."""
    return transitions(generator(rates_hz, directions), step_ns)


@lru_cache(maxsize=64)
def equilibrium(rates_hz: RatesHz, directions: int) -> FloatArray:
    """Return the distribution that the chain reaches from "none" after a long time, shape (2K + 2,)."""
    settled: FloatArray = transition(rates_hz, directions, 10**12)[-1]
    return settled
