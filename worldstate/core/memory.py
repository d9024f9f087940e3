"""The state that the filter carries from one call to the next."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated, TypeAlias

import numpy as np

from worldstate.abduction.co_evidence import CoEvidence, Unqueried
from worldstate.abduction.cueing.cueing_policy import AdaptiveThreshold
from worldstate.abduction.posterior import Posterior
from worldstate.abduction.signature.domain_guard import DomainVerdict
from worldstate.belief.explanation import AsLogs, BeliefLag, ExplanationBelief, HiddenBelief
from worldstate.belief.kinematics.cartesian import EgoBelief
from worldstate.belief.track import Track
from worldstate.ground.serialisation import ADDED, Count, Keys, written_as
from worldstate.ground.values import NotUsable, nanoseconds
from worldstate.measurement.measurement import Bearing
from worldstate.state import Context, Event, Priors, Relation

from .sequence_memory import SequenceMemory

# An advisory lives in time: without news it ends, as that of a sequence does, after a second.
NEWS_HOLDS_NS = nanoseconds(1.0)
# Names come and go; without this, a checkpoint holds every one that was ever told.
FORGOTTEN_NS = nanoseconds(3600.0)
StampNs: TypeAlias = Annotated[int | None, Keys("stamp_ns")]


@dataclass(frozen=True, slots=True)
class SourceRule:
    """Run of a source's statistic above the threshold: what another one measures does not end it."""

    source: str
    run: Count  # Hops in a row, counted up to those that the rule asks for
    alarm: bool
    stamp_ns: int  # Of its last measurement
    fault: str | None = None  # What was wrong with it then
    announced: tuple[Count, ...] = ()  # Sides on which its messages announce vehicles; empty of what hears


@dataclass(frozen=True, slots=True)
class CountedLook:
    """The last look of a sensor, what it said, and the source whose measurement carried it first."""

    sensor: str
    stamp_ns: int
    source: str
    answer: CoEvidence = field(default=Unqueried("messages search nothing"), metadata=ADDED)
    sector_rad: tuple[float, float] | None = None  # Where it searched; None for the view of the context


@dataclass(frozen=True, slots=True)
class Instant:
    """Posterior of one window alone, at the policy's reference prior; JSON knows no infinity."""

    # (hidden_1 .. hidden_K, visible, none), null for what is impossible.
    log_probabilities: tuple[Annotated[float | None, Keys("nats")], ...]
    log_lambda: float | None  # None for a ratio without bound
    log_evidence: float

    @classmethod
    def of(cls, posterior: Posterior) -> "Instant":
        """Return what is kept of a posterior."""
        *logs, ratio = map(_finite, (*posterior.log_probabilities, posterior.log_lambda))
        return cls(tuple(logs), ratio, posterior.log_evidence)

    @property
    def hidden_total(self) -> float:
        """P(hidden), all directions together, at most one."""
        logs = [-math.inf if nats is None else nats for nats in self.log_probabilities]
        return min(float(np.exp(logs)[:-2].sum()), 1.0)


def _finite(nats: float) -> float | None:
    return nats if math.isfinite(nats) else None


@dataclass(frozen=True, slots=True, eq=False)
class Memory:
    """State of a filter, as checkpoints hold it; everything else in a filter is configuration."""

    stamp_ns: int  # Time of the belief
    explanation: AsLogs = field(metadata=written_as("log_explanations"))  # Which explanation holds
    lag: BeliefLag = field(metadata=written_as("trail"))  # Its past of one window
    births: tuple[Count, ...]  # Hidden entities born so far on each side
    handover_ns: tuple[StampNs, ...]  # Last hand-over on each side
    tracks: tuple[Track, ...] = ()  # Entities
    seq: Count = 0  # Measurements so far
    sighted: Count = 0  # Entities born in view so far
    # Last time stamp of each source.
    last_ns: tuple[Annotated[tuple[str, int], Keys("source", "stamp_ns")], ...] = field(
        default=(), metadata=written_as("last")
    )
    predicted: Priors | None = None  # Explanation priors of the last update; None before the first
    instant: Instant | None = None  # Of the last window; None before the first
    # How far the threshold has moved, where the policy lets it.
    threshold: AdaptiveThreshold = field(default_factory=AdaptiveThreshold, metadata=ADDED)
    # One of every source, sorted by its name.
    rules: tuple[SourceRule, ...] = field(default=(), metadata=ADDED)
    # Last look of every sensor, sorted by its name.
    looks: tuple[CountedLook, ...] = field(default=(), metadata=ADDED)
    bearing: Bearing | None = field(default=None, metadata=ADDED)  # Of the last measurement
    domain: DomainVerdict | None = field(default=None, metadata=ADDED)  # Of the last measurement
    # Vehicles that come into view, and when; None without such a model, and why the last one did not say it.
    sequence: SequenceMemory | None = field(default=None, metadata=ADDED)
    no_sequence: NotUsable | None = field(default=None, metadata=ADDED)
    heard_nats: float = field(default=0.0, metadata=ADDED)  # Log-odds of hidden in `instant` by sound alone
    # Since when an advisory has been out on each side.
    advised_ns: tuple[StampNs, ...] = field(default=(), metadata=ADDED)
    events: tuple[Event, ...] = field(default=(), metadata=ADDED)  # Of the last measurement
    # Then, with the intervals in which they have held.
    relations: tuple[Relation, ...] = field(default=(), metadata=ADDED)
    tracks_left_out: Count = field(default=0, metadata=ADDED)  # So far, each beyond the most that are kept
    ego: EgoBelief | None = field(default=None, metadata=ADDED)  # By odometry; None without

    def __post_init__(self) -> None:
        if not self.advised_ns:
            object.__setattr__(self, "advised_ns", (None,) * len(self.births))

    @property
    def sides(self) -> HiddenBelief:
        """Hidden vehicles as a sequence has them; without one, as explanations that exclude each other."""
        if self.sequence is not None:
            return self.sequence.hidden
        return HiddenBelief(self.explanation.hidden, self.explanation.emerged)

    def explained(self, change: Callable[[ExplanationBelief], ExplanationBelief]) -> "Memory":
        """Return the memory with a function applied to the explanations, now and within the lag.

        The lagged beliefs are what the next windows build on: they have to know of a hand-over, too.
        """
        return replace(self, explanation=change(self.explanation), lag=self.lag.map(change))


def first_memory(context: Context, start_ns: int) -> Memory:
    """Return the memory of a filter that has measured nothing."""
    k, priors = len(context.directions), context.priors
    # Without priors the filter starts as if it had waited for ever: neither alarmed nor sure of an empty
    # street.
    if priors is None:
        explanation = ExplanationBelief.settled(k, context.rates.values_hz)
    else:
        explanation = ExplanationBelief.from_priors(k, priors.hidden, priors.visible, priors.none)
    return Memory(
        stamp_ns=start_ns,
        explanation=explanation,
        lag=BeliefLag(((start_ns, explanation),)),
        births=(0,) * k,
        handover_ns=(None,) * k,
    )


def without_forgotten(memory: Memory) -> Memory:
    """Return the memory without sources and sensors that have been unheard for an hour."""
    since_ns = memory.stamp_ns - FORGOTTEN_NS
    stamps_ns = [one.stamp_ns for one in memory.rules] + [one.stamp_ns for one in memory.looks]
    if min(stamps_ns, default=since_ns) >= since_ns:  # Nearly always: what else is kept has their names
        return memory
    return replace(
        memory,
        rules=tuple(one for one in memory.rules if one.stamp_ns >= since_ns),
        looks=tuple(one for one in memory.looks if one.stamp_ns >= since_ns),
        last_ns=tuple(one for one in memory.last_ns if one[1] >= since_ns),
        lag=replace(memory.lag, heard=tuple(one for one in memory.lag.heard if one.stamp_ns >= since_ns)),
    )


def priors_of(explanation: ExplanationBelief) -> Priors:
    """Return the probabilities of the three explanations of eq. (6)."""
    # A sum of exponentials may exceed one by rounding, which readers of a snapshot refuse.
    values = (explanation.hidden_total, explanation.visible, explanation.none)
    return Priors(*(min(value, 1.0) for value in values))
