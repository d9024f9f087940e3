r"""How the groups of a sequence model follow one another where nothing is heard, and what looks say of them.

Whoever comes counts down through the groups into view, .004 of the hops begin anew anywhere, and the whole is
balanced, so that it leaves the context's distribution c as it is. As a chain in continuous time,

.. math:: A(\Delta t) = \exp(Q\, \Delta t), \qquad c\, Q = 0,

two short steps are one long one. With sound the chain only says how fast everything else is forgotten.
"""

import math
from functools import lru_cache

import numpy as np

from worldstate.abduction.co_evidence import CoEvidence
from worldstate.abduction.sequence.sequence_model import COMING_S, GROUPS
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import NANOSECONDS_PER_SECOND

from .markov_chain import LONGEST_STEP_S
from .ratio_recursion import balanced

HOP_S = 0.1
# Looks closer in time repeat each other's misses; a vehicle stays in view for some seconds.
LOOK_INTERVAL_S = 1.0
_LEAK = 0.004  # Of the hops: what the sequence of groups does not foresee
# A wrong prior on both sides slides the alarm: by +2 nats from 15 to 58 onsets an hour, by -1 to a detection
# of .73 in place of .94.
_LEAST_SHIFT, _LARGEST_SHIFT = -0.5, 2.0
_SMALLEST = 1e-12
_ROUNDS = 1000  # After 200 the prior still drifts by a percent, after these by 1e-9

_COMING = len(COMING_S)
# Mean seconds in a group before another one follows: passages, and births of .004 a hop.
_FOLLOWS_S = {
    ("seen", "past"): 3.0,
    ("other", "seen"): 3.0,
    ("past", "none"): 4.0,
    ("rising", "falling"): 4.0,
    ("falling", "none"): 4.0,
    ("none", GROUPS[_COMING - 1]): 25.0,
    ("none", "rising"): 25.0,
    ("none", "other"): 25.0,
    ("rising", GROUPS[_COMING - 1]): 25.0,
}


def context_prior(share: FloatArray, hidden: float | None) -> FloatArray:
    """Return the distribution of one side's groups in a context that expects a hidden vehicle on it.

    Without one it is the model's share; the shift of the log-odds is bounded.

    Examples
    --------
    >>> share = np.full(len(GROUPS), 1.0 / len(GROUPS))
    >>> round(float(context_prior(share, 0.99)[:9].sum()), 3)
    0.917
    """
    coming = float(share[:_COMING].sum() / share.sum())
    if hidden is None:
        return np.asarray(share / share.sum())
    # Certainty of a prior has no end, the shift has.
    expected = min(max(hidden, 1e-9), 1.0 - 1e-9)
    shift = math.log(expected / (1.0 - expected)) - math.log(coming / (1.0 - coming))
    factor = math.exp(min(max(shift, _LEAST_SHIFT), _LARGEST_SHIFT))
    moved = np.concatenate([share[:_COMING] * factor, share[_COMING:]])
    return np.asarray(moved / moved.sum())


def group_transition(prior: FloatArray, step_ns: int) -> FloatArray:
    """Return the chain of some nanoseconds, shape (groups, groups), which leaves a prior as it is.

    Examples
    --------
    >>> prior = np.full(len(GROUPS), 1.0 / len(GROUPS))
    >>> np.allclose(prior @ group_transition(prior, 10**9), prior)
    True
    """
    return _transition(tuple(prior.tolist()), step_ns)


@lru_cache(maxsize=64)
def _transition(prior: tuple[float, ...], step_ns: int) -> FloatArray:
    # Imported where it is needed: scipy.linalg takes as long to import as numpy.
    from scipy.linalg import expm

    step_s = min(step_ns / NANOSECONDS_PER_SECOND, LONGEST_STEP_S)
    matrix: FloatArray = np.maximum(expm(_rates_hz(prior) * step_s), 0.0)
    matrix /= matrix.sum(axis=1, keepdims=True)
    matrix.flags.writeable = False
    return matrix


@lru_cache(maxsize=8)
def _rates_hz(prior: tuple[float, ...]) -> FloatArray:
    """Return Q, 1/s, from the chain of one hop that is nearest to the countdown."""
    hop = np.eye(len(GROUPS))
    towards_view = (GROUPS.index("seen"), *range(_COMING - 1))
    arrows = dict(zip(enumerate(towards_view), np.diff((0.0, *COMING_S)), strict=True))
    arrows |= {(GROUPS.index(one), GROUPS.index(to)): mean_s for (one, to), mean_s in _FOLLOWS_S.items()}
    for (one, to), mean_s in arrows.items():
        hop[one, [one, to]] += [-HOP_S / mean_s, HOP_S / mean_s]
    loose = (1.0 - _LEAK) * hop + _LEAK * np.array(prior)
    still = balanced(loose, np.array(prior), _ROUNDS)
    return np.asarray((still - np.eye(len(GROUPS))) / HOP_S)


def look_log_likelihoods(answer: CoEvidence, prior: FloatArray) -> FloatArray:
    r"""Return log p(look | group), shape (groups,), nats.

    .. math:: p(V \mid g) = v_g\, p(V \mid visible) + (1 - v_g)\, p(V \mid none)

    with v the share of a group's time in which somebody is in view: all of "seen"; of those who come, who are
    told even while another one is in view, as much as of the rest; none elsewhere.

    Examples
    --------
    >>> from worldstate.abduction.co_evidence import Absent
    >>> prior = np.full(len(GROUPS), 1.0 / len(GROUPS))
    >>> told = look_log_likelihoods(Absent(miss_rate=0.04, clutter_rate=0.01), prior)
    >>> told[GROUPS.index("seen")].round(2), told[GROUPS.index("none")].round(2)
    (np.float64(-3.23), np.float64(-0.01))
    """
    seen = GROUPS.index("seen")
    in_view = np.zeros(len(GROUPS))
    in_view[:_COMING], in_view[seen] = prior[seen] / prior[_COMING:].sum(), 1.0
    _, visible, none = np.exp(answer.log_likelihoods())
    return np.asarray(np.log(np.maximum(in_view * visible + (1.0 - in_view) * none, _SMALLEST)))
