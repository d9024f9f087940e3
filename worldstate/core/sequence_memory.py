"""Belief of the vehicles that come into view: the sequence's reading with looks, hand-overs and traffic."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from worldstate.abduction.co_evidence import MOSTLY_MISSED, Unqueried
from worldstate.abduction.sequence.ratio_recursion import SequenceBelief, at_prior, next_belief
from worldstate.abduction.sequence.sequence_chain import (
    BEHIND,
    COMES,
    FOLLOWS,
    FOLLOWS_S,
    IN_VIEW,
    SEEN,
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
from worldstate.belief.side_belief import TIE, SideBelief
from worldstate.ground import BoolArray, FloatArray, InvalidArgumentError, finite_array, nanoseconds, seconds
from worldstate.ground.serialisation import Probability
from worldstate.measurement.measurement import Look, Measurement
from worldstate.state import Budget, Context

from .budget_watch import BET_S, BudgetWatch, WatchedHop, budget_of

# As sure of the usual rate as two arrivals would make it: streets differ by a factor of three either way.
_SHAPE = 2.0
_FORGOTTEN_S = 3600.0  # Traffic changes with the hour
# A prior slides the alarm: by +2 nats from 15 to 58 onsets an hour, by -1 to a detection of .73 for .94.
_MOST_NATS = 0.5
_STEP_NATS = 0.1  # The chain is computed anew for every prior: a few are enough
# In dense traffic one in six has another one right behind; as sure of that as six arrivals would make it.
_FOLLOWED, _FOLLOWED_SHAPE = 1.0 / 6.0, 6.0
# So long after one the reading knows by itself that vehicles come here: moved by the street's traffic as well
# it has .19 on the other side where .13 is true, seconds after a vehicle (ten streams of exam seeds 1 and 6).
_EMERGED_NS = 5_000_000_000
# Meanwhile what it leaves behind is heard as another one: a risk of .35 and more, of .47 in the mean, holds
# in .18 of the hops from 1.5 to 4.5 s after a pass. The alarm stands higher by so much until then.
_BESIDE_ONE_NATS = 1.2


@dataclass(frozen=True, slots=True)
class ArrivalRate:
    r"""Arrivals from one side, and the time in which they would have been seen: Gamma prior, Poisson count.

    .. math:: \lambda \mid n, T \sim \Gamma\Big(a + n,\ \frac{a}{\lambda_0} + T\Big), \qquad
              \log \frac{E \lambda}{\lambda_0} = \log \frac{a + n}{a + \lambda_0 T}

    with n arrivals in a time T of watching, both forgotten slowly, and the usual rate :math:`\lambda_0`. Of
    the arrivals f came right behind another one:

    .. math:: P(\text{another one follows}) = \frac{1 + f}{6 + n}
    """

    count: float = 0.0
    watched_s: float = 0.0
    followed: float = 0.0

    def later(self, step_s: float, watched: bool) -> "ArrivalRate":
        """Return the rate after a time, watched or not."""
        if not watched:
            return self
        kept = math.exp(-step_s / _FORGOTTEN_S)
        return ArrivalRate(self.count * kept, self.watched_s * kept + step_s, self.followed * kept)

    def after(self, since_last_ns: float) -> "ArrivalRate":
        """Return the rate after one more arrival, so long after the last one."""
        is_follower = since_last_ns <= nanoseconds(FOLLOWS_S)
        return replace(self, count=self.count + 1.0, followed=self.followed + is_follower)

    @property
    def follower_share(self) -> float:
        """P(another one comes right behind one), in hundredths."""
        # What is forgotten depends in its last digits on how a time is divided into steps.
        return round((_FOLLOWED * _FOLLOWED_SHAPE + self.followed) / (_FOLLOWED_SHAPE + self.count), 2)

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
HOP_NS, _SMOOTHED_NS, _HELD_NS, SLACK_NS = 100_000_000, 300_000_000, 1_000_000_000, 5_000_000
_WAY_NS = 10_000_000_000  # Longer than any vehicle that is expected takes
_UNDECIDED = (-math.log(1e9),) * len(SIDES)
# A look says what is in view then, not what will be: multiplied into the belief hop by hop, looks at one
# vehicle outweigh the next one for seconds (Brier skill at 2 s .175 in place of .204 without looks).
_LOOK_NS = 500_000_000
# A window and the smoothing of the alarm: so long the sound of either side is that of the vehicle that has
# just come into view, and says nothing of the next one.
_MASKED_NS = 1_300_000_000
_BET_GROUPS = COMING_S.index(BET_S) + 1
_IN_VIEW_S = 6.0  # Two passages: before, it is the sound that tells whether it is still there
_OTHERS = 0.1  # Vehicles in view from no side that is listened to
_TWO = 0.5  # P(both) from which on the vehicles of two sides are two
_OTHER, _PAST = GROUPS.index("other"), GROUPS.index("past")
_FAR = [_PAST, GROUPS.index("rising"), GROUPS.index("falling")]
_SEEN_GROUP = GROUPS.index("seen")
# States of vehicles that come into view within three seconds.
_SOON = np.array([COMES[i] and COMING_S[i % len(COMING_S)] <= 3.0 for i in range(len(STATES))])
# What every state becomes when a vehicle comes into view, shape (states, states).
_ONE_IN_VIEW = np.eye(len(STATES))[
    [len(COMING_S) + i % len(COMING_S) if comes else SEEN for i, comes in enumerate(COMES)]
]
# What has come into view would have been there within so long.
_LATER = np.array(COMING_S) > 1.0
LEAST_RISK = 0.1  # An advisory does not stand beside a risk that denies it
_LEAST_WEIGHT = 1e-12  # Keeps logarithms finite


# No slots: what is derived is computed once, and read by every entity and cue.
@dataclass(frozen=True, eq=False)
class SequenceMemory:
    """Belief of both sides, and the alarm that goes by it."""

    states: SequenceBelief  # Without the looks: each tells of its own time
    share: FloatArray  # shape (groups,): Prior that the model was trained at
    margin_s: float
    alarm: SequenceAlarm | None
    # Stamps of the last .3 s with the log-odds of coming into view within three seconds, left and right.
    recent: tuple[tuple[int, float, float], ...] = ()
    # What was last held against the threshold, nats, and when each side was last above it.
    decided: tuple[float, ...] = _UNDECIDED
    over_ns: tuple[int | None, ...] = (None,) * len(SIDES)
    looks: tuple[Look, ...] = ()  # The last one of each sensor, for as long as it holds
    # When a vehicle last came into view from a side.
    emerged_ns: tuple[int | None, ...] = (None,) * len(SIDES)
    # When what was heard on a side was last masked by a vehicle that came into view, there or elsewhere.
    masked_ns: tuple[int | None, ...] = (None,) * len(SIDES)
    # P(a vehicle has come into view from a side and no look has told), where no camera looks or none sees.
    unseen: tuple[Probability, ...] = (0.0,) * len(SIDES)
    # How often a vehicle has come into view past the edge of each side, while a camera looked.
    arrivals: tuple[ArrivalRate, ...] = (ArrivalRate(),) * len(SIDES)
    stamp_ns: int = 0
    watch: BudgetWatch = field(default_factory=BudgetWatch)  # Over the alarm's budget, and over the chances

    def check(self, directions: int) -> None:
        """Refuse what a file cannot have been written with, for so many approach sides."""
        groups, sides = (len(GROUPS),), (directions, len(STATES))
        for name, array, shape in (
            ("share", self.share, groups),
            ("belief", self.states.belief, sides),
            ("alone", self.states.alone, sides),
        ):
            finite_array(f"memory.sequence.{name}", array, shape)
            if (array < 0.0).any() or not np.allclose(array.sum(axis=-1), 1.0, atol=1e-3):
                raise InvalidArgumentError(f"memory.sequence.{name}: expected probabilities")
        for name in ("decided", "over_ns", "emerged_ns", "masked_ns", "unseen", "arrivals"):
            if (got := len(getattr(self, name))) != len(SIDES):
                raise InvalidArgumentError(f"memory.sequence.{name}: expected {len(SIDES)}, got {got}")
        self.watch.check(len(SIDES))

    @property
    def threshold_nats(self) -> float:
        """What the alarm is raised from: higher where a vehicle has just come; infinite without an alarm."""
        if self.alarm is None:
            return math.inf
        return self.alarm.threshold_nats + _BESIDE_ONE_NATS * self.just_emerged()

    def budget(self, stamp_ns: int) -> Budget | None:
        """Return how the watch over the alarm stands; None without one."""
        alarm = self.alarm
        return None if alarm is None else budget_of(self.watch, stamp_ns, alarm.onsets_per_hour)

    @cached_property
    def weighed(self) -> FloatArray:
        """Probabilities of the states of both sides, looks included, shape (2, states)."""
        told = sum(self._told.values(), np.zeros(len(STATES)))
        weighed = self.states.belief * np.exp(told - told.max())
        return np.asarray(weighed / weighed.sum(axis=1, keepdims=True))

    @property
    def in_view(self) -> float:
        """P(a vehicle is in view, or has left it into a side), by what is heard."""
        there = self.weighed[:, IN_VIEW].sum(axis=1) + self.posterior.groups[0, :, _PAST]
        return min(float(there.max()), 1.0)

    @cached_property
    def posterior(self) -> SequencePosterior:
        """The belief, as one hop of a stream."""
        return SequencePosterior(groups_of(self.weighed)[None], self.margin_s)

    @cached_property
    def _told(self) -> dict[str, FloatArray]:
        """Log-likelihoods of the looks, the oldest first, each (states,)."""
        return {f"look {look.sensor}": look_log_likelihoods(look.answer) for look in self.looks}

    @property
    def coming(self) -> FloatArray:
        """Probabilities of the groups of `COMING_S`, shape (2, 9)."""
        return self.posterior.groups[0, :, : len(COMING_S)]

    @cached_property
    def own_coming(self) -> FloatArray:
        r"""Probabilities of the groups of `COMING_S` of the vehicle believed there, shape (2, 9).

        .. math:: p'_{k,i} = (1 - u_k)\, p_{k,i} \quad \text{of times beyond a second}

        with the chance u that it has come into view unseen: what comes later is another one then.
        """
        return np.where(_LATER, self.coming * (1.0 - np.array(self.unseen))[:, None], self.coming)

    @cached_property
    def comes(self) -> FloatArray:
        """P(a vehicle comes into view within eight seconds), shape (2,)."""
        return np.asarray(np.minimum(self.coming.sum(axis=1), 1.0))

    @cached_property
    def none_comes(self) -> float:
        r"""P(no vehicle comes into view on either side).

        The reading of a side tells how likely only the other one is that of a vehicle, so that each gives

        .. math:: P(\bar C_k, \bar C_j) = 1 - P(C_k) - P(C_j, \bar C_k), \qquad
                  P(C_j, \bar C_k) = q_k(other) + P(C_j, V)\, P(\bar C_k \mid V)

        with V one in view, of which that reading does not tell; their mean, within what the two allow.
        """
        groups, comes = self.posterior.groups[0], self.comes
        in_view = self.weighed[:, BEHIND].sum(axis=1)
        seen = groups[:, _SEEN_GROUP]
        beside = in_view[::-1] * seen / np.maximum(seen + in_view, _LEAST_WEIGHT)
        none = float((1.0 - comes - groups[:, _OTHER] - beside).mean())
        return min(max(none, 1.0 - float(comes.sum()), 0.0), 1.0 - float(comes.max()))

    @property
    def both_come(self) -> float:
        """P(vehicles come into view on both sides)."""
        return max(float(self.comes.sum()) - (1.0 - self.none_comes), 0.0)

    @cached_property
    def sides(self) -> SideBelief:
        """What the states say of the sides and of the explanations.

        Hidden is a vehicle that comes into view, or one that is heard and not in view. What sounds in view,
        or as if it had left the view into the other side, is one that may have come into view unseen, or a
        vehicle of which nothing is known. As few as explain it: one that may have come from either side is
        one, of the likelier side, and two only as far as both chances exceed one; so is a far one.
        """
        groups, comes, none = self.posterior.groups[0], self.comes, self.none_comes
        unseen = _as_few(np.array(self.unseen))
        there = groups[:, _SEEN_GROUP] + groups[::-1, _PAST]
        # P(this one | a vehicle is there), each of them with a chance of its own.
        present = 1.0 - (1.0 - unseen).prod() * (1.0 - _OTHERS)
        emerged = np.minimum(there * unseen / present, 1.0 - comes)
        # Given that none comes, here or only there.
        rest = np.maximum(1.0 - comes - groups[:, _OTHER], _LEAST_WEIGHT)
        far = min(float((groups[:, _FAR].sum(axis=1) / rest).max()), 1.0)
        seen = min(float((groups[:, _SEEN_GROUP] / rest).mean()), 1.0 - far)
        hypotheses = (1.0 - none * (1.0 - far), none * seen, none * (1.0 - far - seen))
        told = tuple(comes.tolist())
        chances = told, tuple(emerged.tolist()), told, 1.0 - none, hypotheses
        return SideBelief(*chances, self.both_come)

    def since_emerged_ns(self, stamp_ns: int) -> list[float]:
        """Return how long before a time a vehicle last came into view from each side."""
        return [math.inf if ns is None else stamp_ns - ns for ns in self.emerged_ns]

    def just_emerged(self, but: int | None = None) -> bool:
        """Tell whether a vehicle has just come into view, from any side but one."""
        since_ns = self.since_emerged_ns(self.stamp_ns)
        return min(ns for k, ns in enumerate(since_ns) if k != but) <= _EMERGED_NS

    def handed_over(
        self, kept: Mapping[int, float], apart: Collection[int], stamp_ns: int
    ) -> "SequenceMemory":
        r"""Return the memory after vehicles came into view past the edge of some sides.

        .. math:: p_k \leftarrow (1 - r)\, \big(f\, g + (1 - f)\, e_{seen}\big) + r\, p_k, \qquad
                  P(C_j) \leftarrow r\, P(C_j) + (1 - r)\, \min\big(P(C_j),\ P(C_j \mid C_k)\big)

        with the chance r, in `kept`, that it was another vehicle than the one believed there, the share f of
        vehicles that another one follows, and the gaps g of these. One vehicle of unknown side was believed
        on both sides; vehicles of sides that are `apart`, or that were likelier two than one, stay. From now
        on one is in view of either side, which looks would else count against the second, and masks it.
        """
        belief, alone = self.states.belief @ _ONE_IN_VIEW, self.states.alone @ _ONE_IN_VIEW
        unseen, comes, both = np.array(self.unseen), self.comes, self.both_come
        for k, residual in kept.items():
            j = 1 - k
            if j not in kept and j not in apart and both <= _TWO:
                given = both / max(comes[k], _LEAST_WEIGHT)
                less = residual + (1.0 - residual) * min(given / max(comes[j], _LEAST_WEIGHT), 1.0)
                moved = belief[j, COMES].sum() * (1.0 - less)
                belief[j, COMES] *= less
                belief[j, SEEN] += moved
                unseen[j] *= less
            share = self.arrivals[k].follower_share
            now = share * FOLLOWS
            now[SEEN] += 1.0 - share
            belief[k] = (1.0 - residual) * now + residual * belief[k]
            # The sound of before told of the vehicle that is in view now.
            alone[k], unseen[k] = belief[k], 0.0
        pairs = zip(self.arrivals, self.since_emerged_ns(stamp_ns), strict=True)
        return replace(
            self,
            states=SequenceBelief(belief, alone),
            emerged_ns=tuple(stamp_ns if k in kept else ns for k, ns in enumerate(self.emerged_ns)),
            masked_ns=(stamp_ns,) * len(SIDES),
            over_ns=tuple(None if k in kept else ns for k, ns in enumerate(self.over_ns)),
            decided=tuple(_UNDECIDED[k] if k in kept else one for k, one in enumerate(self.decided)),
            unseen=tuple(unseen.tolist()),
            arrivals=tuple(
                rate.after(gap_ns) if k in kept else rate for k, (rate, gap_ns) in enumerate(pairs)
            ),
        )

    def prior(self, context: Context, nats: Sequence[float]) -> FloatArray:
        """Return the distribution of the groups expected of each side, moved so far; shape (2, groups)."""
        hidden = None if context.priors is None else context.priors.hidden / len(SIDES)
        return np.array([context_prior(self.share, hidden, one) for one in nats])

    def learned_nats(self, context: Context) -> list[float]:
        """Return by how much the log-odds of each side are moved by what was seen; a given prior stands."""
        usual_hz = float(self.share[: len(COMING_S)].sum() / self.share.sum()) / COMING_S[-1]
        return [0.0 if context.priors else one.shift_nats(usual_hz) for one in self.arrivals]

    def read_nats(self, context: Context) -> list[float]:
        """Return by how much a reading is moved: not at all where it has just heard a vehicle itself."""
        return [0.0] * len(SIDES) if self.just_emerged() else self.learned_nats(context)

    def has_news(self, stamp_ns: int) -> bool:
        """Tell whether anything was measured for as long as an alarm holds."""
        return bool(self.recent) and stamp_ns <= self.recent[-1][0] + _HELD_NS + SLACK_NS

    def decided_at(self, stamp_ns: int) -> tuple[float, ...]:
        """Return what is held against the threshold, nothing without news."""
        return self.decided if self.has_news(stamp_ns) else _UNDECIDED

    def not_held(self, sides: Collection[int]) -> "SequenceMemory":
        """Return the memory without the alarms of some sides that are only held."""
        least, pairs = self.threshold_nats, enumerate(zip(self.over_ns, self.decided, strict=True))
        return replace(
            self, over_ns=tuple(None if k in sides and one < least else ns for k, (ns, one) in pairs)
        )

    def alarm_ends_ns(self, stamp_ns: int) -> tuple[int | None, ...]:
        """Return for each side when its alarm ends: a second after it was last above the threshold."""
        ends_ns = (None if over_ns is None else over_ns + _HELD_NS + SLACK_NS for over_ns in self.over_ns)
        return tuple(None if end_ns is None or end_ns < stamp_ns else end_ns for end_ns in ends_ns)

    def log_odds(self, context: Context) -> dict[str, FloatArray]:
        """Return the log-odds of coming into view within three seconds after each piece of evidence.

        The last piece takes the learned traffic out again: the alarm keeps to its onsets an hour of a usual
        street. Left in, in busy streets the other side of a single was alarmed in .56 of the cases for .35.
        """
        nats = np.array(self.read_nats(context))
        pieces = {name: np.stack([told] * len(SIDES)) for name, told in self._told.items()}
        if nats.any():
            pieces |= {"usual traffic": -nats[:, None] * COMES}
        told = np.cumsum([np.zeros_like(self.states.belief), *pieces.values()], axis=0)
        # States and groups count alike: a vehicle that comes soon behind another comes soon.
        before = states_of(self.prior(context, self.learned_nats(context)), self.share)
        # Looks that miss nothing would leave no weight above what keeps logarithms finite.
        after = self.states.belief * np.exp(told - told.max(axis=-1, keepdims=True))
        weights = np.concatenate([before[None], after / after.sum(axis=-1, keepdims=True)])
        soon, later = (np.maximum(weights @ mask, _LEAST_WEIGHT) for mask in (_SOON, ~_SOON))
        return dict(zip(("prior", "sequence", *pieces), np.log(soon) - np.log(later), strict=True))


def _as_few(chances: FloatArray) -> FloatArray:
    """Return the chances with as much as one vehicle allows on the likelier side; a tie stays a tie."""
    # Rounding must not choose a side.
    total, first = float(chances.sum()), chances >= chances.max() * (1.0 - TIE)
    one = min(total, 1.0)
    return np.where(first, one, total - one) if first.sum() == 1 else chances


def carried(kept: SequenceMemory, stamp_ns: int, step_ns: int, context: Context) -> SequenceMemory:
    """Return the belief at a later time, with nothing heard.

    When a vehicle may have come into view unseen is told by the way there: its last ten seconds are gone hop
    by hop, so that one long step leads where many short ones do.
    """
    since_ns = stamp_ns - step_ns
    first_ns = max(stamp_ns - _WAY_NS, since_ns + HOP_NS)
    for end_ns in (*range(first_ns, stamp_ns - SLACK_NS, HOP_NS), stamp_ns):
        kept, since_ns = _one_step(kept, end_ns, end_ns - since_ns, context), end_ns
    return kept


def _one_step(kept: SequenceMemory, stamp_ns: int, step_ns: int, context: Context) -> SequenceMemory:
    """Return the belief one step of the chain later."""
    nats = kept.learned_nats(context)
    chain = np.array([state_transition(one, step_ns) for one in kept.prior(context, nats)])
    looks = tuple(look for look in kept.looks if stamp_ns - look.stamp_ns <= _LOOK_NS)
    states, unseen = next_belief(kept.states, None, chain), _unseen(kept, step_ns)
    watched = any(not isinstance(look.answer, Unqueried) and look.answer.miss_rate < 1.0 for look in looks)
    arrivals = tuple(rate.later(seconds(step_ns), watched) for rate in kept.arrivals)
    return replace(kept, states=states, looks=looks, unseen=unseen, arrivals=arrivals, stamp_ns=stamp_ns)


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
            first = states_of(reading.groups, reading.share)
            kept = SequenceMemory(
                SequenceBelief(first, first), reading.share, reading.margin_s, reading.alarm
            )
        kept = replace(kept, share=reading.share, margin_s=reading.margin_s, alarm=reading.alarm)
        expected = kept.prior(context, kept.read_nats(context))
        said = states_of(at_prior(reading.groups, reading.share, expected), reading.share)
        # Masked by whatever else is heard, or by a vehicle that has just come into view on that side.
        said = _as_heard(kept.states.alone, said, measurement.heard.share)
        masked = [ns is not None and kept.stamp_ns - ns <= _MASKED_NS for ns in kept.masked_ns]
        said = np.where(np.array(masked)[:, None], kept.states.alone, said)
    if kept is None:
        return None
    # The chain of the hops since then was taken when the belief was carried here.
    states = next_belief(kept.states, said, np.eye(len(STATES)))
    # A vehicle that has come into view is seen there but for a miss; one that is seen was handed over. What
    # makes a camera miss most of them, dirt or darkness, makes it miss the same one again: ten such looks a
    # second, each counted anew, would deny within a second what is heard.
    rates = (look.answer.miss_rate for look in looks if not isinstance(look.answer, Unqueried))
    missed = math.prod(rate for rate in rates if rate <= MOSTLY_MISSED)
    held = {look.sensor: look for look in (*kept.looks, *looks)}
    kept = replace(
        kept,
        states=states,
        looks=tuple(sorted(held.values(), key=_by_content)),
        unseen=tuple(chance * missed for chance in kept.unseen),
        stamp_ns=measurement.stamp_ns,
    )
    return alerted(kept, context)


def _by_content(look: Look) -> tuple[int, str, str]:
    """Return what looks are in order of: each weighs given those before it, and names carry no meaning."""
    return look.stamp_ns, str(look.answer), look.sensor


def _as_heard(alone: FloatArray, said: FloatArray, share: float) -> FloatArray:
    r"""Return a reading in which a hidden vehicle is noticed with a probability s, shapes (2, states).

    .. math:: g_i = q_i / n_i, \qquad g'_i = s\, g_i + (1 - s)\, \bar g \quad \text{of states that come},
              \qquad q' \propto n\, g'

    with n what the reading was expected to be and the mean :math:`\bar g` of the states in which none comes:
    one that is masked sounds as if it were not there, so that its absence counts by s only.
    """
    if share >= 1.0:
        return said
    rest = said[:, ~COMES].sum(axis=1) / np.maximum(alone[:, ~COMES].sum(axis=1), _LEAST_WEIGHT)
    missed = share * said + (1.0 - share) * rest[:, None] * alone
    heard = np.where(COMES, missed, said)
    return np.asarray(heard / heard.sum(axis=1, keepdims=True))


def _watched(kept: SequenceMemory, over: BoolArray) -> WatchedHop:
    """Return what a hop says to the watch over the alarm; `over` its own threshold, by side."""
    answers = [look.answer for look in kept.looks if not isinstance(look.answer, Unqueried)]
    looked = any(one.miss_rate <= MOSTLY_MISSED for one in answers)
    within = kept.coming[:, :_BET_GROUPS].sum(axis=1).tolist()
    return WatchedHop(kept.stamp_ns, looked, tuple(over.tolist()), kept.emerged_ns, tuple(within))


def alerted(kept: SequenceMemory, context: Context) -> SequenceMemory:
    """Return the memory with what decides held against the alarm's threshold.

    The mean log-odds of coming into view within three seconds over the last .3 s, or since a vehicle came
    into view from that side, and of the less likely side no more than that two come.
    """
    left, right = list(kept.log_odds(context).values())[-1].tolist()
    since_ns = kept.stamp_ns - _SMOOTHED_NS + SLACK_NS
    recent = (*(one for one in kept.recent if one[0] > since_ns), (kept.stamp_ns, left, right))
    # Of each hop the last one: however many measurements there are, time counts.
    of_hop = {(kept.stamp_ns - one[0] + SLACK_NS) // HOP_NS: one for one in recent}.values()
    rows = [
        [one[1 + k] for one in of_hop if ns is None or one[0] >= ns] for k, ns in enumerate(kept.emerged_ns)
    ]
    decided, over_ns, alarm = np.array([float(np.mean(row)) for row in rows]), kept.over_ns, kept.alarm
    watch = kept.watch
    if alarm is not None:
        alarm = replace(alarm, threshold_nats=kept.threshold_nats)
        read_nats = np.array(kept.read_nats(context))
        decided = alarm.deciding(decided, kept.posterior.groups[0], read_nats)
        over, denied = decided >= alarm.threshold_nats, np.array(kept.sides.risks) < LEAST_RISK
        watch = watch.after(_watched(kept, over & ~denied), alarm.onsets_per_hour)
        # A risk that denies an alarm ends it: it is not held, and time alone does not bring it back.
        sides = zip(over, denied, over_ns, strict=True)
        over_ns = tuple(None if no else kept.stamp_ns if yes else ns for yes, no, ns in sides)
        decided = np.where(over & denied, _UNDECIDED, decided)
    after = replace(kept, recent=recent, decided=tuple(decided.tolist()), over_ns=over_ns, watch=watch)
    # The belief is the same: what was derived of it, half of the time of a step, is not derived again.
    vars(after).update(vars(kept) | vars(after))
    return after
