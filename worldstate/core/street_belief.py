"""Belief over vehicles that come into view, from sound, looks and traffic, with an alarm."""

import math
from collections.abc import Collection, Iterable, Mapping
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
)
from worldstate.abduction.sequence.sequence_reader import SequenceReading
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
from worldstate.belief.side_belief import ArrivalRate, SideBelief
from worldstate.belief.street_model import FilterSettings, StreetModel
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

# The alarm's threshold was set for spans in hops; these are the same spans in time.
HOP_NS = nanoseconds(HOP_S)
_SMOOTHED_NS, _HELD_NS = SMOOTHED_HOPS * HOP_NS, HELD_HOPS * HOP_NS
_LEAST_NATS = -CERTAIN_NATS  # Lowest value that is compared with a threshold
_BET_GROUPS = COMING_S.index(BET_S) + 1
_TWO = 0.5  # P(both) from which two sides have two vehicles
# Parts of vehicles that come into view within three seconds.
_SOON = COMES & (np.arange(PARTS) < FIRST_BIN + COMING_S.index(HORIZONS_S[-1]) + 1)
_SOON_OR_NOT = np.array([_SOON, ~_SOON], float).T


def bounded_log_odds(probability: float) -> float:
    """Return log-odds of at most twenty nats: e^-20 corresponds to one hop in 1.5 years."""
    least = math.exp(-CERTAIN_NATS)
    inside = min(max(probability, least), 1.0 - least)
    return math.log(inside) - math.log1p(-inside)


# No slots: derived values are computed once and used by every entity and cue.
@dataclass(frozen=True, eq=False)
class StreetBelief:
    """Belief over all sides, with the alarm."""

    joint: JointBelief
    usual: FloatArray  # Prior of the groups by context and model, shape (K, groups)
    groups: FloatArray  # This prior with the observed traffic, shape (K, groups)
    emerged_ns: tuple[int | None, ...]  # When a vehicle last came into view, by side
    decided: tuple[float, ...]  # Values last compared with the threshold, nats
    over_ns: tuple[int | None, ...]  # When each side was last above the threshold
    # Rate of vehicles that come into view past the edge of each side, while a camera looks.
    arrivals: tuple[ArrivalRate, ...]
    share: FloatArray | None = None  # shape (groups,): Prior of a sequence model; None before a reading
    margin_s: float = 0.0
    alarm: SequenceAlarm | None = None
    read_ns: dict[str, int] = field(default_factory=dict)  # Last reading by source
    # Stamps of the last 0.3 s with the alarm's log-odds by side.
    recent: tuple[tuple[int, tuple[float, ...]], ...] = ()
    # P(a vehicle from the side is in view by its sound alone, while no sensor looks), by side.
    shown: tuple[float, ...] = ()
    stamp_ns: int = 0
    watch: BudgetWatch = field(default_factory=BudgetWatch)  # Watch over the alarm's budget and the chances

    @classmethod
    def expected(cls, context: Context, street: StreetModel) -> "StreetBelief":
        """Return the belief of a context before any measurement."""
        never, k = (None,) * len(context.directions), len(context.directions)
        usual, watch = _usual(context, None), BudgetWatch(over_ns=never, emerged_ns=never)
        joint = JointBelief(StreetPrior.of(usual, street).weights)
        alarm, shown = (_LEAST_NATS,) * k, (0.0,) * k
        return cls(joint, usual, usual, never, alarm, never, (ArrivalRate(),) * k, shown=shown, watch=watch)

    def check(self, directions: int) -> None:
        """Raise an error for values that no checkpoint with so many approach sides can contain."""
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
        """Whether a sequence model has given times to visible."""
        return self.share is not None

    def threshold_nats(self, policy: CueingPolicy, street: StreetModel) -> float:
        """Return the threshold of the alarm, which is higher if a vehicle has just come into view."""
        alarm = self.alarm
        nats = bounded_log_odds(policy.gamma) if alarm is None else alarm.threshold_nats
        return nats + street.beside_nats * any(self.emerged_since(self.stamp_ns, street.beside_s))

    def budget(self, stamp_ns: int) -> Budget | None:
        """Return the state of the alarm's budget; None without an alarm curve."""
        alarm = self.alarm
        return None if alarm is None else budget_of(self.watch, stamp_ns, alarm)

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
        # Last digits depend on the order of sums and must have no effect at a threshold.
        in_view = np.maximum(self.joint.emerged_from, self.shown)
        told, emerged = [tuple(one.round(12).tolist()) for one in (self.comes, in_view)]
        any_comes = 1.0 - self.joint.none_comes
        return SideBelief(told, emerged, told, any_comes, self.joint.explanations, self.both_come)

    def emerged_since(self, stamp_ns: int, time_s: float) -> list[bool]:
        """Return whether a vehicle has come into view from each side in the given time before a stamp."""
        since_ns = stamp_ns - nanoseconds(time_s)
        return [ns is not None and ns >= since_ns for ns in self.emerged_ns]

    def since(self, since_ns: int) -> "StreetBelief":
        """Return the belief without sources and sensors whose last data are older than a time."""
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

        `kept` is the chance that it was another vehicle than the one believed there, by side. Vehicles on
        other sides stay if these sides are in `apart`, or if two vehicles were likelier than one.
        """
        joint, two, arrivals = self.joint, self.both_come > _TWO, list(self.arrivals)
        for k, residual in kept.items():
            is_apart = two or bool((set(kept) | set(apart)) - {k})
            joint = joint.emerged(k, residual, is_apart, street)
            arrivals[k] = replaced(arrivals[k], count=arrivals[k].count + 1.0)
        return replaced(
            self,
            joint=joint,
            emerged_ns=tuple(stamp_ns if k in kept else ns for k, ns in enumerate(self.emerged_ns)),
            over_ns=tuple(None if k in kept else ns for k, ns in enumerate(self.over_ns)),
            decided=tuple(_LEAST_NATS if k in kept else one for k, one in enumerate(self.decided)),
            arrivals=tuple(arrivals),
        )

    def prior(self, street: StreetModel) -> StreetPrior:
        """Return the prior of the street without evidence."""
        return StreetPrior.of(self.groups, street)

    def has_news(self, stamp_ns: int) -> bool:
        """Return whether there was a measurement within the time that an alarm is held."""
        return bool(self.recent) and stamp_ns <= self.recent[-1][0] + _HELD_NS + SLACK_NS

    def decided_at(self, stamp_ns: int) -> tuple[float, ...]:
        """Return the values that are compared with the threshold; without news, the lowest value."""
        return self.decided if self.has_news(stamp_ns) else (_LEAST_NATS,) * self.k

    def not_held(self, sides: Collection[int], policy: CueingPolicy, street: StreetModel) -> "StreetBelief":
        """Return the belief without those alarms of some sides that are only held, below the threshold."""
        least = self.threshold_nats(policy, street)
        pairs = enumerate(zip(self.over_ns, self.decided, strict=True))
        over_ns = tuple(None if k in sides and one < least else ns for k, (ns, one) in pairs)
        return replaced(self, over_ns=over_ns)

    def alarm_ends_ns(self, stamp_ns: int) -> tuple[int | None, ...]:
        """Return when the alarm of each side ends: a second after it was last above the threshold."""
        ends_ns = [None if over_ns is None else over_ns + _HELD_NS + SLACK_NS for over_ns in self.over_ns]
        return tuple([None if end_ns is None or end_ns < stamp_ns else end_ns for end_ns in ends_ns])

    def watched(self, stamp_ns: int, miss_rate: float = 1.0) -> bool:
        """Return whether a sensor with a miss rate below `miss_rate` has just looked."""
        looks = self.joint.trust.values()
        since_ns = stamp_ns - LOOK_NS
        return any(one.miss_rate < miss_rate and one.stamp_ns >= since_ns for one in looks)

    def log_odds(self, street: StreetModel) -> dict[str, FloatArray]:
        """Return the alarm's log-odds, shape (K,), after each piece of evidence.

        With a sequence model the event is that a vehicle comes into view from a side within three seconds;
        otherwise, that a vehicle is hidden on any side, as in the paper. The last piece is `alarm_nats`.
        """
        before = self._log_odds(self.prior(street).joint)
        pieces, last, kind = {"prior": before}, before, "sequence" if self.has_times else "window"
        for source, one in sorted(self.joint.alone.items()):
            last = last + (self._log_odds(JointBelief(one)) - before)
            pieces[kind if len(self.joint.alone) == 1 else f"{kind} {source}"] = last
        return pieces | {"looks": self.alarm_nats}

    @property
    def alarm_nats(self) -> FloatArray:
        """The alarm's log-odds, shape (K,)."""
        return self._log_odds(self.joint)

    def _log_odds(self, joint: JointBelief) -> FloatArray:
        if self.has_times:
            soon, rest = np.maximum(joint.hidden @ _SOON_OR_NOT, TINY).T
            return np.asarray(np.log(soon / rest))
        return np.full(self.k, bounded_log_odds(1.0 - joint.none_comes))


def _usual(context: Context, share: FloatArray | None) -> FloatArray:
    """Return the expected distribution of the groups on each side, shape (K, groups).

    It comes from the context's priors, or else from a sequence model (`share`), or else from the context's
    rates.
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
    # Sides are independent and alike: each has the P(hidden) that gives the stated P(none is hidden).
    each = 1.0 - (1.0 - usual.hidden) ** (1.0 / k)
    if share is None:
        seen = usual.visible / max(usual.visible + usual.none, TINY)
        groups = usual_groups([each if one is None else one for one in given], seen)
    else:
        model, own = np.frombuffer(share), None if priors is None else each
        groups = np.array([context_prior(model, own if one is None else one) for one in given])
    # A side without an occluder hides nothing.
    groups[~np.array(hides), :BINS] = TINY
    return np.asarray(groups / groups.sum(axis=1, keepdims=True))


def _with_traffic(kept: StreetBelief, context: Context, street: StreetModel) -> FloatArray:
    """Return the distribution of the groups with the observed traffic; given values are kept."""
    groups, given = kept.usual.copy(), context.hidden_by_side or {}
    for row, side, rate in zip(groups, context.directions, kept.arrivals, strict=True):
        if context.priors is None and side not in given:
            row[:BINS] *= math.exp(rate.shift_nats(np.add.reduce(row[:BINS]) / COMING_S[-1], street))
    return np.asarray(groups / np.add.reduce(groups, 1)[:, None])


def carried(
    kept: StreetBelief, stamp_ns: int, step_ns: int, context: Context, street: StreetModel
) -> StreetBelief:
    """Return the belief at a later time without evidence."""
    kept = _expecting(kept, context, street)
    joint, arrivals = kept.joint.carried(kept.prior(street), street, step_ns), kept.arrivals
    if kept.watched(stamp_ns):
        arrivals = tuple(one.watched_for(seconds(step_ns), street) for one in arrivals)
    gone = math.exp(-seconds(step_ns) / street.passage_s)
    shown = tuple(gone * one for one in kept.shown)
    return replaced(kept, joint=joint, arrivals=arrivals, shown=shown, stamp_ns=stamp_ns)


def _expecting(kept: StreetBelief, context: Context, street: StreetModel) -> StreetBelief:
    """Return the belief at the present prior of context and model, which may differ from the last step's."""
    usual = _usual(context, kept.share)
    if usual is not kept.usual and not np.array_equal(usual, kept.usual):
        before, after = (StreetPrior.of(one, street).weights for one in (kept.usual, usual))
        kept = replaced(kept, joint=kept.joint.at_prior(before, after), usual=usual)
    return replaced(kept, groups=_with_traffic(kept, context, street))


def informed(
    kept: StreetBelief,
    measurement: Measurement,
    looks: Iterable[Look],
    context: Context,
    policy: CueingPolicy,
    settings: FilterSettings,
) -> StreetBelief:
    """Return the belief at a measurement after its evidence and new looks."""
    street, reading = settings.street, measurement.sequence
    if measurement.heard.usable and isinstance(reading, SequenceReading):
        if not kept.has_times:  # The alarm by windows is about another event
            kept = replaced(kept, recent=(), over_ns=(None,) * kept.k)
        kept = replaced(kept, share=reading.share, margin_s=reading.margin_s, alarm=reading.alarm)
    before = kept = _expecting(kept, context, street)
    if measurement.heard.usable:
        kept = _read(kept, measurement, context, settings)
    joint = kept.joint
    for look in looks:
        if not isinstance(look.answer, Unqueried):
            joint = joint.looked(look.sensor, look.answer, look.stamp_ns, street)
    if kept is before and joint is kept.joint:  # Without news an alarm ends as in silence
        return replaced(kept, stamp_ns=measurement.stamp_ns)
    return alerted(_shown(replaced(kept, joint=joint, stamp_ns=measurement.stamp_ns), street), policy, street)


def _shown(kept: StreetBelief, street: StreetModel) -> StreetBelief:
    """Return the belief with the vehicles in view by sound alone; there are none while a sensor looks."""
    if kept.watched(kept.stamp_ns):
        return replaced(kept, shown=(0.0,) * kept.k)
    own, now = kept.emerged_since(kept.stamp_ns, street.beside_s), kept.joint.emerged_from.tolist()
    pairs = zip(own, kept.shown, now, strict=True)
    return replaced(kept, shown=tuple([0.0 if is_own else max(pair) for is_own, *pair in pairs]))


def _read(
    kept: StreetBelief, measurement: Measurement, context: Context, settings: FilterSettings
) -> StreetBelief:
    """Return the belief after the reading of a source: of the last three seconds, or of a single window."""
    reading, source, stamp_ns = measurement.sequence, measurement.source, measurement.stamp_ns
    # `masked`: the sound is that of a vehicle that has just come into view.
    street, masked = settings.street, any(kept.emerged_since(stamp_ns, settings.street.masked_s))
    step_s = seconds(stamp_ns - kept.read_ns[source]) if source in kept.read_ns else math.inf
    if isinstance(reading, SequenceReading):
        joint, sides, memory_s = *_sequence(kept, reading, context, street), street.reading_s
    else:
        if not np.ptp(measurement.signature.log_likelihoods):
            return kept  # Evidence that is equal for all explanations has no effect
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
    # Readings overlap; only the new part has weight.
    new = -math.expm1(-step_s / memory_s)
    joint, heard = joint / np.add.reduce(joint, None), measurement.heard.share
    after = kept.joint.read(source, joint, kept.prior(street), sides, new, heard)
    return replaced(kept, joint=after, read_ns=read_ns)


def _sequence(
    kept: StreetBelief, reading: SequenceReading, context: Context, street: StreetModel
) -> tuple[FloatArray, list[int]]:
    """Return the joint reading of a sequence, and the indices of its sides in the context."""
    sides = [k for k, side in enumerate(context.directions) if side in SIDES]
    rows = [SIDES.index(context.directions[k]) for k in sides]
    expected, share = kept.groups[sides], reading.share
    usual_in_view = float(share[BINS] / np.add.reduce(share[BINS:]))
    joint = joint_reading(at_prior(reading.groups[rows], share, expected), usual_in_view, street.by_sound)
    # The exponent makes the reading more certain: the average over hops is more certain than each hop.
    usual = StreetPrior.of(expected, street).by_part
    return usual * (joint / usual) ** street.reading_gain, sides


def _watched(kept: StreetBelief, over: BoolArray) -> WatchedHop:
    """Return the watch's input at a hop; `over` marks the sides above the alarm's own threshold."""
    within = np.add.reduce(kept.coming[:, :_BET_GROUPS], 1).tolist()
    looked = kept.watched(kept.stamp_ns, MOSTLY_MISSED)
    return WatchedHop(kept.stamp_ns, looked, tuple(over.tolist()), kept.emerged_ns, tuple(within))


def alerted(kept: StreetBelief, policy: CueingPolicy, street: StreetModel) -> StreetBelief:
    """Return the belief after its log-odds are compared with the alarm's threshold.

    The compared value is the mean of the alarm's log-odds over the last 0.3 s, or since a vehicle came into
    view from that side. On a less likely side it is limited by the log-odds that two vehicles come.
    """
    nats = kept.alarm_nats.round(9)  # Rounding must not select a side
    since_ns = kept.stamp_ns - _SMOOTHED_NS + SLACK_NS
    recent = (*[one for one in kept.recent if one[0] > since_ns], (kept.stamp_ns, tuple(nats.tolist())))
    # Only the last value of each hop is used, so the number of measurements per hop has no effect.
    of_hop = {(kept.stamp_ns - one[0] + SLACK_NS) // HOP_NS: one for one in recent}.values()
    rows = [
        [one[1][k] for one in of_hop if ns is None or one[0] >= ns] for k, ns in enumerate(kept.emerged_ns)
    ]
    decided, threshold = np.array([sum(row) / len(row) for row in rows]), kept.threshold_nats(policy, street)
    elsewhere = np.maximum(1.0 - kept.joint.none_comes, TINY) - kept.comes
    # Without a sequence model all sides have the same log-odds.
    rank = decided if kept.has_times else kept.comes.round(9)
    decided = of_two(decided, kept.comes, elsewhere, rank, threshold)
    over, denied = decided >= threshold, np.array(kept.sides.risks) < street.death
    watch = kept.watch
    if kept.alarm is not None:
        watch = watch.after(_watched(kept, over & ~denied), kept.alarm.onsets_per_hour)
    # A risk that contradicts an alarm ends it: it is not held, and time alone does not restore it. One
    # vehicle is on one side, so an alarm held on a side ends when the alarm of another side begins.
    moved = ~over & (True in over and kept.both_come <= _TWO)
    sides = zip(over, denied | moved, kept.over_ns, strict=True)
    over_ns = tuple([None if no else kept.stamp_ns if yes else ns for yes, no, ns in sides])
    decided = np.where(over & denied, _LEAST_NATS, decided)
    after = replaced(kept, recent=recent, decided=tuple(decided.tolist()), over_ns=over_ns, watch=watch)
    # The belief is the same, so its derived values, which take half of a step, are kept.
    vars(after).update(vars(kept) | vars(after))
    return after


def of_two(
    nats: FloatArray, here: FloatArray, elsewhere: FloatArray, rank: FloatArray, threshold: float
) -> FloatArray:
    r"""Return the values that are compared with the threshold, nats.

    On a side below the highest rank the value is at most

    .. math:: \gamma + \log \frac{P(\text{comes here})}{P(\text{comes on another side, not here})}

    If the side of a single vehicle is unknown, several sides are likely. Two vehicles are coming only if it
    is unlikely that one comes on another side alone. Shapes: all (K,).

    Examples
    --------
    >>> nats = np.array([0.1, 0.0])
    >>> of_two(nats, np.array([0.45, 0.45]), np.array([0.45, 0.45]), nats, -1.0).round(3).tolist()
    [0.1, -1.0]
    """
    apart = np.log(np.maximum(here, TINY)) - np.log(np.maximum(elsewhere, TINY))
    # A side gets no alarm if a vehicle is exactly as likely there as on another side alone.
    least = threshold + np.where(apart > 0.0, apart, np.minimum(apart, -TINY))
    return np.asarray(np.where(rank >= np.maximum.reduce(rank), nats, np.minimum(nats, least)))
