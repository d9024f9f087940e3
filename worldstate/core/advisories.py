"""Advisories: the sustained rule of every source, the alarm of a sequence, and until when each is held."""

import math
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from worldstate.abduction.co_evidence import CoEvidence, Unqueried
from worldstate.abduction.cueing.cueing_policy import CueingPolicy
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.abduction.posterior import posterior_of
from worldstate.abduction.sequence.sequence_reader import TOO_FEW
from worldstate.abduction.signature.domain_guard import Foreign
from worldstate.belief.side_belief import SideBelief
from worldstate.ground.values import seconds
from worldstate.measurement import Measurement

from .memory import NEWS_HOLDS_NS, Instant, Memory, SourceRule
from .sequence_memory import LEAST_RISK
from .site_model import FilterModel, published_belief

# Relative: rounding must not choose a side, or the mirrored world would have the other one.
_TIE = 1e-9
_MOST_CERTAIN = 0.999  # Of a message
NO_LOOK = Unqueried("sound alone")


@dataclass(frozen=True, slots=True)
class SideAdvisory:
    """The advisory of a side: until when it stands without news, and whether it is only held."""

    ends_ns: int
    held: bool = False  # Below its threshold by now
    announced: bool = False  # By messages, not by what is heard


def claimed_nats(probability: float) -> float:
    """Return the log-odds that a message claims for a hidden entity of such existence."""
    # At even odds and below a message claims nothing, as the prior of the rule.
    known = min(max(probability, 0.5), _MOST_CERTAIN)
    return math.log(known / (1.0 - known))


def update_advisories(memory: Memory, measurement: Measurement, model: FilterModel) -> None:
    """Update the sustained rule of a source with this window's statistic."""
    source, stamp_ns, heard = measurement.source, measurement.stamp_ns, measurement.heard
    before_ns = max((one.stamp_ns for one in memory.rules.values()), default=stamp_ns)
    domain = measurement.domain
    fault = measurement.fault or (domain.reason if isinstance(domain, Foreign) else None)
    last = memory.rules.get(source)
    since_ns = last.heard_ns if last is not None and last.heard.reason == heard.reason else stamp_ns
    rule = SourceRule(stamp_ns, fault=fault, heard=heard, heard_ns=since_ns)
    if not heard.usable and memory.last.instant is not None:
        # What could not be heard neither raises an alarm nor ends one: silence does, after a second.
        memory.rules[source] = replace(rule, statistic=() if last is None else last.statistic)
        return
    update_rule(memory, source, rule, measurement.signature, measurement.co_evidence, model)
    if model.policy.adaptive is not None:
        _, visible, none = memory.sides.hypotheses
        memory.threshold = memory.threshold.advance(
            model.policy.adaptive,
            visible=visible,
            none=none,
            alarm=_rule_ends_ns(memory, model.policy) is not None,
            elapsed_s=max(seconds(stamp_ns - before_ns), 0.0),
        )


def update_rule(
    memory: Memory,
    source: str,
    rule: SourceRule,
    said: SignatureEvidence,
    answer: CoEvidence,
    model: FilterModel,
) -> None:
    """Update the sustained rule of a source with what it says."""
    # At the policy's own prior, without memory: the statistic that the threshold was calibrated on.
    log_prior = np.log(model.policy.reference_prior)
    posterior = posterior_of(log_prior, said, answer)
    heard = posterior if isinstance(answer, Unqueried) else posterior_of(log_prior, said, NO_LOOK)
    ratio = posterior.log_lambda
    statistic, bounded = min(posterior.hidden_total, 1.0), ratio if math.isfinite(ratio) else None
    memory.last.instant = Instant(statistic, bounded, heard.log_lambda)
    last = memory.rules.get(source)
    every = (statistic,) if last is None else (*last.statistic, statistic)
    memory.rules[source] = replace(rule, statistic=every[-model.policy.sustain_hops :])


def advisories(memory: Memory, model: FilterModel) -> tuple[SideAdvisory | None, ...]:
    """Return the advisory of each side, None where there is none.

    The rule names the likeliest side, or all in a tie; the alarm of a sequence model and messages name each
    side by itself. None stands beside a risk below .1.
    """
    every = raised_advisories(memory, model)
    return standing(every, published_belief(memory, model)) if any(every) else every


def standing(raised: tuple[SideAdvisory | None, ...], sides: SideBelief) -> tuple[SideAdvisory | None, ...]:
    """Return the advisories that no risk denies."""
    return tuple(one if risk >= LEAST_RISK else None for one, risk in zip(raised, sides.risks, strict=True))


def raised_advisories(memory: Memory, model: FilterModel) -> tuple[SideAdvisory | None, ...]:
    """Return the advisory of each side at any risk: that by messages where what is heard raises none."""
    ends_ns = (_rule_ends_ns(memory, model.policy, k) for k in range(len(memory.history)))
    told = (None if end_ns is None else SideAdvisory(end_ns, announced=True) for end_ns in ends_ns)
    pairs = zip(_heard_advisories(memory, model), told, strict=True)
    return tuple(min(filter(None, pair), key=attrgetter("held"), default=None) for pair in pairs)


def _heard_advisories(memory: Memory, model: FilterModel) -> tuple[SideAdvisory | None, ...]:
    """Return the advisory of each side by what is heard and seen.

    None before the first sequence: the first second of single windows was counted in no budget.
    """
    sequence, hidden = memory.sequence, memory.sides.hidden
    if memory.last.no_sequence == TOO_FEW:
        return (None,) * len(hidden)
    if sequence is not None and sequence.alarm is not None:
        ends_ns = sequence.alarm_ends_ns(memory.stamp_ns)
        threshold, pairs = sequence.alarm.threshold_nats, zip(ends_ns, sequence.decided, strict=True)
        return tuple(
            None if end_ns is None else SideAdvisory(end_ns, decided < threshold) for end_ns, decided in pairs
        )
    rule, least = _rule_ends_ns(memory, model.policy), max(hidden) * (1.0 - _TIE)
    named = None if rule is None else SideAdvisory(rule)
    return tuple(named if p >= least else None for p in hidden)


def decided_log_odds(memory: Memory, policy: CueingPolicy) -> float:
    """Return the largest sustained statistic of the sources that hear and are not silent, log-odds."""
    heard = (one for one in memory.rules.values() if not one.announced)
    fresh = (one for one in heard if one.stamp_ns + NEWS_HOLDS_NS >= memory.stamp_ns)
    return bounded_log_odds(max((one.sustained(policy.sustain_hops) for one in fresh), default=0.0))


def why_none(memory: Memory, model: FilterModel, side: int, sides: SideBelief) -> str | None:
    """Return why a side of high risk has no advisory; None where its risk is below .7."""
    if sides.risks[side] <= _HIGH_RISK:
        return None
    sequence = memory.sequence
    if memory.last.no_sequence == TOO_FEW:
        return "less than a second of sound: no alarm is raised yet"
    if sequence is None or sequence.alarm is None:
        return f"the statistic has not stayed above its threshold for {model.policy.sustain_hops} hops"
    log_odds = list(sequence.log_odds(model.context).values())
    learned, threshold = sequence.learned_nats(model.context)[side], sequence.alarm.threshold_nats
    if log_odds[-1][side] < threshold <= log_odds[-1][side] + learned:
        return "only by the traffic learned here, which is left out of the alarm"
    if log_odds[-1][side] < log_odds[-1].max():
        return "one vehicle is likelier than two, and likelier on the other side"
    return "it is not sure to come within three seconds, or not for long enough"


_HIGH_RISK = 0.7
# Certainty has no end; e^-20 is once in fifteen years of hops.
MOST_NATS = 20.0


def bounded_log_odds(probability: float) -> float:
    """Return log-odds within what a snapshot states."""
    least = math.exp(-MOST_NATS)
    inside = min(max(probability, least), 1.0 - least)
    return math.log(inside) - math.log1p(-inside)


def _rule_ends_ns(memory: Memory, policy: CueingPolicy, announced: int | None = None) -> int | None:
    """Return when the last rule in alarm ends, of those that hear or of those that announce for a side.

    That of a source that is silent for a second has ended.
    """
    gamma, hops = policy.gamma_at(memory.threshold.shift_nats), policy.sustain_hops
    # A rule that announces no vehicle hears, which is asked for with None.
    rules = (one for one in memory.rules.values() if announced in (one.announced or (None,)))
    alarmed = (one for one in rules if len(one.statistic) >= hops and one.sustained(hops) >= gamma)
    # What cannot be heard is no news.
    news_ns = (one.stamp_ns if one.heard.usable else one.heard_ns for one in alarmed)
    ends_ns = (ns + NEWS_HOLDS_NS for ns in news_ns)
    return max((end_ns for end_ns in ends_ns if end_ns >= memory.stamp_ns), default=None)
