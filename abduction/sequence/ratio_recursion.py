r"""A sequence's posterior in a Bayesian recursion, counted once, and Markov chains in continuous time.

Hops are correlated over seconds, and q, the posterior that a sequence model reads from the last three of
them, already holds what they said together. Multiplied at every hop, or onto the belief of some time ago, it
counts them again (detection .94 becomes .76 to .90). Instead the belief moves as q moves:

.. math:: q^c_t \propto q_t\, c / \pi, \qquad m_t = p_{t-1} A^n, \qquad n_t = q^c_{t-1} A^n, \qquad
          p_t \propto q^c_t \Big( \frac{m_t}{n_t} \Big) \prod_j l_j

with the context's prior c in place of pi, at which the model was trained, the chain A of the hops since the
last evidence, and the likelihoods l of everything else. Without any of these p = q^c, whatever the chain: m
and n are the same. What else spoke keeps its worth and is forgotten as the chain forgets.
"""

from dataclasses import dataclass

import numpy as np

from worldstate.ground import NANOSECONDS_PER_SECOND, FloatArray

# Below it a probability is none, and the ratio of two of them says nothing.
_SMALLEST = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class SequenceBelief:
    """The belief of some sides, and what the sequence alone would make of it, each (sides, groups)."""

    belief: FloatArray
    alone: FloatArray


def at_prior(posterior: FloatArray, share: FloatArray, prior: FloatArray) -> FloatArray:
    r"""Return a posterior at another prior than it was trained at, shapes (..., groups).

    .. math:: q^c \propto q\, c / \pi

    Examples
    --------
    >>> at_prior(np.array([0.5, 0.5]), np.array([0.5, 0.5]), np.array([0.2, 0.8]))
    array([0.2, 0.8])
    """
    return _normed(posterior * prior / share)


def next_belief(
    last: SequenceBelief,
    posterior: FloatArray | None,
    chain: FloatArray,
    log_likelihoods: FloatArray | float = 0.0,
) -> SequenceBelief:
    """Return the belief one step on; without sound (None) the sequence is carried on by its chain.

    Shapes: chain (groups, groups), or with a leading axis of the sides.

    Examples
    --------
    >>> q = np.array([[0.3, 0.7]])
    >>> chain = np.array([[0.9, 0.1], [0.2, 0.8]])
    >>> next_belief(SequenceBelief(q, q), np.array([[0.6, 0.4]]), chain).belief
    array([[0.6, 0.4]])
    """
    predicted, carried = ((row[:, None] @ chain)[:, 0] for row in (last.belief, last.alone))
    alone = carried if posterior is None else posterior
    log_ratio = np.log(np.maximum(predicted, _SMALLEST)) - np.log(np.maximum(carried, _SMALLEST))
    # The largest exponent is taken off first: likelihoods of many nats would overflow.
    exponent = log_ratio + log_likelihoods
    weight = np.exp(exponent - exponent.max(axis=-1, keepdims=True))
    return SequenceBelief(_normed(alone * weight), alone)


def balanced(chain: FloatArray, share: FloatArray, rounds: int = 200) -> FloatArray:
    r"""Return the chain nearest to another one that leaves a distribution as it is.

    .. math:: \pi A = \pi

    Source: R. Sinkhorn, "A relationship between arbitrary positive matrices and doubly stochastic matrices",
    Ann. Math. Statist. 35, 1964: flows are scaled by rows and columns in turn.

    Examples
    --------
    >>> share = np.array([0.1, 0.9])
    >>> chain = balanced(np.array([[0.5, 0.5], [0.5, 0.5]]), share)
    >>> np.allclose(share @ chain, share), np.allclose(chain.sum(axis=1), 1.0)
    (True, True)
    """
    flows = share[:, None] * np.maximum(chain, _SMALLEST)
    for _ in range(rounds):
        flows *= (share / flows.sum(axis=0))[None, :]
        flows *= (share / flows.sum(axis=1))[:, None]
    return np.asarray(flows / flows.sum(axis=1, keepdims=True))


def _normed(values: FloatArray) -> FloatArray:
    return np.asarray(values / values.sum(axis=-1, keepdims=True))


# At any rate above .01/s a chain is in equilibrium by then; a larger exponent of expm only costs digits.
LONGEST_STEP_S = 1000.0


def transitions(rates_hz: FloatArray, step_ns: int) -> FloatArray:
    r"""Return exp(Q dt), read-only, rows sum to one; shapes (states, states).

    Examples
    --------
    >>> transitions(np.array([[-0.1, 0.1], [0.0, 0.0]]), 10**10).round(3)
    array([[0.368, 0.632],
           [0.   , 1.   ]])
    """
    # Imported where it is needed: scipy.linalg takes as long to import as numpy.
    from scipy.linalg import expm

    step_s = min(step_ns / NANOSECONDS_PER_SECOND, LONGEST_STEP_S)
    matrix: FloatArray = np.maximum(expm(rates_hz * step_s), 0.0)
    matrix /= matrix.sum(axis=1, keepdims=True)
    matrix.flags.writeable = False
    return matrix
