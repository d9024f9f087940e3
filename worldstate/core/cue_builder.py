"""Build the cues of a snapshot: risk, times, advisories, and what these are raised by."""

import math
from functools import partial

import numpy as np

from worldstate.abduction.sequence.sequence_model import HORIZONS_S, STATED
from worldstate.belief.hidden_bearing import announced
from worldstate.belief.side_belief import SideBelief
from worldstate.state import Advisory, EvidenceTerms, Held, Priors, RiskCue, SensorHealth

from .advisories import (
    MOST_NATS,
    SideAdvisory,
    bounded_log_odds,
    claimed_nats,
    decided_log_odds,
    raised_advisories,
    standing,
    why_none,
)
from .birth_death import hidden_on
from .memory import Instant, Memory
from .sequence_memory import SequenceMemory
from .site_model import FilterModel, published_belief
from .snapshot_builder import hidden_azimuth, sector, time_to_arrival, visible_in

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
    track = hidden_on(memory.tracks, k)
    motion = model.site.sides[k].prior() if track is None else track.motion
    azimuth_rad, std_rad, source = hidden_azimuth(k, track, memory.sequence, model.site)
    if track is not None and track.place is not None:
        azimuth_rad, std_rad, source = motion.azimuth_rad, motion.azimuth_std_rad, "measured"
    within, interval_s = times
    closing_hz = motion.inverse_tta_hz if track is not None and track.approach_heard else None
    arrival_s = time_to_arrival(closing_hz, motion.inverse_tta_std_hz)
    # Distance and speed of an announced vehicle tell more than the sound.
    interval_s = (track and visible_in(track, model.site)) or interval_s
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
    soon = posterior.groups[0, :, :STATED].sum(axis=1) > 0.5
    # The times are those of a vehicle that comes: in an empty street they would say nothing.
    stated = [told or likely for told, likely in zip(advised, soon.tolist(), strict=True)]
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
    told = _announced(memory, model)
    return [told if named else own for own, named in zip(heard, by_message, strict=True)]


def _heard(memory: Memory, model: FilterModel) -> list[EvidenceTerms]:
    r"""Return for each side what the alarm of a sequence goes by, or the rule of all sides together.

    With L the log-odds of a sequence after the prior, what was heard, and every look,

    .. math:: t_j = L_j - L_{j-1}
    """
    kept, instant = memory.sequence, memory.last.instant
    assert instant is not None
    if kept is not None and kept.alarm is not None:
        after, threshold = kept.log_odds(model.context), kept.alarm.threshold_nats
        terms = np.diff(list(after.values()), axis=0, prepend=0.0).T.tolist()
        return [
            EvidenceTerms("coming", dict(zip(after, own, strict=True)), decides, threshold)
            for own, decides in zip(terms, kept.decided, strict=True)
        ]
    prior, threshold = _rule_log_odds(memory, model)
    looked_nats = math.inf if instant.log_lambda is None else instant.log_lambda
    heard, looked = (min(max(one, -MOST_NATS), MOST_NATS) for one in (instant.heard_nats, looked_nats))
    terms_nats = {"prior": prior, "window": heard, "look": looked - heard}
    told = EvidenceTerms("hidden", terms_nats, decided_log_odds(memory, model.policy), threshold)
    return [told] * len(model.site.sides)


def _announced(memory: Memory, model: FilterModel) -> EvidenceTerms:
    """Return what the rule of messages goes by, all sides together."""
    weights = model.policy.reference_prior[:-2]
    chances = announced(memory.tracks, model.site)
    odds = sum(w * math.exp(claimed_nats(p)) for w, p in zip(weights, chances, strict=True)) / sum(weights)
    prior, threshold = _rule_log_odds(memory, model)
    nats = math.log(odds)
    return EvidenceTerms("announced", {"prior": prior, "messages": nats}, prior + nats, threshold)


def _rule_log_odds(memory: Memory, model: FilterModel) -> tuple[float, float]:
    """Return the log-odds of the rule's prior and of its threshold."""
    gamma = model.policy.gamma_at(memory.threshold.shift_nats)
    return bounded_log_odds(sum(model.policy.reference_prior[:-2])), bounded_log_odds(gamma)
