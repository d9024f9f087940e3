"""Belief of the vehicles that come into view: the sequence's reading with looks, hand-overs and traffic."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import attrgetter

import numpy as np

from worldstate.abduction.co_evidence import Unqueried
from worldstate.abduction.sequence.ratio_recursion import SequenceBelief, at_prior, first_belief, next_belief
from worldstate.abduction.sequence.sequence_chain import (
    COMES,
    STATES,
    context_prior,
    groups_of,
    look_log_likelihoods,
    state_transition,
    states_of,
)
from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.abduction.sequence.sequence_model import COMING_S, GROUPS, SequenceAlarm, SequencePosterior
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.belief.explanation import HiddenBelief
from worldstate.ground import FloatArray, InvalidArgumentError, finite_array, seconds
from worldstate.ground.serialisation import ADDED, Probability
from worldstate.measurement.measurement import Look, Measurement
from worldstate.state import Context

# As sure of the usual rate as two arrivals would make it: streets differ by a factor of three either way.
_SHAPE = 2.0
_FORGOTTEN_S = 3600.0  # Traffic changes with the hour
# A prior slides the alarm: by +2 nats from 15 to 58 onsets an hour, by -1 to a detection of .73 for .94.
_MOST_NATS = 0.5
_STEP_NATS = 0.1  # The chain is computed anew for every prior: a few are enough


@dataclass(frozen=True, slots=True)
class ArrivalRate:
    r"""Arrivals from one side, and the time in which they would have been seen: Gamma prior, Poisson count.

    .. math:: \lambda \mid n, T \sim \Gamma\Big(a + n,\ \frac{a}{\lambda_0} + T\Big), \qquad
              \log \frac{E \lambda}{\lambda_0} = \log \frac{a + n}{a + \lambda_0 T}

    with n arrivals in a time T of watching, both forgotten slowly, and the usual rate :math:`\lambda_0`.
    """

    count: float = 0.0
    watched_s: float = 0.0

    def later(self, step_s: float, watched: bool) -> "ArrivalRate":
        """Return the rate after a time, watched or not."""
        kept = math.exp(-step_s / _FORGOTTEN_S) if watched else 1.0
        return ArrivalRate(self.count * kept, self.watched_s * kept + (step_s if watched else 0.0))

    def shift_nats(self, usual_hz: float) -> float:
        """Return by how much the log-odds of a vehicle coming differ from usual, in steps of .1 nats.

        Examples
        --------
        >>> quiet, busy = ArrivalRate(0.0, 600.0), ArrivalRate(6.0, 240.0)
        >>> quiet.shift_nats(0.01), busy.shift_nats(0.01), ArrivalRate().shift_nats(0.01)
        (-0.5, 0.5, 0.0)
        """
        nats = math.log((_SHAPE + self.count) / (_SHAPE + usual_hz * self.watched_s))
        return round(min(max(nats, -_MOST_NATS), _MOST_NATS) / _STEP_NATS) * _STEP_NATS


# In seconds what the alarm's threshold was set with in hops; less by the rounding of stamps.
_SMOOTHED_NS, _HELD_NS, _SLACK_NS = 300_000_000, 1_000_000_000, 5_000_000
# A look says what is in view then, not what will be: multiplied into the belief hop by hop, looks at one
# vehicle outweigh the next one for seconds (Brier skill at 2 s .175 in place of .204 without looks).
_LOOK_NS = 500_000_000
# A window and the smoothing of the alarm; then a follower counts like any other. In dense traffic one in six
# has another one right behind.
_EXPLAINED_NS, _FOLLOWED = 1_300_000_000, 0.2
_IN_VIEW_S = 6.0  # Two passages: before, it is the sound that tells whether it is still there
_OTHERS = 0.1  # Vehicles in view from no side that is listened to
_SEEN, _PAST = GROUPS.index("seen"), GROUPS.index("past")
# States of vehicles that come into view within three seconds.
_SOON = np.array([COMES[i] and COMING_S[i % len(COMING_S)] <= 3.0 for i in range(len(STATES))])
_LEAST_WEIGHT = 1e-12  # Keeps logarithms finite


# No slots: what is derived is computed once, and read by every entity and cue.
@dataclass(frozen=True, eq=False)
class SequenceMemory:
    """Belief of both sides, and the alarm that goes by it."""

    sides: SequenceBelief  # Without the looks: each tells of its own time
    share: FloatArray  # shape (groups,): Prior that the model was trained at
    margin_s: float
    alarm: SequenceAlarm | None
    # Stamps of the last .3 s with the log-odds of coming into view within three seconds, left and right.
    recent: tuple[tuple[int, float, float], ...] = ()
    over_ns: tuple[int | None, ...] = (None,) * len(SIDES)  # When each side was last above the threshold
    looks: tuple[Look, ...] = ()  # The last one of each sensor, for as long as it holds
    emerged_ns: tuple[int | None, ...] = (None,) * len(
        SIDES
    )  # When a vehicle last came into view from a side
    # P(a vehicle has come into view from a side and no look has told), where no camera looks or none sees.
    unseen: tuple[Probability, ...] = field(default=(0.0,) * len(SIDES), metadata=ADDED)
    # How often a vehicle has come into view past the edge of each side, while a camera looked.
    arrivals: tuple[ArrivalRate, ...] = field(default=(ArrivalRate(),) * len(SIDES), metadata=ADDED)
    stamp_ns: int = 0

    def check(self) -> None:
        """Refuse what a file cannot have been written with."""
        groups, sides = (len(GROUPS),), (len(SIDES), len(STATES))
        for name, array, shape in (
            ("share", self.share, groups),
            ("belief", self.sides.belief, sides),
            ("alone", self.sides.alone, sides),
        ):
            finite_array(f"memory.sequence.{name}", array, shape)
            if (array < 0.0).any() or not np.allclose(array.sum(axis=-1), 1.0, atol=1e-3):
                raise InvalidArgumentError(f"memory.sequence.{name}: expected probabilities")
        for name in ("over_ns", "emerged_ns", "unseen", "arrivals"):
            if (got := len(getattr(self, name))) != len(SIDES):
                raise InvalidArgumentError(f"memory.sequence.{name}: expected {len(SIDES)}, got {got}")

    @cached_property
    def posterior(self) -> SequencePosterior:
        """The belief, as one hop of a stream."""
        told = sum(self._told.values(), np.zeros(len(STATES)))
        weighed = self.sides.belief * np.exp(told - told.max())
        return SequencePosterior(groups_of(weighed / weighed.sum(axis=1, keepdims=True))[None], self.margin_s)

    @cached_property
    def _told(self) -> dict[str, FloatArray]:
        """Log-likelihoods of everything but the sound, in the order of their names, each (2, states)."""
        looks = ((f"look {look.sensor}", look_log_likelihoods(look.answer)) for look in self.looks)
        told = {name: np.stack([nats] * len(SIDES)) for name, nats in looks}
        return told | {"emerged": self._explained()[:, None] * COMES}

    @property
    def coming(self) -> FloatArray:
        """Probabilities of the groups of `COMING_S`, shape (2, 9)."""
        return self.posterior.groups[0, :, : len(COMING_S)]

    def emerged(self, sides: Collection[int], stamp_ns: int) -> "SequenceMemory":
        """Return the memory after a vehicle came into view past the edge of some sides."""
        known = (stamp_ns if side in sides else ns for side, ns in enumerate(self.emerged_ns))
        unseen = (0.0 if side in sides else chance for side, chance in enumerate(self.unseen))
        arrivals = tuple(
            replace(rate, count=rate.count + (side in sides)) for side, rate in enumerate(self.arrivals)
        )
        return replace(self, emerged_ns=tuple(known), unseen=tuple(unseen), arrivals=arrivals)

    def prior(self, context: Context) -> FloatArray:
        """Return the distribution of the groups that is expected of each side, shape (2, groups)."""
        hidden = None if context.priors is None else context.priors.hidden / len(SIDES)
        return np.array([context_prior(self.share, hidden, nats) for nats in self.learned_nats(context)])

    def learned_nats(self, context: Context) -> list[float]:
        """Return by how much the log-odds of each side are moved by what was seen; a given prior stands."""
        usual_hz = float(self.share[: len(COMING_S)].sum() / self.share.sum()) / COMING_S[-1]
        return [0.0 if context.priors else one.shift_nats(usual_hz) for one in self.arrivals]

    def _explained(self) -> FloatArray:
        """Return log p(sound | one comes) of each side, given a vehicle just come into view, shape (2,).

        The last seconds hold the sound of this vehicle while it was hidden; that another one follows it is
        rare. Onsets within six seconds of T0 fall from .17 to .08 an approach by this.
        """
        ages_ns = [np.inf if ns is None else self.stamp_ns - ns for ns in self.emerged_ns]
        return np.where(np.array(ages_ns) <= _EXPLAINED_NS, math.log(_FOLLOWED), 0.0)

    @cached_property
    def hidden(self) -> HiddenBelief:
        """A vehicle that comes into view within eight seconds is hidden; an unseen one is as it sounds.

        What sounds in view, or as if it had left the view into the other side, is one that may have come into
        view unseen, or a vehicle of which nothing is known. As few as explain it: one that may have come
        from either side is one, of the likelier side, and two only as far as both chances exceed one.
        """
        groups, unseen = self.posterior.groups[0], _as_few(np.array(self.unseen))
        coming = np.minimum(self.coming.sum(axis=1), 1.0)
        there = groups[:, _SEEN] + groups[::-1, _PAST]
        # P(this one | a vehicle is there), each of them with a chance of its own.
        present = 1.0 - (1.0 - unseen).prod() * (1.0 - _OTHERS)
        emerged = np.minimum(there * unseen / present, 1.0 - coming)
        return HiddenBelief(tuple(coming.tolist()), tuple(emerged.tolist()))

    def alarm_ends_ns(self, stamp_ns: int) -> tuple[int | None, ...]:
        """Return for each side when its alarm ends: a second after it was last above the threshold."""
        ends_ns = (None if over_ns is None else over_ns + _HELD_NS + _SLACK_NS for over_ns in self.over_ns)
        return tuple(None if end_ns is None or end_ns < stamp_ns else end_ns for end_ns in ends_ns)

    def log_odds_terms(self, context: Context) -> dict[str, list[float]]:
        r"""Return what each piece of evidence adds to the log-odds of coming into view within three seconds.

        .. math:: t_j = L_j - L_{j-1}

        with L of both sides after the prior, the sequence, every look, and a vehicle just come into view.
        """
        after = self.log_odds(context)
        terms = np.diff(list(after.values()), axis=0, prepend=np.zeros((1, len(SIDES))))
        return dict(zip(after, terms.tolist(), strict=True))

    def log_odds(self, context: Context) -> dict[str, FloatArray]:
        """Return the log-odds of coming into view within three seconds after each piece of evidence.

        The last piece takes the learned traffic out again: the alarm keeps to its onsets an hour of a usual
        street. Left in, in busy streets the other side of a single was alarmed in .56 of the cases for .35.
        """
        nats, pieces = np.array(self.learned_nats(context)), self._told
        if nats.any():
            pieces = pieces | {"usual traffic": -nats[:, None] * COMES}
        told = np.cumsum([np.zeros_like(self.sides.belief), *pieces.values()], axis=0)
        # States and groups count alike: a vehicle that comes soon behind another comes soon.
        before = states_of(self.prior(context), self.share)
        weights = np.concatenate([before[None], self.sides.belief * np.exp(told)])
        soon, later = (np.maximum(weights @ mask, _LEAST_WEIGHT) for mask in (_SOON, ~_SOON))
        return dict(zip(("prior", "sequence", *pieces), np.log(soon) - np.log(later), strict=True))

    @property
    def mean_log_odds(self) -> FloatArray:
        """Mean log-odds of coming into view within three seconds over the last .3 s, shape (2,)."""
        return np.asarray(np.mean([one[1:] for one in self.recent], axis=0))


def _as_few(chances: FloatArray) -> FloatArray:
    """Return the chances with as much as one vehicle allows on the likelier side; a tie stays a tie."""
    total, first = float(chances.sum()), chances == chances.max()
    one = min(total, 1.0)
    return np.where(first, one, total - one) if first.sum() == 1 else chances


def carried(kept: SequenceMemory, stamp_ns: int, step_ns: int, context: Context) -> SequenceMemory:
    """Return the belief at a later time, with nothing heard."""
    chain = np.array([state_transition(one, step_ns) for one in kept.prior(context)])
    looks = tuple(look for look in kept.looks if stamp_ns - look.stamp_ns <= _LOOK_NS)
    sides, unseen = next_belief(kept.sides, None, chain), _unseen(kept, step_ns)
    watched = any(not isinstance(look.answer, Unqueried) and look.answer.miss_rate < 1.0 for look in looks)
    arrivals = tuple(rate.later(seconds(step_ns), watched) for rate in kept.arrivals)
    return replace(kept, sides=sides, looks=looks, unseen=unseen, arrivals=arrivals, stamp_ns=stamp_ns)


def _unseen(kept: SequenceMemory, step_ns: int) -> tuple[float, ...]:
    r"""Return the chances that a vehicle has come into view unseen, after a step.

    .. math:: u \leftarrow \max(u\, e^{-dt / \tau},\ P(T \le .5))
    """
    soon = kept.posterior.within()[0, :, 0]
    left = np.array(kept.unseen) * math.exp(-seconds(step_ns) / _IN_VIEW_S)
    return tuple(np.maximum(left, soon).tolist())


def informed(
    kept: SequenceMemory | None, measurement: Measurement, looks: Sequence[Look], context: Context
) -> SequenceMemory | None:
    """Return the belief at a measurement after its reading and new looks; None before the first reading."""
    reading = measurement.sequence
    said = None
    if isinstance(reading, SequenceReading):
        if kept is None:
            first = first_belief(states_of(reading.groups, reading.share))
            kept = SequenceMemory(first, reading.share, reading.margin_s, reading.alarm)
        kept = replace(kept, share=reading.share, margin_s=reading.margin_s, alarm=reading.alarm)
        said = states_of(at_prior(reading.groups, reading.share, kept.prior(context)), reading.share)
    if kept is None:
        return None
    # The chain of the hops since then was taken when the belief was carried here.
    sides = next_belief(kept.sides, said, np.eye(len(STATES)))
    # A vehicle that has come into view is seen there but for a miss; one that is seen was handed over.
    missed = math.prod(look.answer.miss_rate for look in looks if not isinstance(look.answer, Unqueried))
    held = {look.sensor: look for look in (*kept.looks, *looks)}
    kept = replace(
        kept,
        sides=sides,
        looks=tuple(sorted(held.values(), key=attrgetter("sensor"))),
        unseen=tuple(chance * missed for chance in kept.unseen),
        stamp_ns=measurement.stamp_ns,
    )
    return _alerted(kept, context)


def _alerted(kept: SequenceMemory, context: Context) -> SequenceMemory:
    """Return the memory with the mean log-odds of the last .3 s held against the threshold."""
    left, right = list(kept.log_odds(context).values())[-1].tolist()
    since_ns = kept.stamp_ns - _SMOOTHED_NS + _SLACK_NS
    recent = (*(one for one in kept.recent if one[0] > since_ns), (kept.stamp_ns, left, right))
    kept = replace(kept, recent=recent)
    if kept.alarm is None:
        return kept
    learned_nats = np.array(kept.learned_nats(context))
    over = kept.alarm.over(kept.mean_log_odds, kept.posterior.groups[0], learned_nats)
    over_ns = tuple(kept.stamp_ns if now else ns for now, ns in zip(over, kept.over_ns, strict=True))
    return replace(kept, over_ns=over_ns)
