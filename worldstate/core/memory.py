"""The state that the filter carries from one call to the next."""

from dataclasses import dataclass, field

from worldstate.abduction.co_evidence import CoEvidence, Unqueried
from worldstate.abduction.cueing.adaptive_threshold import AdaptiveThreshold
from worldstate.abduction.cueing.cueing_policy import CueingPolicy
from worldstate.abduction.posterior import Posterior
from worldstate.abduction.signature.domain_guard import DomainVerdict
from worldstate.belief.belief_lag import BeliefLag
from worldstate.belief.ego_motion import EgoBelief
from worldstate.belief.explanation import ExplanationBelief
from worldstate.belief.hidden_belief import HiddenBelief
from worldstate.belief.track import Track
from worldstate.ground.serialisation import ADDED, Count
from worldstate.ground.values import NotUsable
from worldstate.measurement.measurement import Bearing
from worldstate.state import Context, Event, Priors, Relation

from .sequence_memory import SequenceMemory


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


@dataclass(frozen=True, slots=True, eq=False)
class Memory:
    """State of a filter; everything else in it is configuration."""

    stamp_ns: int  # Time of the belief
    explanation: ExplanationBelief  # Which explanation holds
    lag: BeliefLag  # Its past of one window
    rules: tuple[SourceRule, ...]  # One of every source, sorted by its name
    births: tuple[int, ...]  # Hidden entities born so far on each side
    handover_ns: tuple[int | None, ...]  # Last hand-over on each side
    tracks: tuple[Track, ...] = ()  # Entities
    seq: int = 0  # Measurements so far
    sighted: int = 0  # Entities born in view so far
    last_ns: tuple[tuple[str, int], ...] = ()  # Last time stamp of each source
    looks: tuple[CountedLook, ...] = ()  # Last look of every sensor, sorted by its name
    predicted: Priors | None = None  # Explanation priors of the last update; None before the first
    # Posterior of the last window alone, at the policy's reference prior; None before the first.
    instant: Posterior | None = None
    heard_nats: float = 0.0  # Log-odds of hidden in it by sound alone
    # How far the threshold has moved, where the policy lets it.
    threshold: AdaptiveThreshold = field(default_factory=AdaptiveThreshold)
    bearing: Bearing | None = None  # Of the last measurement
    domain: DomainVerdict | None = None  # Of the last measurement
    sequence: SequenceMemory | None = None  # Who comes into view and when; None without such a model
    no_sequence: NotUsable | None = None  # Why the last one that should have said so could not
    advised_ns: tuple[int | None, ...] = ()  # Since when an advisory has been out on each side
    events: tuple[Event, ...] = ()  # Of the last measurement
    ego: EgoBelief | None = None  # By odometry; None without
    relations: tuple[Relation, ...] = ()  # Then, with the intervals in which they have held

    @property
    def sides(self) -> HiddenBelief:
        """What is believed of hidden vehicles: by the sequence where one is read, or the explanations."""
        return sides_of(self.explanation, self.sequence)


def sides_of(explanation: ExplanationBelief, sequence: SequenceMemory | None) -> HiddenBelief:
    """Return the sides as a sequence has them; without one, as explanations that exclude each other."""
    return HiddenBelief.of_explanation(explanation) if sequence is None else sequence.hidden


def first_memory(context: Context, policy: CueingPolicy, start_ns: int) -> Memory:
    """Return the memory of a filter that has measured nothing."""
    directions, explanation = context.directions, _first_explanation(context)
    return Memory(
        stamp_ns=start_ns,
        explanation=explanation,
        lag=BeliefLag(((start_ns, explanation),)),
        rules=(),
        births=(0,) * len(directions),
        handover_ns=(None,) * len(directions),
        advised_ns=(None,) * len(directions),
    )


def priors_of(explanation: ExplanationBelief) -> Priors:
    """Return the probabilities of the three explanations of eq. (6)."""
    # A sum of exponentials may exceed one by rounding, which readers of a snapshot refuse.
    values = (explanation.hidden_total, explanation.visible, explanation.none)
    return Priors(*(min(value, 1.0) for value in values))


def _first_explanation(context: Context) -> ExplanationBelief:
    priors = context.priors
    if priors is None:
        # Without priors the filter starts as if it had waited for ever: neither alarmed nor sure of an empty
        # street.
        return ExplanationBelief.settled(context.directions, context.rates.values_hz)
    return ExplanationBelief.from_priors(context.directions, priors.hidden, priors.visible, priors.none)
