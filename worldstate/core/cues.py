"""Advisories and cues: the sustained rule of every source, the alarm of a sequence, and what is published.

An advisory stands by the rule, by the alarm or by messages, and by the risk beside it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from worldstate.abduction.co_evidence import CoEvidence, Unqueried
from worldstate.abduction.cueing.cueing_policy import CueingPolicy
from worldstate.abduction.evidence import SignatureEvidence, posterior_of
from worldstate.abduction.road_users import Foreign
from worldstate.abduction.sequence.sequence_model import HORIZONS_S, STATED
from worldstate.abduction.sequence.sequence_reader import TOO_FEW
from worldstate.belief.hidden_bearing import announced, time_to_visible
from worldstate.belief.side_belief import TIE, SideBelief
from worldstate.ground.values import seconds
from worldstate.measurement import Measurement
from worldstate.state import Advisory, EvidenceTerms, Held, Priors, RiskCue, SensorHealth

from .birth_death import hidden_on
from .memory import NEWS_HOLDS_NS, Instant, Memory, SourceRule
from .sequence_memory import LEAST_RISK, SequenceMemory
from .side_update import heard_beside
from .site_model import FilterModel, published_belief
from .snapshot_builder import hidden_azimuth, sector, time_to_arrival

_MOST_CERTAIN = 0.999  # Of a message
NO_LOOK = Unqueried("sound alone")
_HIGH_RISK = 0.7
# Certainty has no end; e^-20 is once in fifteen years of hops.
MOST_NATS = 20.0


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
    source, stamp_ns, heard = measurement.source, measurement.stamp_ns, heard_beside(memory, measurement)
    before_ns = max((one.stamp_ns for one in memory.rules.values()), default=stamp_ns)
    domain = measurement.domain
    fault = measurement.fault or (domain.reason if isinstance(domain, Foreign) else None)
    last = memory.rules.get(source)
    since_ns = last.heard_ns if last is not None and last.heard.reason == heard.reason else stamp_ns
    rule = SourceRule(stamp_ns, fault=fault, heard=heard, heard_ns=since_ns)
    if not measurement.heard.usable and memory.last.instant is not None:
        # What could not be heard neither raises an alarm nor ends one: silence does, after a second.
        is_news = last is not None and _news_ends_ns(last) >= stamp_ns
        memory.rules[source] = replace(
            rule, statistic=last.statistic if last and is_news else (), hop_ns=stamp_ns
        )
        return
    update_rule(memory, source, rule, measurement.signature, measurement.co_evidence, model)
    if model.policy.adaptive is not None:
        _, visible, none = memory.sides.hypotheses
        memory.threshold = memory.threshold.advance(
            model.policy.adaptive,
            visible=visible,
            none=none,
            alarm=any(not sides for sides, _ in _alarms(memory, model.policy)),
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
    log_prior = tuple(map(math.log, model.policy.reference_prior))
    posterior = posterior_of(log_prior, said, answer)
    ratio, heard_nats = posterior.log_lambda, posterior_of(log_prior, said, NO_LOOK).log_lambda
    statistic, bounded = min(posterior.hidden_total, 1.0), ratio if math.isfinite(ratio) else None
    memory.last.instant = Instant(statistic, bounded, heard_nats)
    memory.rules[source] = rule.after(memory.rules.get(source), statistic, model.policy.sustain_hops)


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
    alarms = _alarms(memory, model.policy)
    raised = list(_heard_advisories(memory, [end_ns for sides, end_ns in alarms if not sides]))
    for k, end_ns in ((k, end_ns) for sides, end_ns in alarms for k in sides):
        heard = raised[k]
        if heard is None or heard.held or (heard.announced and heard.ends_ns < end_ns):
            raised[k] = SideAdvisory(end_ns, announced=True)
    return tuple(raised)


def _heard_advisories(memory: Memory, rule_ends_ns: Sequence[int]) -> tuple[SideAdvisory | None, ...]:
    """Return the advisory of each side by what is heard and seen; `rule_ends_ns` of the rules in alarm.

    None before the first sequence: the first second of single windows was counted in no budget.
    """
    sequence, hidden = memory.sequence, memory.sides.hidden
    if memory.last.no_sequence == TOO_FEW:
        return (None,) * len(hidden)
    if sequence is not None and sequence.alarm is not None:
        ends_ns = sequence.alarm_ends_ns(memory.stamp_ns)
        decided_nats = sequence.decided_at(memory.stamp_ns)
        threshold, pairs = sequence.threshold_nats, zip(ends_ns, decided_nats, strict=True)
        return tuple(
            None if end_ns is None else SideAdvisory(end_ns, decided < threshold) for end_ns, decided in pairs
        )
    least = max(hidden) * (1.0 - TIE)
    return tuple(SideAdvisory(max(rule_ends_ns)) if rule_ends_ns and p >= least else None for p in hidden)


def decided_log_odds(memory: Memory, policy: CueingPolicy, announced: int | None = None) -> float:
    """Return the largest sustained statistic of what hears, or announces for a side, and is not silent."""
    heard = (one for one in memory.rules.values() if announced in (one.announced or (None,)))
    fresh = (one for one in heard if _news_ends_ns(one) >= memory.stamp_ns)
    return bounded_log_odds(max((one.sustained(policy.sustain_hops) for one in fresh), default=0.0))


def why_none(memory: Memory, model: FilterModel, side: int, sides: SideBelief) -> str | None:
    """Return why a side of high risk has no advisory; None where its risk is below .7."""
    if sides.risks[side] <= _HIGH_RISK:
        return None
    sequence, silent = memory.sequence, "nothing was measured for a second"
    if memory.last.no_sequence == TOO_FEW:
        return "less than a second of sound: no alarm is raised yet"
    if sequence is None or sequence.alarm is None:
        if all(_news_ends_ns(one) < memory.stamp_ns for one in memory.rules.values()):
            return silent
        return f"the statistic has not stayed above its threshold for {model.policy.sustain_hops} hops"
    if not sequence.has_news(memory.stamp_ns):
        return silent
    log_odds = list(sequence.log_odds(model.context).values())
    learned, threshold = sequence.read_nats(model.context)[side], sequence.threshold_nats
    if log_odds[-1][side] < threshold <= log_odds[-1][side] + learned:
        return "only by the traffic learned here, which is left out of the alarm"
    if log_odds[-1][side] < log_odds[-1].max():
        return "one vehicle is likelier than two, and likelier on the other side"
    return "it is not sure to come within three seconds, or not for long enough"


def bounded_log_odds(probability: float) -> float:
    """Return log-odds within what a snapshot states."""
    least = math.exp(-MOST_NATS)
    inside = min(max(probability, least), 1.0 - least)
    return math.log(inside) - math.log1p(-inside)


def _alarms(memory: Memory, policy: CueingPolicy) -> list[tuple[tuple[int, ...], int]]:
    """Return of every rule in alarm the sides that it announces, none of one that hears, and when it ends.

    That of a source that is silent for a second has ended.
    """
    gamma, hops = policy.gamma_at(memory.threshold.shift_nats), policy.sustain_hops
    alarms = []
    for one in memory.rules.values():
        end_ns, is_over = _news_ends_ns(one), len(one.statistic) >= hops and one.sustained(hops) >= gamma
        if is_over and end_ns >= memory.stamp_ns:
            alarms.append((one.announced, end_ns))
    return alarms


def _news_ends_ns(rule: SourceRule) -> int:
    """Return when what a source said last has ended: what cannot be heard is no news."""
    return (rule.stamp_ns if rule.heard.usable else rule.heard_ns) + NEWS_HOLDS_NS


_Times = tuple[dict[str, float] | None, tuple[float, float, float] | None]


def cues_of(memory: Memory, model: FilterModel, sensors: tuple[SensorHealth, ...]) -> tuple[RiskCue, ...]:
    """Return one risk cue per side, none before the first measurement."""
    if memory.last.instant is None:
        return ()
    sides, raised = published_belief(memory, model), raised_advisories(memory, model)
    told, evidence = standing(raised, sides), _evidence(memory, model, raised)
    # All sides together: what is taken out of arrays once.
    times = _times(memory.sequence, [one is not None for one in told])
    rested_on = tuple(one for one in sensors if one.condition != "silent")
    build = partial(_cue, memory, memory.last.instant, model, sides, rested_on)
    return tuple(map(build, range(len(told)), told, times, evidence))


def _cue(
    memory: Memory,
    instant: Instant,
    model: FilterModel,
    sides: SideBelief,
    sensors: tuple[SensorHealth, ...],
    k: int,
    told: SideAdvisory | None,
    times: _Times,
    evidence: EvidenceTerms,
) -> RiskCue:
    row = hidden_on(memory.tracks, k)
    track = None if row is None else memory.tracks.row(row)
    azimuth_rad, std_rad, source = hidden_azimuth(k, track, memory.sequence, model.site)
    within, interval_s = times
    arrival_s = None
    if track is not None and track.approach_heard:
        arrival_s = time_to_arrival(track.motion.inverse_tta_hz, track.motion.inverse_tta_std_hz)
    # Distance and speed of an announced vehicle tell more than the sound.
    if track is not None and track.place is not None:
        interval_s = time_to_visible(track.place, model.site.sides[track.side], model.site)[1] or interval_s
    since_ns, entity_id = memory.history[k].advised_ns, None if track is None else track.id
    advisory = held = None
    if told is not None:
        advisory = Advisory(memory.stamp_ns if since_ns is None else since_ns, told.ends_ns, sensors)
        held = Held(entity_id, told.ends_ns) if told.held else None
    return RiskCue(
        direction=model.site.sides[k].label,
        statistic=instant.statistic,
        log_lambda=instant.log_lambda,
        hypotheses=Priors(*sides.hypotheses),
        azimuth_rad=azimuth_rad,
        azimuth_std_rad=std_rad,
        azimuth_source=source,
        risk=sides.risks[k],
        confidence=sides.risks[k] / max(sum(sides.risks), 1e-300),
        advisory=advisory,
        alpha=model.policy.alpha or None if evidence.hypothesis == "hidden" else None,
        entity_id=entity_id,
        horizon_s=arrival_s if interval_s is None else interval_s[1],
        within=within,
        time_to_visible_s=interval_s,
        sector_rad=sector(azimuth_rad, std_rad),
        evidence=evidence,
        held=held,
        not_advised=None if told is not None else why_none(memory, model, k, sides),
    )


def _times(kept: SequenceMemory | None, advised: list[bool]) -> list[_Times]:
    """Return the probabilities of coming into view, and the time to it where a vehicle is expected."""
    if kept is None:
        return [(None, None)] * len(advised)
    posterior = kept.posterior
    within = posterior.within()[0].tolist()
    soon = posterior.groups[0, :, :STATED].sum(axis=1).tolist()
    # The times are those of a vehicle that comes: in an empty street they would say nothing.
    stated = [chance > (0.0 if told else 0.5) for told, chance in zip(advised, soon, strict=True)]
    intervals_s = posterior.time_to_visible_s()[0].tolist() if any(stated) else within
    names = [f"{end_s:g}" for end_s in HORIZONS_S]
    return [
        (dict(zip(names, chances, strict=True)), (row[0], row[1], row[2]) if told else None)
        for chances, row, told in zip(within, intervals_s, stated, strict=True)
    ]


def _evidence(
    memory: Memory, model: FilterModel, raised: tuple[SideAdvisory | None, ...]
) -> list[EvidenceTerms]:
    """Return what raises the advisory of each side: the sound, or messages where they alone do."""
    heard = _heard(memory, model)
    by_message = [one is not None and one.announced for one in raised]
    if not any(by_message):
        return heard
    return [_announced(memory, model, k) if by_message[k] else own for k, own in enumerate(heard)]


def _heard(memory: Memory, model: FilterModel) -> list[EvidenceTerms]:
    r"""Return for each side what the alarm of a sequence goes by, or the rule of all sides together.

    With L the log-odds of a sequence after the prior, what was heard, and every look,

    .. math:: t_j = L_j - L_{j-1}
    """
    kept, instant = memory.sequence, memory.last.instant
    assert instant is not None
    if kept is not None and kept.alarm is not None:
        after, threshold = kept.log_odds(model.context), kept.threshold_nats
        terms = np.diff(list(after.values()), axis=0, prepend=0.0).T.tolist()
        return [
            EvidenceTerms("coming", dict(zip(after, own, strict=True)), decides, threshold)
            for own, decides in zip(terms, kept.decided_at(memory.stamp_ns), strict=True)
        ]
    prior, threshold = _rule_log_odds(memory, model)
    looked_nats = math.inf if instant.log_lambda is None else instant.log_lambda
    heard, looked = (min(max(one, -MOST_NATS), MOST_NATS) for one in (instant.heard_nats, looked_nats))
    terms_nats = {"prior": prior, "window": heard, "look": looked - heard}
    told = EvidenceTerms("hidden", terms_nats, decided_log_odds(memory, model.policy), threshold)
    return [told] * len(model.site.sides)


def _announced(memory: Memory, model: FilterModel, side: int) -> EvidenceTerms:
    """Return what the rule of the messages that announce a side goes by, all sides together."""
    weights = model.policy.reference_prior[:-2]
    chances = announced(memory.tracks, model.site)
    odds = sum(w * math.exp(claimed_nats(p)) for w, p in zip(weights, chances, strict=True)) / sum(weights)
    prior, threshold = _rule_log_odds(memory, model)
    nats = math.log(odds)
    decided = decided_log_odds(memory, model.policy, side)
    return EvidenceTerms("announced", {"prior": prior, "messages": nats}, decided, threshold)


def _rule_log_odds(memory: Memory, model: FilterModel) -> tuple[float, float]:
    """Return the log-odds of the rule's prior and of its threshold."""
    gamma = model.policy.gamma_at(memory.threshold.shift_nats)
    return bounded_log_odds(sum(model.policy.reference_prior[:-2])), bounded_log_odds(gamma)
