"""Belief of the vehicles that come into view, by what is heard and seen, and of the traffic; its alarm."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np

from worldstate.abduction.co_evidence import MOSTLY_MISSED, Unqueried
from worldstate.abduction.cueing.cueing_policy import CueingPolicy
from worldstate.abduction.sequence.markov_chain import at_prior, context_prior
from worldstate.abduction.sequence.sequence_inputs import HOP_S, SIDES
from worldstate.abduction.sequence.sequence_model import (
    COMING_S,
    HELD_HOPS,
    HORIZONS_S,
    OTHERS,
    SMOOTHED_HOPS,
    SequenceAlarm,
    SequencePosterior,
)
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.belief.arrival_rate import ArrivalRate
from worldstate.belief.joint_belief import (
    BINS,
    COMES,
    FIRST_BIN,
    PARTS,
    JointBelief,
    StreetPrior,
    joint_reading,
    usual_groups,
    window_likelihoods,
)
from worldstate.belief.settings import FilterSettings
from worldstate.belief.side_belief import SideBelief
from worldstate.belief.street_model import StreetModel
from worldstate.ground import (
    CERTAIN_NATS,
    TINY,
    BoolArray,
    FloatArray,
    InvalidArgumentError,
    finite_array,
    nanoseconds,
    replaced,
    seconds,
)
from worldstate.measurement.measurement import Look, Measurement
from worldstate.state import Budget, Context, Priors, Rates

from .budget_watch import BET_S, LOOK_NS, SLACK_NS, BudgetWatch, WatchedHop, budget_of

# In seconds what the alarm's threshold was set with in hops; less by the rounding of stamps.
HOP_NS = nanoseconds(HOP_S)
_SMOOTHED_NS, _HELD_NS = SMOOTHED_HOPS * HOP_NS, HELD_HOPS * HOP_NS
_LEAST_NATS = -CERTAIN_NATS  # Of what is held against a threshold
_BET_GROUPS = COMING_S.index(BET_S) + 1
_TWO = 0.5  # P(both) from which on the vehicles of two sides are two
# Parts of vehicles that come into view within three seconds.
_SOON = COMES & (np.arange(PARTS) < FIRST_BIN + COMING_S.index(HORIZONS_S[-1]) + 1)
_SOON_OR_NOT = np.array([_SOON, ~_SOON], float).T


def bounded_log_odds(probability: float) -> float:
    """Return log-odds of at most twenty nats: e^-20 is once in fifteen years of hops."""
    least = math.exp(-CERTAIN_NATS)
    inside = min(max(probability, least), 1.0 - least)
    return math.log(inside) - math.log1p(-inside)


# No slots: what is derived is computed once, and read by every entity and cue.
@dataclass(frozen=True, eq=False)
class StreetBelief:
    """Belief of all sides, and the alarm that goes by it."""

    joint: JointBelief
    # Prior of the groups by context and model, shape (K, groups), and with the traffic that was seen; when a
    # vehicle last came into view from a side; what was last held against the threshold, nats; when each side
    # was last above it.
    usual: FloatArray
    groups: FloatArray
    emerged_ns: tuple[int | None, ...]
    decided: tuple[float, ...]
    over_ns: tuple[int | None, ...]
    # How often a vehicle has come into view past the edge of each side, while a camera looked.
    arrivals: tuple[ArrivalRate, ...]
    share: FloatArray | None = None  # shape (groups,): Prior of a sequence model, once one was read
    margin_s: float = 0.0
    alarm: SequenceAlarm | None = None  # Of a sequence model
    read_ns: dict[str, int] = field(default_factory=dict)  # When each source was last read
    # Stamps of the last .3 s with the log-odds that the alarm goes by, by side.
    recent: tuple[tuple[int, tuple[float, ...]], ...] = ()
    # P(one from a side has come into view and has not gone for long), while no sensor looks, by side.
    shown: tuple[float, ...] = ()
    stamp_ns: int = 0
    watch: BudgetWatch = field(default_factory=BudgetWatch)  # Over the alarm's budget, and over the chances

    @classmethod
    def expected(cls, context: Context, street: StreetModel) -> "StreetBelief":
        """Return the belief of a context before anything is measured."""
        never, k = (None,) * len(context.directions), len(context.directions)
        usual, watch = _usual(context, None), BudgetWatch(over_ns=never, emerged_ns=never)
        joint = JointBelief(StreetPrior.of(usual, street).weights)
        alarm, shown = (_LEAST_NATS,) * k, (0.0,) * k
        return cls(joint, usual, usual, never, alarm, never, (ArrivalRate(),) * k, shown=shown, watch=watch)

    def check(self, directions: int) -> None:
        """Refuse what a file cannot have been written with, for so many approach sides."""
        name, groups = "memory.belief", BINS + len(OTHERS)
        every = {"weights": self.joint.weights, "share": self.share}
        every |= {f"alone.{key}": one for key, one in self.joint.alone.items()}
        every |= {f"trust.{key}": one.works for key, one in self.joint.trust.items()}
        for key in ("usual", "groups"):
            finite_array(f"{name}.{key}", getattr(self, key), (directions, groups))
        for key, array in every.items():
            if array is None:
                continue
            shape = (groups,) if key == "share" else (*[2 * PARTS] * directions, 2)
            finite_array(f"{name}.{key}", array, shape)
            total = float(array.sum())
            if (array < 0.0).any() or not (key.startswith("trust") or np.isclose(total, 1.0)):
                raise InvalidArgumentError(f"{name}.{key}: expected probabilities")
        for key in ("decided", "over_ns", "emerged_ns", "arrivals", "shown"):
            if (got := len(getattr(self, key))) != directions:
                raise InvalidArgumentError(f"{name}.{key}: expected {directions}, got {got}")
        self.watch.check(directions)

    @property
    def k(self) -> int:
        """Number of approach sides."""
        return self.joint.sides

    @property
    def has_times(self) -> bool:
        """Whether a sequence model has stated when vehicles come."""
        return self.share is not None

    def threshold_nats(self, policy: CueingPolicy, street: StreetModel) -> float:
        """Return what the alarm is raised from: higher if a vehicle has just come."""
        alarm = self.alarm
        nats = bounded_log_odds(policy.gamma) if alarm is None else alarm.threshold_nats
        return nats + street.beside_nats * any(self.emerged_since(self.stamp_ns, street.beside_s))

    def budget(self, stamp_ns: int) -> Budget | None:
        """Return how the watch over the alarm stands; None without one."""
        alarm = self.alarm
        return None if alarm is None else budget_of(self.watch, stamp_ns, alarm)

    @property
    def in_view(self) -> float:
        """P(a vehicle is in view)."""
        return min(self.joint.in_view, 1.0)

    @property
    def posterior(self) -> SequencePosterior:
        """The chances of all times to visible, as one hop of a stream."""
        return SequencePosterior(self.coming[None], self.margin_s)

    @property
    def coming(self) -> FloatArray:
        """Probabilities of the groups of `COMING_S`, shape (K, 9)."""
        return self.joint.hidden[:, FIRST_BIN:]

    @cached_property
    def comes(self) -> FloatArray:
        """P(a vehicle comes into view within eight seconds), shape (K,)."""
        return np.asarray(np.minimum(np.add.reduce(self.coming, 1), 1.0))

    @property
    def both_come(self) -> float:
        """P(vehicles come into view on two sides)."""
        return max(float(np.add.reduce(self.comes)) - (1.0 - self.joint.none_comes), 0.0)

    @cached_property
    def sides(self) -> SideBelief:
        """Marginals of the joint belief over sides and explanations."""
        # The last digits depend on the order of sums, and must not decide at a threshold.
        in_view = np.maximum(self.joint.emerged_from, self.shown)
        told, emerged = [tuple(one.round(12).tolist()) for one in (self.comes, in_view)]
        any_comes = 1.0 - self.joint.none_comes
        return SideBelief(told, emerged, told, any_comes, self.joint.explanations, self.both_come)

    def emerged_since(self, stamp_ns: int, time_s: float) -> list[bool]:
        """Return from which sides a vehicle has come into view within so long before a time."""
        since_ns = stamp_ns - nanoseconds(time_s)
        return [ns is not None and ns >= since_ns for ns in self.emerged_ns]

    def since(self, since_ns: int) -> "StreetBelief":
        """Return the belief without sources and sensors that were last read before a time."""
        last_ns = [*self.read_ns.values(), *(one.stamp_ns for one in self.joint.trust.values())]
        if min(last_ns, default=since_ns) >= since_ns:
            return self
        read_ns = {name: ns for name, ns in self.read_ns.items() if ns >= since_ns}
        alone = {name: one for name, one in self.joint.alone.items() if name in read_ns}
        trust = {name: one for name, one in self.joint.trust.items() if one.stamp_ns >= since_ns}
        return replaced(self, joint=replaced(self.joint, alone=alone, trust=trust), read_ns=read_ns)

    def handed_over(
        self, kept: Mapping[int, float], apart: Collection[int], stamp_ns: int, street: StreetModel
    ) -> "StreetBelief":
        """Return the belief after vehicles came into view past the edge of some sides.

        `kept` is the chance that it was another vehicle than the one believed there, by side. Vehicles of
        sides that are `apart`, or that were likelier two than one, stay.
        """
        joint, two = self.joint, self.both_come > _TWO
        for k, residual in kept.items():
            is_apart = two or bool((set(kept) | set(apart)) - {k})
            joint = joint.emerged(k, residual, is_apart, street)
        return replaced(
            self,
            joint=joint,
            emerged_ns=tuple(stamp_ns if k in kept else ns for k, ns in enumerate(self.emerged_ns)),
            over_ns=tuple(None if k in kept else ns for k, ns in enumerate(self.over_ns)),
            decided=tuple(_LEAST_NATS if k in kept else one for k, one in enumerate(self.decided)),
            arrivals=tuple(one.with_one_more() if k in kept else one for k, one in enumerate(self.arrivals)),
        )

    def prior(self, street: StreetModel) -> StreetPrior:
        """Return what is expected of the street without evidence."""
        return StreetPrior.of(self.groups, street)

    def has_news(self, stamp_ns: int) -> bool:
        """Tell whether anything was measured for as long as an alarm holds."""
        return bool(self.recent) and stamp_ns <= self.recent[-1][0] + _HELD_NS + SLACK_NS

    def decided_at(self, stamp_ns: int) -> tuple[float, ...]:
        """Return what is held against the threshold, nothing without news."""
        return self.decided if self.has_news(stamp_ns) else (_LEAST_NATS,) * self.k

    def not_held(self, sides: Collection[int], policy: CueingPolicy, street: StreetModel) -> "StreetBelief":
        """Return the belief without the alarms of some sides that are only held."""
        least = self.threshold_nats(policy, street)
        pairs = enumerate(zip(self.over_ns, self.decided, strict=True))
        over_ns = tuple(None if k in sides and one < least else ns for k, (ns, one) in pairs)
        return replaced(self, over_ns=over_ns)

    def alarm_ends_ns(self, stamp_ns: int) -> tuple[int | None, ...]:
        """Return for each side when its alarm ends: a second after it was last above the threshold."""
        ends_ns = [None if over_ns is None else over_ns + _HELD_NS + SLACK_NS for over_ns in self.over_ns]
        return tuple([None if end_ns is None or end_ns < stamp_ns else end_ns for end_ns in ends_ns])

    def watched(self, stamp_ns: int, miss_rate: float = 1.0) -> bool:
        """Tell whether a sensor has just looked that misses less than so much of what is in view."""
        looks = self.joint.trust.values()
        since_ns = stamp_ns - LOOK_NS
        return any(one.miss_rate < miss_rate and one.stamp_ns >= since_ns for one in looks)

    def log_odds(self, street: StreetModel) -> dict[str, FloatArray]:
        """Return the log-odds of what the alarm goes by, shape (K,), after each piece of evidence.

        By a sequence model it is that a vehicle comes into view from a side within three seconds, else that
        one is hidden on any side, as the paper's statistic is. The last piece is `alarm_nats`.
        """
        before = self._log_odds(self.prior(street).joint)
        pieces, last, kind = {"prior": before}, before, "sequence" if self.has_times else "window"
        for source, one in sorted(self.joint.alone.items()):
            last = last + (self._log_odds(JointBelief(one)) - before)
            pieces[kind if len(self.joint.alone) == 1 else f"{kind} {source}"] = last
        return pieces | {"looks": self.alarm_nats}

    @property
    def alarm_nats(self) -> FloatArray:
        """The log-odds that the alarm goes by, shape (K,)."""
        return self._log_odds(self.joint)

    def _log_odds(self, joint: JointBelief) -> FloatArray:
        if self.has_times:
            soon, rest = np.maximum(joint.hidden @ _SOON_OR_NOT, TINY).T
            return np.asarray(np.log(soon / rest))
        return np.full(self.k, bounded_log_odds(1.0 - joint.none_comes))


def _usual(context: Context, share: FloatArray | None) -> FloatArray:
    """Return the distribution of the groups expected of each side, shape (K, groups).

    It is that of the context's priors, or else of a sequence model, once one was read (`share`), or of the
    context's rates.
    """
    given, hides = context.hidden_by_side or {}, tuple([one.hides for one in context.occluders])
    of_sides = tuple([given.get(side) for side in context.directions])
    content = None if share is None else share.tobytes()
    return _usual_of(context.priors, context.rates, of_sides, hides, content)


@lru_cache
def _usual_of(
    priors: Priors | None,
    rates: Rates,
    given: tuple[float | None, ...],
    hides: tuple[bool, ...],
    share: bytes | None,
) -> FloatArray:
    k, usual = len(given), priors or rates.priors(len(given))
    # Sides are independent: of P(hidden) each has so much that no vehicle is hidden on any has the rest.
    each = 1.0 - (1.0 - usual.hidden) ** (1.0 / k)
    if share is None:
        seen = usual.visible / max(usual.visible + usual.none, TINY)
        groups = usual_groups([each if one is None else one for one in given], seen)
    else:
        model, own = np.frombuffer(share), None if priors is None else each
        groups = np.array([context_prior(model, own if one is None else one) for one in given])
    # Nothing is hidden where nothing hides it.
    groups[~np.array(hides), :BINS] = TINY
    return np.asarray(groups / groups.sum(axis=1, keepdims=True))


def _with_traffic(kept: StreetBelief, context: Context, street: StreetModel) -> FloatArray:
    """Return the distribution of the groups by the traffic that was seen, too; a given one stands."""
    groups, given = kept.usual.copy(), context.hidden_by_side or {}
    for row, side, rate in zip(groups, context.directions, kept.arrivals, strict=True):
        if context.priors is None and side not in given:
            row[:BINS] *= math.exp(rate.shift_nats(np.add.reduce(row[:BINS]) / COMING_S[-1], street))
    return np.asarray(groups / np.add.reduce(groups, 1)[:, None])


def carried(
    kept: StreetBelief, stamp_ns: int, step_ns: int, context: Context, street: StreetModel
) -> StreetBelief:
    """Return the belief at a later time, with nothing heard."""
    kept = _expecting(kept, context, street)
    joint, arrivals = kept.joint.carried(kept.prior(street), street, step_ns), kept.arrivals
    if kept.watched(stamp_ns):
        arrivals = tuple(one.watched_for(seconds(step_ns), street) for one in arrivals)
    gone = math.exp(-seconds(step_ns) / street.passage_s)
    shown = tuple(gone * one for one in kept.shown)
    return replaced(kept, joint=joint, arrivals=arrivals, shown=shown, stamp_ns=stamp_ns)


def _expecting(kept: StreetBelief, context: Context, street: StreetModel) -> StreetBelief:
    """Return the belief at the prior of context and model, which may be another one than a step ago."""
    usual = _usual(context, kept.share)
    if usual is not kept.usual and not np.array_equal(usual, kept.usual):
        before, after = (StreetPrior.of(one, street).weights for one in (kept.usual, usual))
        kept = replaced(kept, joint=kept.joint.at_prior(before, after), usual=usual)
    return replaced(kept, groups=_with_traffic(kept, context, street))


def informed(
    kept: StreetBelief,
    measurement: Measurement,
    looks: Sequence[Look],
    context: Context,
    policy: CueingPolicy,
    settings: FilterSettings,
) -> StreetBelief:
    """Return the belief at a measurement after its evidence and new looks."""
    street, reading = settings.street, measurement.sequence
    if measurement.heard.usable and isinstance(reading, SequenceReading):
        if not kept.has_times:  # The alarm by windows goes by another event
            kept = replaced(kept, recent=(), over_ns=(None,) * kept.k)
        kept = replaced(kept, share=reading.share, margin_s=reading.margin_s, alarm=reading.alarm)
    before = kept = _expecting(kept, context, street)
    if measurement.heard.usable:
        kept = _read(kept, measurement, context, settings)
    joint = kept.joint
    for look in looks:
        if not isinstance(look.answer, Unqueried):
            joint = joint.looked(look.sensor, look.answer, look.stamp_ns, street)
    if kept is before and joint is kept.joint:  # No news: what is out ends as in silence
        return replaced(kept, stamp_ns=measurement.stamp_ns)
    return alerted(_shown(replaced(kept, joint=joint, stamp_ns=measurement.stamp_ns), street), policy, street)


def _shown(kept: StreetBelief, street: StreetModel) -> StreetBelief:
    """Return the belief with the vehicles that are in view by their sound alone; a look finds them itself."""
    if kept.watched(kept.stamp_ns):
        return replaced(kept, shown=(0.0,) * kept.k)
    own, now = kept.emerged_since(kept.stamp_ns, street.beside_s), kept.joint.emerged_from.tolist()
    pairs = zip(own, kept.shown, now, strict=True)
    return replaced(kept, shown=tuple([0.0 if is_own else max(pair) for is_own, *pair in pairs]))


def _read(
    kept: StreetBelief, measurement: Measurement, context: Context, settings: FilterSettings
) -> StreetBelief:
    """Return the belief after what a source has found: the last three seconds, or the last one alone."""
    reading, source, stamp_ns = measurement.sequence, measurement.source, measurement.stamp_ns
    # The sound is that of a vehicle which has just come into view.
    street, masked = settings.street, any(kept.emerged_since(stamp_ns, settings.street.masked_s))
    step_s = seconds(stamp_ns - kept.read_ns[source]) if source in kept.read_ns else math.inf
    if isinstance(reading, SequenceReading):
        joint, sides, memory_s = *_sequence(kept, reading, context, street), street.reading_s
    else:
        if not np.ptp(measurement.signature.log_likelihoods):
            return kept  # Evidence that is alike for all explanations moves nothing
        signature = measurement.signature
        found = dict(zip(signature.directions, signature.hidden, strict=True))
        hidden = [found.get(side) for side in context.directions]
        usual = kept.prior(street).by_part
        told = window_likelihoods(hidden, signature.visible, signature.none, float(usual[..., 1].sum()))
        if settings.windows == "likelihood":
            weight = min(step_s / settings.window_s, 1.0) * measurement.heard.share
            read_ns = kept.read_ns | {source: stamp_ns}
            return kept if masked else replaced(kept, joint=kept.joint.told(told**weight), read_ns=read_ns)
        joint, sides, memory_s = usual * told, list(range(kept.k)), street.window_s
    read_ns = kept.read_ns | {source: stamp_ns}
    if masked:
        return replaced(kept, read_ns=read_ns)
    # Of evidence that overlaps, what is new counts.
    new = -math.expm1(-step_s / memory_s)
    joint, heard = joint / np.add.reduce(joint, None), measurement.heard.share
    after = kept.joint.read(source, joint, kept.prior(street), sides, new, heard)
    return replaced(kept, joint=after, read_ns=read_ns)


def _sequence(
    kept: StreetBelief, reading: SequenceReading, context: Context, street: StreetModel
) -> tuple[FloatArray, list[int]]:
    """Return what a sequence makes of the sides that it names, and which they are in the context."""
    sides = [k for k, side in enumerate(context.directions) if side in SIDES]
    rows = [SIDES.index(context.directions[k]) for k in sides]
    expected, share = kept.groups[sides], reading.share
    usual_in_view = float(share[BINS] / np.add.reduce(share[BINS:]))
    joint = joint_reading(at_prior(reading.groups[rows], share, expected), usual_in_view, street.by_sound)
    # Averaged, hops are surer than each.
    usual = StreetPrior.of(expected, street).by_part
    return usual * (joint / usual) ** street.reading_gain, sides


def _watched(kept: StreetBelief, over: BoolArray) -> WatchedHop:
    """Return a hop for the watch over the alarm; `over` its own threshold, by side."""
    within = np.add.reduce(kept.coming[:, :_BET_GROUPS], 1).tolist()
    looked = kept.watched(kept.stamp_ns, MOSTLY_MISSED)
    return WatchedHop(kept.stamp_ns, looked, tuple(over.tolist()), kept.emerged_ns, tuple(within))


def alerted(kept: StreetBelief, policy: CueingPolicy, street: StreetModel) -> StreetBelief:
    """Return the belief with what decides held against the alarm's threshold.

    The mean over the last .3 s, or since a vehicle came into view from that side, of the log-odds that the
    alarm goes by, and of a less likely side no more than that two come.
    """
    nats = kept.alarm_nats.round(9)  # Rounding must not choose a side
    since_ns = kept.stamp_ns - _SMOOTHED_NS + SLACK_NS
    recent = (*[one for one in kept.recent if one[0] > since_ns], (kept.stamp_ns, tuple(nats.tolist())))
    # Of each hop the last one: however many measurements there are, time counts.
    of_hop = {(kept.stamp_ns - one[0] + SLACK_NS) // HOP_NS: one for one in recent}.values()
    rows = [
        [one[1][k] for one in of_hop if ns is None or one[0] >= ns] for k, ns in enumerate(kept.emerged_ns)
    ]
    decided, threshold = np.array([sum(row) / len(row) for row in rows]), kept.threshold_nats(policy, street)
    elsewhere = np.maximum(1.0 - kept.joint.none_comes, TINY) - kept.comes
    # By windows all sides have the same log-odds.
    rank = decided if kept.has_times else kept.comes.round(9)
    decided = of_two(decided, kept.comes, elsewhere, rank, threshold)
    over, denied = decided >= threshold, np.array(kept.sides.risks) < street.death
    watch = kept.watch
    if kept.alarm is not None:
        watch = watch.after(_watched(kept, over & ~denied), kept.alarm.onsets_per_hour)
    # A risk that denies an alarm ends it: it is not held, and time alone does not bring it back. One vehicle
    # is on one side: what is held there ends as another side's alarm begins.
    moved = ~over & (True in over and kept.both_come <= _TWO)
    sides = zip(over, denied | moved, kept.over_ns, strict=True)
    over_ns = tuple([None if no else kept.stamp_ns if yes else ns for yes, no, ns in sides])
    decided = np.where(over & denied, _LEAST_NATS, decided)
    after = replaced(kept, recent=recent, decided=tuple(decided.tolist()), over_ns=over_ns, watch=watch)
    # The belief is the same: what was derived of it, half of the time of a step, is not derived again.
    vars(after).update(vars(kept) | vars(after))
    return after


def of_two(
    nats: FloatArray, here: FloatArray, elsewhere: FloatArray, rank: FloatArray, threshold: float
) -> FloatArray:
    r"""Return what is held against the threshold, nats.

    Of a side of less than the highest rank it is at most

    .. math:: \gamma + \log \frac{P(\text{comes here})}{P(\text{comes on another side, not here})}

    If it is not known from which side one vehicle comes, all are likely; how rarely one on another side is
    believed to come alone shows that two come. Shapes: all (K,).

    Examples
    --------
    >>> nats = np.array([0.1, 0.0])
    >>> of_two(nats, np.array([0.45, 0.45]), np.array([0.45, 0.45]), nats, -1.0).round(3).tolist()
    [0.1, -1.0]
    """
    apart = np.log(np.maximum(here, TINY)) - np.log(np.maximum(elsewhere, TINY))
    # One that is exactly as likely alone as here is not named.
    least = threshold + np.where(apart > 0.0, apart, np.minimum(apart, -TINY))
    return np.asarray(np.where(rank >= np.maximum.reduce(rank), nats, np.minimum(nats, least)))
