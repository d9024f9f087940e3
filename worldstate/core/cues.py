"""Advisories and cues: the alarm over the belief and what messages announce, and what is published."""

import math
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from worldstate.abduction.co_evidence import Unqueried
from worldstate.abduction.cueing.cueing_policy import CueingPolicy
from worldstate.abduction.evidence import posterior_of
from worldstate.abduction.road_users import Foreign
from worldstate.abduction.sequence.sequence_model import HORIZONS_S, STATED
from worldstate.abduction.sequence.sequence_reader import TOO_FEW
from worldstate.belief.hidden_bearing import announced, time_to_visible
from worldstate.belief.side_belief import SideBelief
from worldstate.ground import TINY
from worldstate.measurement import Measurement
from worldstate.state import Advisory, EvidenceTerms, Held, Priors, RiskCue, SensorHealth

from .birth_death import HIDDEN, hidden_on
from .memory import NEWS_HOLDS_NS, Instant, Memory, SourceState
from .side_update import heard_beside
from .site_model import FilterModel, published_belief
from .snapshot_builder import hidden_azimuth, sector, time_to_arrival
from .street_belief import StreetBelief, bounded_log_odds

NO_LOOK = Unqueried("sound alone")
_UNNAMED = "no source distinguishes this side: its risk is that of the prior"


@dataclass(frozen=True, slots=True)
class SideAdvisory:
    """The advisory of a side: until when it stands without news, and whether it is only held."""

    ends_ns: int
    held: bool = False  # Below its threshold by now
    announced: bool = False  # By messages, not by what is heard


def note_source(memory: Memory, measurement: Measurement, model: FilterModel) -> None:
    """Note how a source is, and what its window alone makes of the policy's reference prior."""
    source, stamp_ns, domain = measurement.source, measurement.stamp_ns, measurement.domain
    heard = heard_beside(memory, measurement, model.site.street)
    fault = measurement.fault or (domain.reason if isinstance(domain, Foreign) else None)
    last = memory.sources.get(source)
    since_ns = last.heard_ns if last is not None and last.heard.reason == heard.reason else stamp_ns
    memory.sources[source] = SourceState(stamp_ns, fault, heard, since_ns)
    if not measurement.heard.usable:
        return
    # At the policy's own prior, without memory: the statistic of the paper. Of other sides it has none.
    prior, explanations = model.policy.reference_prior, len(measurement.signature.directions) + 2
    log_prior = tuple(
        map(math.log, prior if len(prior) == explanations else [1.0 / explanations] * explanations)
    )
    posterior = posterior_of(log_prior, measurement.signature, measurement.co_evidence)
    ratio = posterior.log_lambda
    statistic, bounded = min(posterior.hidden_total, 1.0), ratio if math.isfinite(ratio) else None
    memory.last.instant = Instant(statistic, bounded)


def advisories(memory: Memory, model: FilterModel) -> tuple[SideAdvisory | None, ...]:
    """Return the advisory of each side, None where there is none; none stands beside a risk below 0.1."""
    every = raised_advisories(memory, model)
    return standing(every, published_belief(memory, model), model.site.street.death) if any(every) else every


def standing(
    raised: tuple[SideAdvisory | None, ...], sides: SideBelief, least: float
) -> tuple[SideAdvisory | None, ...]:
    """Return the advisories that no risk denies."""
    return tuple(one if risk >= least else None for one, risk in zip(raised, sides.risks, strict=True))


def raised_advisories(memory: Memory, model: FilterModel) -> tuple[SideAdvisory | None, ...]:
    """Return the advisory of each side at any risk: that by messages if what is heard raises none.

    None is raised in the first second of a sequence, which was counted in no budget.
    """
    belief, stamp_ns = memory.belief, memory.stamp_ns
    threshold, raised = belief.threshold_nats(model.policy, model.site.street), list[SideAdvisory | None]()
    pairs = zip(belief.alarm_ends_ns(stamp_ns), belief.decided_at(stamp_ns), strict=True)
    for end_ns, decided in pairs:
        stands = end_ns is not None and memory.last.no_sequence != TOO_FEW
        raised.append(SideAdvisory(end_ns, decided < threshold) if stands and end_ns else None)
    for k, nats in enumerate(_announced_nats(memory, model)):
        heard, since_ns = raised[k], memory.history[k].announced_ns
        end_ns = _announced_ends_ns(memory, k)
        stands = since_ns is not None and min(end_ns, since_ns + NEWS_HOLDS_NS) >= stamp_ns
        if stands and (heard is None or (heard.held and nats >= threshold)):
            raised[k] = SideAdvisory(end_ns, nats < threshold, announced=True)
    return tuple(raised)


def note_announced(memory: Memory, model: FilterModel) -> None:
    """Note on which sides messages reach the threshold now."""
    threshold = memory.belief.threshold_nats(model.policy, model.site.street)
    for k, nats in enumerate(_announced_nats(memory, model)):
        if nats >= threshold and _announced_ends_ns(memory, k) >= memory.stamp_ns:
            memory.history[k].announced_ns = memory.stamp_ns


def _announced_nats(memory: Memory, model: FilterModel) -> list[float]:
    """Return the log-odds that an announced road user comes into view, by side."""
    return list(map(bounded_log_odds, announced(memory.tracks, model.site)))


def _announced_ends_ns(memory: Memory, side: int) -> int:
    """Return when the announcements of a side end without news."""
    tracks = memory.tracks
    rows = tracks.placed & ~tracks.seen & (tracks.side == side)
    return int(tracks.updated_ns[rows].max(initial=memory.stamp_ns - 2 * NEWS_HOLDS_NS)) + NEWS_HOLDS_NS


def why_none(memory: Memory, model: FilterModel, side: int, sides: SideBelief) -> str | None:
    """Return why a side of high risk has no advisory; None if it is likelier that none comes."""
    if sides.risks[side] <= HIDDEN:
        return None
    belief = memory.belief
    if memory.last.no_sequence == TOO_FEW:
        return "less than a second of sound: no alarm is raised yet"
    if not belief.has_news(memory.stamp_ns):
        return "nothing was measured for a second"
    if belief.alarm_nats[side] < belief.alarm_nats.max():
        return "one vehicle is likelier than two, and likelier on the other side"
    if belief.has_times:
        return "it is not sure to come within three seconds, or not for long enough"
    return "it is not sure to be there, or not for long enough"


_Times = tuple[dict[str, float] | None, tuple[float, float, float] | None]


def cues_of(memory: Memory, model: FilterModel, sensors: tuple[SensorHealth, ...]) -> tuple[RiskCue, ...]:
    """Return one risk cue per side, none before the first measurement."""
    if not memory.counts.measurements:
        return ()
    sides, raised = published_belief(memory, model), raised_advisories(memory, model)
    told, evidence = standing(raised, sides, model.site.street.death), _evidence(memory, model, raised)
    # All sides together: what is taken out of arrays once.
    times = _times(memory.belief, [one is not None for one in told])
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
    azimuth_rad, std_rad, source = hidden_azimuth(k, track, memory.belief, model.site)
    within, interval_s = times
    arrival_s = None
    if track is not None and track.approach_heard:
        arrival_s = time_to_arrival(track.motion.inverse_tta_hz, track.motion.inverse_tta_std_hz)
    # Distance and speed of an announced vehicle tell more than the sound.
    if track is not None and track.place is not None:
        interval_s = time_to_visible(track.place, model.site.sides[track.side], model.site)[1] or interval_s
    named = memory.last.named  # None of them before the first window
    is_named = told is not None or not named or model.site.sides[k].label in named
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
        confidence=sides.risks[k] / max(sum(sides.risks), TINY),
        advisory=advisory,
        alpha=_alpha(memory, model.policy, evidence),
        entity_id=entity_id,
        horizon_s=arrival_s if interval_s is None else interval_s[1],
        within=within,
        time_to_visible_s=interval_s,
        sector_rad=sector(azimuth_rad, std_rad),
        evidence=evidence if is_named else None,
        held=held,
        not_advised=None if told is not None else why_none(memory, model, k, sides) if is_named else _UNNAMED,
    )


def _alpha(memory: Memory, policy: CueingPolicy, evidence: EvidenceTerms) -> float | None:
    """Return the share of hazard-free time in alarm: of the policy, or by the curve of a sequence's alarm."""
    if evidence.hypothesis == "hidden":
        return policy.alpha or None
    alarm = memory.belief.alarm if evidence.hypothesis == "coming" else None
    return alarm.promise.alpha if alarm and alarm.promise and policy.alpha else None


def _times(belief: StreetBelief, advised: list[bool]) -> list[_Times]:
    """Return the probabilities of coming into view, and the time to it if a vehicle is expected."""
    if not belief.has_times:
        return [(None, None)] * len(advised)
    posterior = belief.posterior
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
    r"""Return for each side what the alarm goes by: the belief, or messages if they alone raise an advisory.

    With L the log-odds after the prior, what was heard, every look, and messages,

    .. math:: t_j = L_j - L_{j-1}
    """
    belief, street = memory.belief, model.site.street
    after, threshold = belief.log_odds(street), belief.threshold_nats(model.policy, street)
    terms = np.diff(list(after.values()), axis=0, prepend=0.0).T.tolist()
    hypothesis: Literal["coming", "hidden"] = "coming" if belief.has_times else "hidden"
    heard = [
        EvidenceTerms(hypothesis, dict(zip(after, own, strict=True)), decides, threshold)
        for own, decides in zip(terms, belief.decided_at(memory.stamp_ns), strict=True)
    ]
    if not any(one is not None and one.announced for one in raised):
        return heard
    prior, claimed = after["prior"].tolist(), _announced_nats(memory, model)
    announcing = [
        EvidenceTerms("announced", {"prior": before, "messages": nats - before}, nats, threshold)
        for before, nats in zip(prior, claimed, strict=True)
    ]
    pairs = zip(raised, announcing, heard, strict=True)
    return [said if one is not None and one.announced else own for one, said, own in pairs]
