"""Posteriors of a sequence at the prior of a context, and Markov chains in continuous time."""

import math

import numpy as np

from worldstate.ground import NANOSECONDS_PER_SECOND, TINY, FloatArray

from .sequence_model import COMING_S

_COMING = len(COMING_S)
# A wrong prior on both sides acts like a shifted threshold: +2 nats increase the onsets from 15 to 58 per
# hour, and -1 nat reduces the detection rate from 0.94 to 0.73.
_LEAST_SHIFT, _LARGEST_SHIFT = -0.5, 2.0


def at_prior(posterior: FloatArray, share: FloatArray, prior: FloatArray) -> FloatArray:
    r"""Return a posterior at another prior than that of its training, shapes (..., groups).

    .. math:: q^c \propto q\, c / \pi

    Examples
    --------
    >>> at_prior(np.array([0.5, 0.5]), np.array([0.5, 0.5]), np.array([0.2, 0.8]))
    array([0.2, 0.8])
    """
    moved = posterior * prior / share
    return np.asarray(moved / moved.sum(axis=-1, keepdims=True))


def context_prior(share: FloatArray, hidden: float | None) -> FloatArray:
    """Return the prior of one side's groups if the context gives a probability of a hidden vehicle there.

    Without this probability it is the model's share. The shift in log-odds is bounded.

    Examples
    --------
    >>> share = np.full(15, 1.0 / 15)
    >>> round(float(context_prior(share, 0.99)[:9].sum()), 3)
    0.917
    """
    if hidden is None:
        return np.asarray(share / share.sum())
    coming = float(share[:_COMING].sum() / share.sum())
    # The log-odds of a prior of 0 or 1 are infinite, but the shift must be finite.
    expected = min(max(hidden, TINY), 1.0 - TINY)
    shift = math.log(expected / (1.0 - expected)) - math.log(coming / (1.0 - coming))
    factor = math.exp(min(max(shift, _LEAST_SHIFT), _LARGEST_SHIFT))
    moved = np.concatenate([share[:_COMING] * factor, share[_COMING:]])
    return np.asarray(moved / moved.sum())


def balanced(chain: FloatArray, share: FloatArray, rounds: int = 2000) -> FloatArray:
    r"""Return the chain closest to a given one with the given stationary distribution.

    .. math:: \pi A = \pi

    Source: R. Sinkhorn, "A relationship between arbitrary positive matrices and doubly stochastic matrices",
    Ann. Math. Statist. 35, 1964: the flows are scaled alternately by rows and columns.

    Examples
    --------
    >>> share = np.array([0.1, 0.9])
    >>> chain = balanced(np.array([[0.5, 0.5], [0.5, 0.5]]), share)
    >>> np.allclose(share @ chain, share), np.allclose(chain.sum(axis=1), 1.0)
    (True, True)
    """
    flows = share[:, None] * np.maximum(chain, TINY)
    for _ in range(rounds):
        flows *= (share / flows.sum(axis=0))[None, :]
        flows *= (share / flows.sum(axis=1))[:, None]
    return np.asarray(flows / flows.sum(axis=1, keepdims=True))


# At rates above 0.01/s a chain is in equilibrium after this time; a larger exponent only loses precision.
LONGEST_STEP_S = 1000.0
_MOST_JUMPS = 20  # With a mean of at most one jump, the probability of more is below 1e-18


def transitions(rates_hz: FloatArray, step_ns: int) -> FloatArray:
    r"""Return exp(Q dt), read-only, rows sum to one; shapes (states, states).

    .. math:: e^{Q t} = \Big( \sum_n e^{-m} \frac{m^n}{n!} J^n \Big)^{2^h}, \qquad
              J = I + \frac{Q t}{2^h m}, \quad m = \frac{\max_i -Q_{ii} t}{2^h} \le 1

    All terms are non-negative, so no precision is lost.

    Source: A. Jensen, "Markoff chains as an aid in the study of Markoff processes", Scand. Actuar. J., 1953
    (uniformisation). It uses numpy, because scipy.linalg takes longer to import than numpy.

    Examples
    --------
    >>> transitions(np.array([[-0.1, 0.1], [0.0, 0.0]]), 10**10).round(3)
    array([[0.368, 0.632],
           [0.   , 1.   ]])
    """
    step_s = min(step_ns / NANOSECONDS_PER_SECOND, LONGEST_STEP_S)
    jumps = max(float(-rates_hz.diagonal().min()) * step_s, TINY)
    halvings = max(math.ceil(math.log2(jumps)), 0)
    mean, one = jumps / 2.0**halvings, np.eye(len(rates_hz))
    jump, term = one + rates_hz * (step_s / jumps), math.exp(-mean) * one
    matrix = term.copy()
    for count in range(1, _MOST_JUMPS + 1):
        term = term @ jump * (mean / count)
        matrix += term
    for _ in range(halvings):
        matrix = matrix @ matrix
    matrix /= matrix.sum(axis=1, keepdims=True)
    matrix.flags.writeable = False
    return matrix
