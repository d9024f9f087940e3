r"""One distribution over the states of all approach sides together.

The state of a side has two parts that do not exclude each other: a hidden vehicle (none, a distant one, or
one that comes into view within a time bin), and a vehicle in view that came from there (no, yes). Besides all
sides, a vehicle from elsewhere is in view or not. With the chains A_k of the sides and A_e of elsewhere,

.. math:: \bar p_t = p_{t-1}\, (A_1 \otimes \dots \otimes A_K \otimes A_e), \qquad
          p_t(s) \propto \bar p_t(s) \prod_j e_j(s)

Only the new part of a reading q enters. A reading covers the hidden part of every side and whether anything
is in view. With these parts r(s) of a state, and the belief n from sound alone,

.. math:: e(s) = \frac{q(r(s))}{\bar n(r(s))}, \qquad n_t(s) = \bar n_t(s)\, e(s)

so that without other evidence p = n, whose parts equal q, for any chain.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, reduce
from itertools import product

import numpy as np

from worldstate.abduction.co_evidence import Absent, Present
from worldstate.abduction.sequence.markov_chain import balanced, transitions
from worldstate.abduction.sequence.sequence_inputs import HOP_S
from worldstate.abduction.sequence.sequence_model import COMING_S, GROUPS
from worldstate.ground import TINY, FloatArray, mean, replaced, seconds

from .street_model import StreetModel

BINS = len(COMING_S)
# Hidden parts in the order of the axis: none, distant, and the bins of the time to visible.
NONE, DISTANT, FIRST_BIN = 0, 1, 2
PARTS = FIRST_BIN + BINS
STATES = 2 * PARTS  # Per side: hidden part, then whether a vehicle from there is in view
COMES = np.arange(PARTS) >= FIRST_BIN
_COMES_OF = {n: np.ix_(*[COMES.astype(int)] * n) for n in (1, 2)}  # Index by the number of sides in a reading
_GROUP = {name: k for k, name in enumerate(GROUPS)}
_SEEN, _OTHER = _GROUP["seen"], _GROUP["other"]
_DISTANT = [_GROUP["rising"], _GROUP["falling"]]
_ABSENT = [_GROUP["none"], _GROUP["other"], _GROUP["past"], _SEEN]


@dataclass(frozen=True, slots=True)
class SidePrior:
    """Prior of one side: its hidden part, and P(a vehicle from there is in view)."""

    hidden: tuple[float, ...]  # shape (parts,)
    in_view: float

    @classmethod
    def of(cls, groups: FloatArray, in_view: float, street: StreetModel) -> "SidePrior":
        """Return the prior of a side, given a prior of the sequence model's groups, shape (groups,).

        P(in view) balances arrivals and departures, but is at most `in_view`.
        """
        # A part with probability zero cannot be balanced.
        parts = np.maximum([groups[_ABSENT].sum(), groups[_DISTANT].sum(), *groups[:BINS]], TINY)
        total = math.fsum(parts)
        hidden = tuple(float(one) / total for one in parts)
        passing = hidden[FIRST_BIN] / COMING_S[0] * street.passage_s
        return cls(hidden, min(passing / (1.0 + passing), in_view))

    @property
    def states(self) -> FloatArray:
        """Shape (states,)."""
        return np.outer(self.hidden, [1.0 - self.in_view, self.in_view]).ravel()


@lru_cache
def _side_rates(prior: SidePrior, street: StreetModel) -> FloatArray:
    """Return the rates Q of one side, 1/s, which keep its prior stationary; shape (states, states)."""
    hop, share = np.eye(STATES), prior.states
    spans_s = np.diff((0.0, *COMING_S)).tolist()
    arrows = list[tuple[int, int, float]]()
    for seen in (0, 1):
        at = [2 * part + seen for part in range(PARTS)]
        first, *later = at[FIRST_BIN:]
        arrows.append((first, 2 * NONE + 1, spans_s[0]))
        arrows += zip(later, at[FIRST_BIN:], spans_s[1:], strict=False)
        arrows += [(at[NONE], at[-1], street.arrival_s), (at[NONE], at[DISTANT], street.arrival_s)]
        arrows += [(at[DISTANT], at[NONE], street.far_s), (at[DISTANT], at[-1], street.arrival_s)]
    arrows += [(2 * part + 1, 2 * part, street.passage_s) for part in range(PARTS)]
    for one, to, mean_s in arrows:
        hop[one, [one, to]] += [-HOP_S / mean_s, HOP_S / mean_s]
    still = balanced((1.0 - street.leak) * hop + street.leak * share, share)
    return np.asarray((still - np.eye(STATES)) / HOP_S)


# No slots: derived values are computed once.
@dataclass(frozen=True)
class StreetPrior:
    """Prior of all sides and of elsewhere."""

    sides: tuple[SidePrior, ...]
    elsewhere: float  # P(a vehicle from elsewhere is in view)

    @classmethod
    def of(cls, groups: FloatArray, street: StreetModel) -> "StreetPrior":
        """Return the prior, given priors of the sequence model's groups, shape (sides, groups)."""
        return _street_prior(groups.tobytes(), street)

    @property
    def weights(self) -> FloatArray:
        """The distribution, shape (states, ..., states, 2)."""
        every = [*(side.states for side in self.sides), np.array([1.0 - self.elsewhere, self.elsewhere])]
        return reduce(np.multiply.outer, every)

    @cached_property
    def joint(self) -> "JointBelief":
        """The belief without evidence; its marginals are computed once."""
        return JointBelief(self.weights)

    @property
    def by_part(self) -> FloatArray:
        """Joint of the hidden parts and of whether anything is in view, shape (parts, ..., parts, 2)."""
        return self.joint.by_part

    def carry(self, every: Sequence[FloatArray], street: StreetModel, step_ns: int) -> FloatArray:
        """Return some distributions one step later, in their order."""
        weights = np.array(every).transpose(*range(1, every[0].ndim + 1), 0)
        for chain in chains(self, street, step_ns):
            # Each product shifts the front axis to the end; afterwards the axes are in order, with `every` in
            # front.
            weights = weights.reshape(len(chain), -1).T @ chain
        return weights.reshape(-1, *every[0].shape)


@lru_cache
def chains(prior: StreetPrior, street: StreetModel, step_ns: int) -> list[FloatArray]:
    """Return the chain of each side, then that of vehicles from elsewhere; rows sum to one."""
    leaves = 1.0 / street.passage_s
    comes = leaves * prior.elsewhere / (1.0 - prior.elsewhere)
    elsewhere = np.array([[-comes, comes], [leaves, -leaves]])
    return [transitions(one, step_ns) for one in (*(_side_rates(k, street) for k in prior.sides), elsewhere)]


@lru_cache(maxsize=256)
def _street_prior(content: bytes, street: StreetModel) -> StreetPrior:
    groups = np.frombuffer(content).reshape(-1, len(GROUPS))
    seen = float((groups[:, _SEEN] / groups[:, BINS:].sum(axis=1)).mean())
    seen = min(max(seen, TINY), 1.0 - street.doubt)
    # The other vehicles in view come from elsewhere, whose share is above zero.
    most = 1.0 - (1.0 - (1.0 - street.doubt) * seen) ** (1.0 / len(groups))
    sides = tuple(SidePrior.of(one, most, street) for one in groups)
    return StreetPrior(sides, 1.0 - (1.0 - seen) / math.prod(1.0 - one.in_view for one in sides))


def _clear(sides: int) -> tuple[slice | int, ...]:
    """Return the index of the states with nothing in view, for shape (parts, 2, ..., parts, 2, 2)."""
    of_side: list[slice | int] = [slice(None), 0]
    return (*of_side * sides, 0)


def _by_part(weights: FloatArray) -> FloatArray:
    """Return the joint of the hidden parts and of "anything is in view", shape (parts, ..., parts, 2)."""
    sides = weights.ndim - 1
    split = weights.reshape(*[PARTS, 2] * sides, 2)
    by_part = np.empty((*[PARTS] * sides, 2))
    by_part[..., 0] = split[_clear(sides)]
    every = np.add.reduce(split, (*range(1, 2 * sides, 2), 2 * sides))
    np.maximum(every - by_part[..., 0], 0.0, out=by_part[..., 1])
    return by_part


def _spread(by_part: FloatArray) -> FloatArray:
    """Return one value per state, given one value per combination of parts; the reverse of `_by_part`.

    Along an axis of length one all parts have the same value.
    """
    sides = by_part.ndim - 1
    # In C order, like an array from a checkpoint: sums in another order differ in the last bit.
    every = np.empty((*[PARTS, 2] * sides, 2))
    every[:] = by_part[..., 1].reshape(*[one for n in by_part.shape[:-1] for one in (n, 1)], 1)
    every[_clear(sides)] = by_part[..., 0]
    return every.reshape(*[STATES] * sides, 2)


def usual_groups(hidden: Sequence[float], in_view: float) -> FloatArray:
    """Return the groups of a street, given only P(hidden) by side and P(in view), shape (sides, groups).

    A vehicle that comes is equally likely at any time within eight seconds.
    """
    groups = np.zeros((len(hidden), len(GROUPS)))
    for row, chance in zip(groups, hidden, strict=True):
        row[:BINS] = chance * np.diff((0.0, *COMING_S)) / COMING_S[-1]
        row[[_SEEN, _GROUP["none"]]] = (1.0 - chance) * np.array([in_view, 1.0 - in_view])
    return groups


def joint_reading(groups: FloatArray, usual_in_view: float, by_sound: float) -> FloatArray:
    r"""Return the joint of the parts from the readings of one or two sides, shape (parts, .., parts, 2).

    .. math:: P(\bar C_k, \bar C_j) = \tfrac{1}{2} \sum_k \big(1 - P(C_k) - q_k(other)\big)

    within the limits of the two chances. Given the sides from which vehicles come, the bins of the sides are
    independent, and each side keeps its marginal. If no vehicle comes, distant sound on several sides is one
    vehicle, and a vehicle in view accounts for all sound. If one comes, P(another one is in view) is a
    weighted mean: P(in view) by sound has the weight `by_sound`, the usual P(in view) the rest. It is at most
    the former, because a camera detection that contradicts the sound is no evidence for a hidden vehicle.
    With one side, "other" means a street without a vehicle.

    Shapes: groups (sides, groups).
    """
    coming, other = groups[:, :BINS], groups[:, _OTHER] * (len(groups) > 1)
    every = np.minimum(np.add.reduce(coming, 1), 1.0 - TINY)
    rest = np.maximum(np.add.reduce(groups[:, BINS:], 1) - other, TINY)
    distant = np.minimum(np.add.reduce(groups[:, _DISTANT], 1) / rest, 1.0)
    seen = min(float(mean(groups[:, _SEEN] / rest)), 1.0)
    behind = min((1.0 - by_sound) * usual_in_view + by_sound * seen, seen)
    # The hidden parts of every side, given whether a vehicle comes there.
    far_or_not = np.array([1.0 - distant, distant]).T
    parts = np.concatenate([far_or_not, coming / np.maximum(every, TINY)[:, None]], axis=1)
    comes = every.tolist()
    if len(groups) == 1:
        none, chances = 1.0 - comes[0], np.array([0.0, comes[0]])
    else:
        some = sum(comes)
        none = float(mean(1.0 - every - other))
        none = min(max(none, 1.0 - some, 0.0), 1.0 - max(comes))
        both = max(some - (1.0 - none), 0.0)
        chances = np.array([[0.0, comes[1] - both], [comes[0] - both, both]])
    beside = chances[_COMES_OF[len(groups)]] * reduce(np.multiply.outer, parts)
    joint = np.multiply.outer(beside, (1.0 - behind, behind))
    # If none comes, a vehicle in view accounts for all sound, with as few distant vehicles as possible.
    far = np.minimum(distant / max(1.0 - seen, TINY), 1.0).tolist()
    for heard in product((0, 1), repeat=len(groups)):
        on, off = [[one for one, is_far in zip(far, heard, strict=True) if is_far == k] for k in (1, 0)]
        joint[(*heard, 0)] = none * ((1.0 - seen) * max(min(on, default=1.0) - max(off, default=0.0), 0.0))
    joint[(*[NONE] * len(groups), 1)] = none * seen
    joint = np.maximum(joint, TINY)
    return _normed(joint)


def window_likelihoods(
    hidden: Sequence[float | None], visible: float, none: float, in_view: float
) -> FloatArray:
    r"""Return the likelihoods of a window for the parts, shape (parts, ..., parts, 2), up to a factor.

    .. math:: \ell(s) = \frac{1}{|C|} \sum_{k \in C} \ell_{hid,k}

    for the sides C from which a vehicle comes. Without such a side it is the likelihood of a vehicle in view,
    or of none: eq. (6) for explanations that do not exclude one another. Evidence against a vehicle in view
    also holds beside a hidden one, with an unchanged mean over the usual chance `in_view`. A side without a
    value (None) gets no evidence from the window.
    """
    known = [one is not None for one in hidden]
    nats = np.array([-math.inf if one is None else one for one in hidden])
    top = max(*nats.tolist(), visible, none)
    count = reduce(np.add.outer, np.outer(known, COMES).astype(float))
    mean = reduce(np.add.outer, np.outer(np.exp(nats - top), COMES)) / np.maximum(count, 1.0)
    clear, seen = math.exp(none - top), math.exp(visible - top)
    denied = min(seen / clear, 1.0) if clear > 0.0 else 1.0
    mean = mean / (1.0 - in_view + in_view * denied)
    found = np.where(count[..., None] > 0.0, np.multiply.outer(mean, (1.0, denied)), (clear, seen))
    return np.asarray(np.maximum(found, TINY))


@dataclass(frozen=True, slots=True, eq=False)
class SensorTrust:
    """Joint distribution of the street and "the sensor works", with the sensor's last look."""

    works: FloatArray  # P(state, it works), in the shape of the belief
    stamp_ns: int
    miss_rate: float
    # The first look of a run has full weight. The next looks repeat its misses and have less weight until
    # this is balanced.
    prepaid: float = 1.0
    begins: bool = True

    def next_weight(self, stamp_ns: int, street: StreetModel) -> tuple[float, float, bool]:
        """Return the weight of the sensor's next look, the rest that is prepaid, and whether a run begins.

        Looks one correlation time apart have weight one each; any number within one correlation time has
        weight one together. At a steady rate the weight is the interval over the correlation time, and the
        first look also represents an interval.
        """
        credit = seconds(stamp_ns - self.stamp_ns) / street.look_s
        if credit >= 1.0:
            return 1.0, 1.0, True
        credit *= 2.0 if self.begins else 1.0
        return max(credit - self.prepaid, 0.0), max(self.prepaid - credit, 0.0), False


# No slots: marginals are computed once and used by every entity and cue.
@dataclass(frozen=True, eq=False)
class JointBelief:
    """Belief over all sides, the belief from each source alone, and the trust in each sensor."""

    weights: FloatArray  # shape (states, ..., states, 2)
    # Belief from each source alone, in the same shape
    alone: dict[str, FloatArray] = field(default_factory=dict)
    trust: dict[str, SensorTrust] = field(default_factory=dict)  # Trust by sensor

    def carried(self, prior: StreetPrior, street: StreetModel, step_ns: int) -> "JointBelief":
        """Return the belief one time step later; sensors may fail or recover."""
        every = [self.weights, *self.alone.values(), *(one.works for one in self.trust.values())]
        weights, *rest = prior.carry(every, street, step_ns)
        alone, works = dict(zip(self.alone, rest, strict=False)), rest[len(self.alone) :]
        rate_hz = 1.0 / street.fails_s + 1.0 / street.recovers_s
        changed = -math.expm1(-rate_hz * seconds(step_ns)) * weights / (street.recovers_s * rate_hz)
        kept = math.exp(-rate_hz * seconds(step_ns))
        pairs = zip(self.trust.items(), works, strict=True)
        trust = {name: replaced(one, works=kept * now + changed) for (name, one), now in pairs}
        return JointBelief(weights, alone, trust)

    def times(self, evidence: FloatArray) -> "JointBelief":
        """Return the belief after evidence, given one likelihood per state."""
        weights = self.weights * evidence
        total = np.add.reduce(weights, None)
        trust = {name: replaced(one, works=one.works * evidence / total) for name, one in self.trust.items()}
        return JointBelief(weights / total, self.alone, trust)

    def read(
        self,
        source: str,
        reading: FloatArray,
        prior: StreetPrior,
        sides: Sequence[int],
        share: float = 1.0,
        heard: float = 1.0,
    ) -> "JointBelief":
        r"""Return the belief after a reading of some sides: the joint of their parts, (parts, ..., parts, 2).

        .. math:: e = (q' / \bar n)^a, \qquad
                  \frac{q'(r)}{\bar n(r)} \propto
                  s\, \frac{q(r)}{\bar n(r)} + (1 - s)\, \frac{q(0)}{\bar n(0)}

        with the new share a of a reading, and the chance s that the source detects a vehicle that comes
        (`heard`): a masked vehicle sounds as if it were absent. The parts in which none comes, 0, are added
        up and keep their ratio. The first reading of a source is entirely new.
        """
        before = self.alone.get(source)
        if before is None:
            before, share = prior.weights, 1.0
        others = tuple([k for k in range(self.sides) if k not in sides])
        expected = np.maximum(np.add.reduce(_by_part(before), others), TINY)
        ratio, none = reading / expected, (slice(FIRST_BIN),) * len(sides)
        if heard < 1.0:
            quiet = np.add.reduce(reading[none], None) / np.add.reduce(expected[none], None)
            mixed = heard * ratio + (1.0 - heard) * quiet
            mixed[none] = ratio[none]
            ratio = mixed / np.add.reduce(mixed * expected, None)
        for axis in others:
            ratio = np.expand_dims(ratio, axis)
        every = _spread(ratio**share)
        return replaced(self.times(every), alone=self.alone | {source: _normed(before * every)})

    def told(self, by_part: FloatArray) -> "JointBelief":
        """Return the belief after likelihoods of the parts, shape (parts, ..., parts, 2)."""
        return self.times(_spread(by_part))

    def at_prior(self, before: FloatArray, after: FloatArray) -> "JointBelief":
        """Return the belief with another prior; both priors have the shape of the belief."""
        factor = after / before
        alone = {name: _normed(one * factor) for name, one in self.alone.items()}
        return replaced(self.times(factor), alone=alone)

    def looked(
        self, sensor: str, answer: Absent | Present, stamp_ns: int, street: StreetModel
    ) -> "JointBelief":
        r"""Return the belief after a look of a sensor at everything in line of sight.

        .. math:: e(s) = w_v\, \ell_v^\kappa + (1 - w_v)\, \ell_0^\kappa

        with the probability w that the sensor works, the likelihoods for a working and a failed sensor, and
        the weight :math:`\kappa` of a look that repeats the misses of earlier ones.
        """
        miss, clutter = answer.miss_rate, answer.clutter_rate
        works, run = street.works * self.weights, (1.0, 1.0, True)
        if (last := self.trust.get(sensor)) is not None:
            works, run = last.works, last.next_weight(stamp_ns, street)
        # Likelihoods with something in view, with nothing in view, and for a failed sensor.
        told = np.array([miss * (1.0 - clutter), 1.0 - clutter, 1.0])
        if isinstance(answer, Present):
            told = np.array([1.0 - told[0], clutter, clutter])
        in_view, clear, failed = (np.maximum(told, TINY) ** run[0]).tolist()
        found = works * _spread(np.reshape([clear, in_view], (*[1] * self.sides, 2)))
        after = found + (self.weights - works) * failed
        others = replaced(self, trust={name: one for name, one in self.trust.items() if name != sensor})
        seen = others.times(after / np.maximum(self.weights, np.finfo(float).tiny))
        own = SensorTrust(found / after.sum(), stamp_ns, miss, *run[1:])
        return replaced(seen, trust={**seen.trust, sensor: own})

    def emerged(self, side: int, residual: float, apart: bool, street: StreetModel) -> "JointBelief":
        r"""Return the belief after a vehicle has come into view past the edge of a side.

        .. math:: p' = (1 - r)\, E[p\, e] + r\, p, \qquad e(b) = 1 \text{ if one comes, else } p_u

        with the chance r that it was another vehicle than the one believed there. E moves the believed
        vehicle into view, and adds another one behind it with the probability of a follower. It may have been
        believed on another side if the sound confused the two. If a vehicle was believed `apart` on another
        side, the marginal of that side stays, because two vehicles are not one vehicle of unknown side.
        """
        likelihood = np.where(COMES, 1.0, street.unheard)
        gaps = np.diff(np.minimum((0.0, *COMING_S), street.follows_s)) / street.follows_s
        behind = np.concatenate([[1.0 - street.follows], [0.0], street.follows * gaps])
        others = [k for k in range(self.sides) if k != side and not apart]
        if apart:
            likelihood = np.ones(PARTS)

        def came(weights: FloatArray) -> FloatArray:
            every = [(1.0 - street.side_confusion if others else 1.0) * weights]
            every += [street.side_confusion / len(others) * weights.swapaxes(side, k) for k in others]
            split = np.moveaxis(np.sum(every, axis=0), side, 0).reshape(PARTS, 2, -1)
            return np.asarray(likelihood @ split.sum(axis=1))

        total = float(came(self.weights).sum())

        def after(weights: FloatArray) -> FloatArray:
            front = np.moveaxis(weights, side, 0)
            mixed = residual * front.reshape(PARTS, 2, -1)
            mixed[:, 1] += (1.0 - residual) / total * behind[:, None] * came(weights)
            return np.ascontiguousarray(np.moveaxis(mixed.reshape(front.shape), 0, side))

        weights = after(self.weights)
        trust = {name: replaced(one, works=after(one.works)) for name, one in self.trust.items()}
        # The earlier sound came from the vehicle that is in view now.
        return JointBelief(weights, dict.fromkeys(self.alone, weights), trust)

    @property
    def sides(self) -> int:
        """Number of approach sides."""
        return self.weights.ndim - 1

    @cached_property
    def by_part(self) -> FloatArray:
        """Joint of the hidden parts and of whether anything is in view, shape (parts, ..., parts, 2)."""
        return _by_part(self.weights)

    @cached_property
    def hidden(self) -> FloatArray:
        """Marginals of the hidden parts, shape (sides, parts)."""
        every, sides = np.add.reduce(self.by_part, -1), range(self.sides)
        return np.array([np.add.reduce(every, tuple([j for j in sides if j != k])) for k in sides])

    @cached_property
    def emerged_from(self) -> FloatArray:
        """P(a vehicle from a side is in view, and none comes there), shape (sides,)."""
        axes = [tuple([j for j in range(self.sides + 1) if j != k]) for k in range(self.sides)]
        marginals = [np.add.reduce(self.weights, one) for one in axes]
        return np.array([np.add.reduce(one[1 : 2 * FIRST_BIN : 2]) for one in marginals])

    @property
    def in_view(self) -> float:
        """P(anything is in view)."""
        return min(float(np.add.reduce(self.by_part[..., 1], None)), 1.0)

    @cached_property
    def explanations(self) -> tuple[float, float, float]:
        """P(hidden), P(visible), P(none) of eq. (6): one hidden on any side, else one in view, else none."""
        visible = float(self.by_part[(*[NONE] * self.sides, 1)])
        none = float(self.by_part[(*[NONE] * self.sides, 0)])
        return max(1.0 - visible - none, 0.0), visible, none

    @cached_property
    def none_comes(self) -> float:
        """P(no vehicle comes into view from any side within eight seconds)."""
        return float(np.add.reduce(self.by_part[(slice(FIRST_BIN),) * self.sides], None))


def _normed(weights: FloatArray) -> FloatArray:
    return np.asarray(weights / np.add.reduce(weights, None))
