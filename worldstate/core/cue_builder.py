"""Build the cues of a snapshot: risk, times, advisories, and what these are raised by."""

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from worldstate.abduction.sequence.sequence_model import HORIZONS_S, STATED
from worldstate.belief.hidden_bearing import announced
from worldstate.state import Advisory, EvidenceTerms, RiskCue, SensorHealth

from .birth_death import hidden_on
from .memory import Memory, priors_of
from .sequence_memory import SequenceMemory
from .snapshot_builder import hidden_azimuth, sector, time_to_arrival, visible_in
from .step import FilterModel, advisory_ends_ns, announced_ends_ns, claimed_nats, heard_ends_ns

# Certainty has no end; e^-20 is once in fifteen years of hops.
_MOST_NATS = 20.0
_Times = tuple[dict[str, float], tuple[float, float, float] | None]


def hidden_risks(memory: Memory, model: FilterModel) -> tuple[float, ...]:
    r"""Return the risk of every side.

    .. math:: r_k = P(hid_k \mid y_{1:t}), \qquad r_k = g(P(hid \mid y_{1:t}))\, P(k \mid hid, y_{1:t})

    with a sequence model, whose probabilities are calibrated and whose sides do not exclude each other, and
    without one, by the map g of the policy. An announced one is hidden at least as surely as messages say.
    """
    told = announced(memory.tracks, model.site)
    if memory.sequence is not None:
        return tuple(map(max, memory.sides.hidden, told))
    total = memory.explanation.hidden_total
    risk = float(model.policy.risk_map(min(total, 1.0)))
    # The floor only matters where P(hidden) has underflowed; then no direction has a share.
    return tuple(risk * hidden / max(total, 1e-300) for hidden in memory.explanation.hidden)


def cues_of(memory: Memory, model: FilterModel, sensors: tuple[SensorHealth, ...]) -> tuple[RiskCue, ...]:
    """Return one risk cue per side, none before the first measurement."""
    instant, explanation = memory.instant, memory.explanation
    if instant is None:
        return ()
    ends_ns = advisory_ends_ns(memory)
    rested_on = tuple(one for one in sensors if one.condition != "silent")
    advisories = [
        None
        if end_ns is None
        else Advisory(memory.stamp_ns if since_ns is None else since_ns, end_ns, rested_on)
        for since_ns, end_ns in zip(memory.advised_ns, ends_ns, strict=True)
    ]
    times = _times(memory.sequence, advisories)
    evidence = _evidence(memory, model)
    # All sides together: what is taken out of arrays once.
    shared = partial(
        RiskCue,
        statistic=instant.hidden_total,
        log_lambda=instant.log_lambda,
        hypotheses=priors_of(explanation),
    )
    risks = hidden_risks(memory, model)
    shares = np.array(risks) / max(sum(risks), 1e-300)
    build = partial(_cue, memory, model, shared)
    return tuple(map(build, range(len(ends_ns)), risks, shares.tolist(), advisories, times, evidence))


def _cue(
    memory: Memory,
    model: FilterModel,
    shared: Callable[..., RiskCue],
    k: int,
    risk: float,
    share: float,
    advisory: Advisory | None,
    times: _Times | None,
    evidence: EvidenceTerms,
) -> RiskCue:
    track = hidden_on(memory.tracks, k)
    motion = model.site.prior(k) if track is None else track.motion
    azimuth_rad, std_rad = motion.azimuth_rad, motion.azimuth_std_rad
    if track is None or track.place is None:
        azimuth_rad, std_rad = hidden_azimuth(k, motion, memory.sequence, model.site)
    within, interval_s = (None, None) if times is None else times
    closing_hz = motion.inverse_tta_hz if track is not None and track.approach_heard else None
    arrival_s = time_to_arrival(closing_hz, motion.inverse_tta_std_hz)
    # Distance and speed of an announced vehicle tell more than the sound.
    interval_s = (track and visible_in(track, model.site)) or interval_s
    return shared(
        direction=model.site.sides[k].label,
        azimuth_rad=azimuth_rad,
        azimuth_std_rad=std_rad,
        risk=risk,
        confidence=share,
        advisory=advisory,
        alpha=model.policy.alpha or None if evidence.hypothesis == "hidden" else None,
        entity_id=None if track is None else track.id,
        horizon_s=arrival_s if interval_s is None else interval_s[1],
        within=within,
        time_to_visible_s=interval_s,
        sector_rad=sector(azimuth_rad, std_rad),
        evidence=evidence,
    )


def _times(kept: SequenceMemory | None, advisories: list[Advisory | None]) -> list[_Times | None]:
    """Return the probabilities of coming into view, and the time to it where a vehicle is expected."""
    if kept is None:
        return [None] * len(advisories)
    posterior = kept.posterior
    within = posterior.within()[0].tolist()
    soon = posterior.groups[0, :, :STATED].sum(axis=1) > 0.5
    # The times are those of a vehicle that comes: in an empty street they would say nothing.
    stated = [told is not None or likely for told, likely in zip(advisories, soon.tolist(), strict=True)]
    intervals_s = posterior.time_to_visible_s()[0].tolist() if any(stated) else within
    names = [f"{end_s:g}" for end_s in HORIZONS_S]
    return [
        (dict(zip(names, chances, strict=True)), (row[0], row[1], row[2]) if told else None)
        for chances, row, told in zip(within, intervals_s, stated, strict=True)
    ]


def _evidence(memory: Memory, model: FilterModel) -> list[EvidenceTerms]:
    """Return what raises the advisory of each side: the sound, or messages where they alone do."""
    heard, told_ns = _heard(memory, model), announced_ends_ns(memory)
    if all(end_ns is None for end_ns in told_ns):
        return heard
    told, sides = _announced(memory, model), zip(heard, heard_ends_ns(memory), told_ns, strict=True)
    return [own if heard_ns is not None or end_ns is None else told for own, heard_ns, end_ns in sides]


def _heard(memory: Memory, model: FilterModel) -> list[EvidenceTerms]:
    """Return for each side what the alarm of a sequence goes by, or the rule of all sides together."""
    kept, instant = memory.sequence, memory.instant
    assert instant is not None
    if kept is not None and kept.alarm is not None:
        terms, means = kept.log_odds_terms(model.context), kept.mean_log_odds.tolist()
        threshold = kept.alarm.threshold_nats
        return [
            EvidenceTerms("coming", {name: both[k] for name, both in terms.items()}, means[k], threshold)
            for k in range(len(means))
        ]
    prior, threshold = _rule_log_odds(memory, model)
    looked_nats = math.inf if instant.log_lambda is None else instant.log_lambda
    heard, looked = _bounded(memory.heard_nats), _bounded(looked_nats)
    terms_nats = {"prior": prior, "window": heard, "look": looked - heard}
    told = EvidenceTerms("hidden", terms_nats, prior + looked, threshold)
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
    return _log_odds(sum(model.policy.reference_prior[:-2])), _log_odds(gamma)


def _log_odds(probability: float) -> float:
    least = math.exp(-_MOST_NATS)
    inside = min(max(probability, least), 1.0 - least)
    return math.log(inside) - math.log1p(-inside)


def _bounded(nats: float) -> float:
    return min(max(nats, -_MOST_NATS), _MOST_NATS)
