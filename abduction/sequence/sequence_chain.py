r"""How the groups of a sequence model follow one another where nothing is heard, and what looks say of them.

A vehicle that comes counts down through the groups into view, behind another or not; .004 of the hops begin
anew anywhere, and the whole is balanced, so that it leaves the context's distribution c as it is. As a
chain in continuous time,

.. math:: A(\Delta t) = \exp(Q\, \Delta t), \qquad c\, Q = 0,

two short steps are one long one. With sound the chain only says how fast everything else is forgotten.
"""

import math
from functools import lru_cache

import numpy as np

from worldstate.abduction.co_evidence import CoEvidence
from worldstate.ground.typing import FloatArray

from .ratio_recursion import balanced, transitions
from .sequence_inputs import HOP_S
from .sequence_model import COMING_S, GROUPS

_LEAK = 0.004  # Of the hops: what the sequence of groups does not foresee
# A wrong prior on both sides slides the alarm: by +2 nats from 15 to 58 onsets an hour, by -1 to a detection
# of .73 in place of .94.
_LEAST_SHIFT, _LARGEST_SHIFT = -0.5, 2.0
_SMALLEST = 1e-12
_ROUNDS = 1000  # After 200 the prior still drifts by a percent, after these by 1e-9

_COMING = len(COMING_S)
# A vehicle comes with none in view or behind another: of the sequence's groups each coming one is two states
# here. Taken as one, every second of an empty view would count against a vehicle that comes.
STATES = (*GROUPS[:_COMING], *(f"{group}_behind" for group in GROUPS[:_COMING]), *GROUPS[_COMING:])
SEEN = STATES.index("seen")
COMES = np.array([state.startswith("coming") for state in STATES])
BEHIND = np.array([state.endswith("_behind") for state in STATES])
IN_VIEW = BEHIND | (np.arange(len(STATES)) == SEEN)
# States of a vehicle that follows one just come into view: gaps of up to six seconds, alike.
FOLLOWS_S = 6.0
_GAPS = np.diff(np.minimum((0.0, *COMING_S), FOLLOWS_S)) / FOLLOWS_S
FOLLOWS = np.concatenate([np.zeros(_COMING), _GAPS, np.zeros(len(STATES) - 2 * _COMING)])
# Mean seconds in a state before another one follows: passages, and births of .004 a hop.
_PASSED_S = 3.0
_FOLLOWED_BY_S = {
    ("seen", "past"): _PASSED_S,
    ("other", "seen"): 3.0,
    ("past", "none"): 4.0,
    ("rising", "falling"): 4.0,
    ("falling", "none"): 4.0,
    ("none", GROUPS[_COMING - 1]): 25.0,
    ("none", "rising"): 25.0,
    ("none", "other"): 25.0,
    ("rising", GROUPS[_COMING - 1]): 25.0,
    ("seen", f"{GROUPS[_COMING - 1]}_behind"): 25.0,
} | {(f"{group}_behind", group): _PASSED_S for group in GROUPS[:_COMING]}


def states_of(groups: FloatArray, prior: FloatArray) -> FloatArray:
    """Return the states of some groups' probabilities, shape (..., groups) to (..., states).

    A vehicle that comes has another ahead in view as often as the mean of what the prior and what the sound
    has of the street without it. By the prior alone what is heard is one or the other and a look decides,
    by the sound alone a look decides nothing: on streams the truth lies between.

    Examples
    --------
    >>> even = np.full(len(GROUPS), 1.0 / len(GROUPS))
    >>> states = states_of(even, even)
    >>> round(float(states[IN_VIEW].sum()), 3), np.allclose(groups_of(states), even)
    (0.167, True)
    """
    coming, rest = groups[..., :_COMING], groups[..., _COMING:]
    in_view = rest[..., :1] / np.maximum(rest.sum(axis=-1, keepdims=True), _SMALLEST)
    behind = 0.5 * prior[_COMING] / prior[_COMING:].sum() + 0.5 * in_view
    return np.concatenate([coming * (1.0 - behind), coming * behind, rest], axis=-1)


def groups_of(states: FloatArray) -> FloatArray:
    """Return the groups of some states' probabilities: the inverse of `states_of`."""
    coming = states[..., :_COMING] + states[..., _COMING : 2 * _COMING]
    return np.concatenate([coming, states[..., 2 * _COMING :]], axis=-1)


def context_prior(share: FloatArray, hidden: float | None, learned_nats: float = 0.0) -> FloatArray:
    """Return the distribution of one side's groups in a context that expects a hidden vehicle on it.

    Without one it is the model's share, moved by what was learned of the side; the shift is bounded.

    Examples
    --------
    >>> share = np.full(len(GROUPS), 1.0 / len(GROUPS))
    >>> round(float(context_prior(share, 0.99)[:9].sum()), 3)
    0.917
    """
    coming, shift = float(share[:_COMING].sum() / share.sum()), learned_nats
    if hidden is not None:
        # Certainty of a prior has no end, the shift has.
        expected = min(max(hidden, 1e-9), 1.0 - 1e-9)
        shift = math.log(expected / (1.0 - expected)) - math.log(coming / (1.0 - coming))
    factor = math.exp(min(max(shift, _LEAST_SHIFT), _LARGEST_SHIFT))
    moved = np.concatenate([share[:_COMING] * factor, share[_COMING:]])
    return np.asarray(moved / moved.sum())


def state_transition(prior: FloatArray, step_ns: int) -> FloatArray:
    """Return the chain of some nanoseconds, shape (states, states), which leaves a prior of the groups.

    Examples
    --------
    >>> prior = np.full(len(GROUPS), 1.0 / len(GROUPS))
    >>> np.allclose(states_of(prior, prior) @ state_transition(prior, 10**9), states_of(prior, prior))
    True
    """
    return _transition(tuple(prior.tolist()), step_ns)


@lru_cache(maxsize=256)
def _transition(prior: tuple[float, ...], step_ns: int) -> FloatArray:
    return transitions(_rates_hz(prior), step_ns)


@lru_cache(maxsize=32)
def _rates_hz(prior: tuple[float, ...]) -> FloatArray:
    """Return Q, 1/s, from the chain of one hop that is nearest to the countdown."""
    hop, share = np.eye(len(STATES)), states_of(np.array(prior), np.array(prior))
    spans_s = np.diff((0.0, *COMING_S))
    arrows = {(k, k - 1 if k else SEEN): span for k, span in enumerate(spans_s)}
    arrows |= {(_COMING + k, _COMING + k - 1 if k else SEEN): span for k, span in enumerate(spans_s)}
    arrows |= {(STATES.index(one), STATES.index(to)): mean_s for (one, to), mean_s in _FOLLOWED_BY_S.items()}
    for (one, to), mean_s in arrows.items():
        hop[one, [one, to]] += [-HOP_S / mean_s, HOP_S / mean_s]
    loose = (1.0 - _LEAK) * hop + _LEAK * share
    still = balanced(loose, share, _ROUNDS)
    return np.asarray((still - np.eye(len(STATES))) / HOP_S)


def look_log_likelihoods(answer: CoEvidence) -> FloatArray:
    """Return log p(look | state), shape (states,), nats: of a view with a vehicle in it, or with none.

    Examples
    --------
    >>> from worldstate.abduction.co_evidence import Absent
    >>> told = look_log_likelihoods(Absent(miss_rate=0.04, clutter_rate=0.01))
    >>> [told[STATES.index(name)].round(2).item() for name in ("seen", "coming_1s", "coming_1s_behind")]
    [-3.23, -0.01, -3.23]
    """
    _, visible, none = np.exp(answer.log_likelihoods())
    return np.asarray(np.log(np.maximum(np.where(IN_VIEW, visible, none), _SMALLEST)))
