"""A filter's memory as JSON-able values, which Python writes and reads without losing a bit."""

import math
from dataclasses import fields
from typing import Any, TypeVar

import numpy as np

from worldstate.abduction.cueing.adaptive_threshold import AdaptiveThreshold
from worldstate.abduction.cueing.cueing_policy import CueingPolicy, SustainedRule
from worldstate.abduction.posterior import Posterior
from worldstate.belief.belief_lag import BeliefLag, SourceEvidence
from worldstate.belief.explanation import ExplanationBelief
from worldstate.belief.motion import MotionBelief
from worldstate.belief.settings import FilterSettings
from worldstate.belief.track import Track
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.reading import Record
from worldstate.ground.serialisation import decode, encode
from worldstate.state import Priors
from worldstate.state.entity import ANSWERS

from .memory import Memory

T = TypeVar("T")

SCHEMA_NAME = "worldstate.Filter"
SCHEMA_VERSION = "2.0.0"


def memory_to_dict(memory: Memory) -> dict[str, Any]:
    """Return all that the filter carries."""
    return {
        "stamp_ns": memory.stamp_ns,
        "log_explanations": list(memory.explanation.log_probabilities),
        "trail": _trail_to_dict(memory.trail),
        "rule_run": memory.rule.run,
        "births": list(memory.births),
        "handover_ns": [{"stamp_ns": stamp_ns} for stamp_ns in memory.handover_ns],
        "tracks": [_track_to_dict(track) for track in memory.tracks],
        "seq": memory.seq,
        "sighted": memory.sighted,
        "last": [{"source": source, "stamp_ns": stamp_ns} for source, stamp_ns in memory.last_ns],
        "predicted": None if memory.predicted is None else memory.predicted.to_dict(),
        "instant": None if memory.instant is None else _instant_to_dict(memory.instant),
        "threshold": encode(memory.threshold),
    }


def memory_from_record(record: Record, directions: tuple[str, ...], policy: CueingPolicy) -> Memory:
    """Return what `memory_to_dict` wrote."""
    k = len(directions)
    return Memory(
        stamp_ns=record.integer("stamp_ns"),
        explanation=ExplanationBelief(directions, _sized(record, "log_explanations", 2 * k + 2)),
        trail=_trail_from_record(record.record("trail"), directions),
        rule=SustainedRule(policy.sustain_hops, _counted(record, "rule_run", policy.sustain_hops)),
        births=_births(record, k),
        handover_ns=_handovers(record, k),
        tracks=tuple(_track_from_record(item, k) for item in record.records("tracks")),
        seq=_counted(record, "seq"),
        sighted=_counted(record, "sighted"),
        last_ns=tuple((item.text("source"), item.integer("stamp_ns")) for item in record.records("last")),
        predicted=record.maybe("predicted", lambda key: Priors.from_record(record.record(key))),
        instant=record.maybe("instant", lambda key: _instant_from_record(record.record(key), directions)),
        threshold=_or(
            record.maybe("threshold", lambda key: decode(AdaptiveThreshold, record.record(key).raw, key)),
            AdaptiveThreshold(),
        ),
    )


def settings_to_dict(settings: FilterSettings) -> dict[str, Any]:
    """Return the settings; a tuple becomes a list."""
    values = {field.name: getattr(settings, field.name) for field in fields(settings)}
    return values | {"hidden_std": list(settings.hidden_std)}


def settings_from_record(record: Record) -> FilterSettings:
    """Return what `settings_to_dict` wrote; errors are those of `memory_from_record`."""
    spread = record.vector("hidden_std")
    names = [field.name for field in fields(FilterSettings) if field.name not in ("hidden_std", "stream")]
    numbers = {name: record.number(name) for name in names}
    return FilterSettings(hidden_std=spread, stream=record.text("stream"), **numbers)


def policy_from_record(record: Record) -> CueingPolicy:
    """Return the policy that its `to_dict` wrote."""
    return decode(CueingPolicy, record.raw, record.where)


def _trail_to_dict(trail: BeliefLag) -> dict[str, Any]:
    return {
        "beliefs": [
            {"stamp_ns": stamp_ns, "log_explanations": list(belief.log_probabilities)}
            for stamp_ns, belief in trail.beliefs
        ],
        "heard": [
            {"source": h.source, "stamp_ns": h.stamp_ns, "log_likelihoods": list(h.log_likelihoods)}
            for h in trail.heard
        ],
    }


def _trail_from_record(record: Record, directions: tuple[str, ...]) -> BeliefLag:
    k = len(directions)
    beliefs = tuple(
        (item.integer("stamp_ns"), ExplanationBelief(directions, _sized(item, "log_explanations", 2 * k + 2)))
        for item in record.records("beliefs")
    )
    if not beliefs:
        raise InvalidArgumentError(f"{record.where}.beliefs: expected at least one")
    return BeliefLag(
        beliefs,
        tuple(
            SourceEvidence(
                item.text("source"), item.integer("stamp_ns"), _sized(item, "log_likelihoods", k + 2)
            )
            for item in record.records("heard")
        ),
    )


def _track_to_dict(track: Track) -> dict[str, Any]:
    return {
        "id": track.id,
        "side": track.side,
        "seen": track.seen,
        "existence": track.existence,
        "mean": track.motion.mean.tolist(),
        "covariance": track.motion.covariance.ravel().tolist(),
        "labels": [{"label": label, "probability": probability} for label, probability in track.labels],
        "moving": track.moving,
        "sources": list(track.sources),
        "created_ns": track.created_ns,
        "updated_ns": track.updated_ns,
        "last_seen_ns": track.last_seen_ns,
        "answer": track.answer,
        "miss_rate": track.miss_rate,
        "approach_heard": track.approach_heard,
        "was_hidden": track.was_hidden,
    }


def _track_from_record(record: Record, directions: int) -> Track:
    return Track(
        id=record.text("id"),
        side=_counted(record, "side", directions - 1),
        seen=record.flag("seen"),
        existence=record.probability("existence"),
        motion=_motion_from_record(record),
        labels=tuple((item.text("label"), item.number("probability")) for item in record.records("labels")),
        moving=record.flag("moving"),
        sources=record.texts("sources"),
        created_ns=record.integer("created_ns"),
        updated_ns=record.integer("updated_ns"),
        last_seen_ns=record.maybe("last_seen_ns", record.integer),
        answer=record.one_of("answer", ANSWERS),
        miss_rate=record.maybe("miss_rate", record.probability),
        approach_heard=record.flag("approach_heard"),
        was_hidden=record.flag("was_hidden"),
    )


def _motion_from_record(record: Record) -> MotionBelief:
    mean = np.array(_sized(record, "mean", 4))
    covariance = np.array(_sized(record, "covariance", 16)).reshape(4, 4)
    if not (covariance == covariance.T).all() or np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise InvalidArgumentError(f"{record.where}.covariance: expected it symmetric and positive definite")
    return MotionBelief(mean, covariance)


def _instant_to_dict(instant: Posterior) -> dict[str, Any]:
    """JSON knows no infinity: null stands for an impossible explanation and for a ratio without bound."""
    return {
        "log_probabilities": [{"nats": p if math.isfinite(p) else None} for p in instant.log_probabilities],
        "log_lambda": instant.log_lambda if math.isfinite(instant.log_lambda) else None,
        "log_evidence": instant.log_evidence,
    }


def _instant_from_record(record: Record, directions: tuple[str, ...]) -> Posterior:
    items = record.records("log_probabilities")
    logs = tuple(_or(item.maybe("nats", item.number), -math.inf) for item in items)
    if len(logs) != len(directions) + 2:
        expected = f"expected {len(directions) + 2}, got {len(logs)}"
        raise InvalidArgumentError(f"{record.where}.log_probabilities: {expected}")
    log_lambda = _or(record.maybe("log_lambda", record.number), math.inf)
    return Posterior(directions, logs, log_lambda, record.number("log_evidence"))


def _or(value: T | None, otherwise: T) -> T:
    return otherwise if value is None else value


def _births(record: Record, directions: int) -> tuple[int, ...]:
    births = record.integers("births")
    if len(births) != directions or min(births) < 0:
        raise InvalidArgumentError(f"{record.where}.births: expected {directions} counts, got {births}")
    return births


def _handovers(record: Record, directions: int) -> tuple[int | None, ...]:
    stamps = tuple(item.maybe("stamp_ns", item.integer) for item in record.records("handover_ns"))
    if len(stamps) != directions:
        raise InvalidArgumentError(f"{record.where}.handover_ns: expected {directions}, got {len(stamps)}")
    return stamps


def _sized(record: Record, key: str, count: int) -> tuple[float, ...]:
    numbers = record.numbers(key)
    if len(numbers) != count:
        raise InvalidArgumentError(f"{record.where}.{key}: expected {count} numbers, got {len(numbers)}")
    return numbers


def _counted(record: Record, key: str, most: int | None = None) -> int:
    count = record.integer(key)
    if count < 0 or (most is not None and count > most):
        raise InvalidArgumentError(f"{record.where}.{key}: expected a count within 0 .. {most}, got {count}")
    return count
