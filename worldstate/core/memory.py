"""What the filter carries from one call to the next."""

from dataclasses import dataclass, field

from worldstate.abduction.cueing.adaptive_threshold import AdaptiveThreshold
from worldstate.abduction.cueing.cueing_policy import CueingPolicy, SustainedRule
from worldstate.abduction.posterior import Posterior
from worldstate.belief.belief_lag import BeliefLag
from worldstate.belief.explanation import ExplanationBelief
from worldstate.belief.track import Track
from worldstate.state import Context, Priors


@dataclass(frozen=True, slots=True, eq=False)
class Memory:
    """All of it; the rest of a filter is configuration.

    Parameters
    ----------
    stamp_ns : int
        Time of the belief.
    explanation : ExplanationBelief
        Which explanation holds.
    trail : BeliefLag
        Its past of one window.
    rule : SustainedRule
        Run of the statistic above its threshold.
    births : tuple of int
        Hidden entities that each side has brought forth.
    handover_ns : tuple of int or None
        Last hand-over on each side.
    tracks : tuple of Track
        Entities.
    seq : int
        Measurements so far.
    sighted : int
        Entities that vision brought in by itself.
    last_ns : tuple of (str, int)
        Last time stamp of each source.
    predicted : Priors or None
        Explanation priors of the last update; None before the first.
    instant : Posterior or None
        Posterior of the last window alone, at the policy's reference prior; None before the first.
    threshold : AdaptiveThreshold
        How far the threshold has moved, where the policy lets it.
    """

    stamp_ns: int
    explanation: ExplanationBelief
    trail: BeliefLag
    rule: SustainedRule
    births: tuple[int, ...]
    handover_ns: tuple[int | None, ...]
    tracks: tuple[Track, ...] = ()
    seq: int = 0
    sighted: int = 0
    last_ns: tuple[tuple[str, int], ...] = ()
    predicted: Priors | None = None
    instant: Posterior | None = None
    threshold: AdaptiveThreshold = field(default_factory=AdaptiveThreshold)


def first_memory(context: Context, policy: CueingPolicy, start_ns: int) -> Memory:
    """Return the memory of a filter that has measured nothing."""
    directions, explanation = context.directions, _first_explanation(context)
    return Memory(
        stamp_ns=start_ns,
        explanation=explanation,
        trail=BeliefLag(((start_ns, explanation),)),
        rule=policy.rule(),
        births=(0,) * len(directions),
        handover_ns=(None,) * len(directions),
    )


def priors_of(explanation: ExplanationBelief) -> Priors:
    """Return the three explanations of the paper."""
    values = (explanation.hidden_total, explanation.visible, explanation.none)
    return Priors(*(min(value, 1.0) for value in values))


def _first_explanation(context: Context) -> ExplanationBelief:
    priors = context.priors
    if priors is None:
        return ExplanationBelief.settled(context.directions, context.rates.values_hz)
    return ExplanationBelief.from_priors(context.directions, priors.hidden, priors.visible, priors.none)
