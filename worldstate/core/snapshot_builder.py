"""Build the public WorldState from the internal beliefs."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from worldstate.abduction.sequence.sequence_model import COMING_S, HORIZONS_S, LONGEST_S
from worldstate.belief.acoustic_update import hidden_share
from worldstate.belief.announced import time_to_visible
from worldstate.belief.birth_death import hidden_on
from worldstate.belief.hidden_bearing import hidden_bearing
from worldstate.belief.hidden_belief import HiddenBelief
from worldstate.belief.kinematics.motion import MotionBelief
from worldstate.belief.kinematics.polar import AZIMUTH_RATE, LOG_RANGE
from worldstate.belief.settings import FilterSettings
from worldstate.belief.track import Track
from worldstate.state import Classification, Context, Entity, Relation, RiskCue, Visibility
from worldstate.state.relation import EGO

from .memory import Memory, priors_of
from .sequence_memory import SequenceMemory
from .step import FilterModel

# Of log r: 25 % of the range. The priors have .6, so a range with more was assumed and never measured.
_KNOWN_LOG_RANGE_STD = 0.25
# A lane and a half, and a change of pace: beyond, a number would be taken for more than it says.
_KNOWN_POSITION_STD_M, _KNOWN_VELOCITY_STD_MPS = 5.0, 5.0
_NINE_OF_TEN = 1.645  # Standard deviations either side


def entity_of(track: Track, memory: Memory, context: Context, settings: FilterSettings) -> Entity:
    """Return the published entity of a track."""
    sides = memory.sides
    share, existence = hidden_share(track, sides), existence_of(track, sides)
    hidden, motion = share >= 0.5, track.motion
    range_m = _range(motion, hidden and track.place is None)
    azimuth_rad, std_rad = motion.azimuth_rad, motion.azimuth_std_rad
    if hidden and track.place is None:
        edge_rad = context.occluders[track.side].edge_azimuth_rad
        azimuth_rad, std_rad = hidden_azimuth(track.side, motion, memory.sequence, edge_rad, settings)
    return Entity(
        id=track.id,
        status="hidden" if hidden else "visible" if track.seen else "emerged",
        existence_probability=existence,
        hidden_probability=share * existence,
        classification=tuple(Classification(label, probability) for label, probability in track.labels),
        moving=track.moving,
        direction=context.directions[track.side],
        azimuth_rad=azimuth_rad,
        azimuth_std_rad=std_rad,
        azimuth_rate_rad_s=None if hidden else float(motion.mean[AZIMUTH_RATE]),
        range_m=range_m,
        **_place(track, range_m, hidden, context),
        inverse_tta_hz=motion.inverse_tta_hz if track.approach_heard else None,
        inverse_tta_std_hz=motion.inverse_tta_std_hz if track.approach_heard else None,
        tta_s=time_to_arrival(track),
        visibility=Visibility(track.answer, track.miss_rate),
        sources=track.sources,
        created_ns=track.created_ns,
        updated_ns=track.updated_ns,
        last_seen_ns=track.last_seen_ns,
    )


def existence_of(track: Track, sides: HiddenBelief) -> float:
    """Return the existence of a track, from the belief of its side until it is seen."""
    if track.seen or track.behind < 0.5:
        return track.existence
    if track.place is None:
        return sides.existence(track.side)
    # Not combined: what is believed of the side may rest on the same messages.
    return max(track.existence, sides.hidden[track.side])


def time_to_arrival(track: Track) -> float | None:
    """Return TTA in seconds where a measured approach rate exceeds its standard deviation, else None."""
    rate = track.motion.inverse_tta_hz
    return 1.0 / rate if track.approach_heard and rate > track.motion.inverse_tta_std_hz else None


def hidden_azimuth(
    side: int, motion: MotionBelief, kept: SequenceMemory | None, edge_rad: float, settings: FilterSettings
) -> tuple[float, float]:
    """Return where a hidden vehicle is and how far that may be off: by its time to visible, or as heard."""
    if kept is not None:
        return hidden_bearing(kept.posterior.groups[0, side, : len(COMING_S)], edge_rad)
    # Sound round a corner comes from its edge, not from the vehicle; averaging over hops does not remove
    # that.
    return motion.azimuth_rad, math.hypot(motion.azimuth_std_rad, settings.hidden_bias_std_rad)


def relations_of(track: Track, sides: HiddenBelief, context: Context, stamp_ns: int) -> list[Relation]:
    """Return the relations of one entity to its occluder and to the ego vehicle."""
    occluder, edges = context.occluders[track.side].id, []
    if not track.seen:
        share = hidden_share(track, sides)
        edges.append(Relation(track.id, occluder, "occluded_by", share, stamp_ns))
    elif track.was_hidden:
        edges.append(Relation(track.id, occluder, "emerged_from", 1.0, stamp_ns))
    if track.approach_heard:
        deviations = track.motion.inverse_tta_hz / track.motion.inverse_tta_std_hz
        closing = 0.5 * math.erfc(-deviations / math.sqrt(2.0))
        edges.append(Relation(track.id, EGO, "approaching", closing, stamp_ns))
    return edges


def cues_of(
    memory: Memory, model: FilterModel, hazard_risk: float, alarmed: Sequence[bool]
) -> tuple[RiskCue, ...]:
    """Return one risk cue per side, none before the first measurement."""
    if memory.instant is None:
        return ()
    return tuple(_cue(k, memory, model, hazard_risk, named) for k, named in enumerate(alarmed))


def _cue(k: int, memory: Memory, model: FilterModel, hazard_risk: float, named: bool) -> RiskCue:
    explanation, side, instant = memory.explanation, model.site.sides[k], memory.instant
    assert instant is not None
    track = hidden_on(memory.tracks, k)
    motion, settings = model.site.prior(k) if track is None else track.motion, model.site.settings
    azimuth_rad, std_rad = motion.azimuth_rad, motion.azimuth_std_rad
    if track is None or track.place is None:
        azimuth_rad, std_rad = hidden_azimuth(k, motion, memory.sequence, side.edge_azimuth_rad, settings)
    # The floor only matters where P(hidden) has underflowed; then no direction has a share.
    share = explanation.hidden[k] / max(explanation.hidden_total, 1e-300)
    arrival_s = None if track is None else time_to_arrival(track)
    within, times_s = _times(memory.sequence, k, named)
    own_alarm = memory.sequence is not None and memory.sequence.alarm is not None
    return RiskCue(
        direction=side.label,
        azimuth_rad=azimuth_rad,
        azimuth_std_rad=std_rad,
        risk=hazard_risk * share,
        confidence=share,
        statistic=min(instant.hidden_total, 1.0),
        log_lambda=instant.log_lambda if math.isfinite(instant.log_lambda) else None,
        hypotheses=priors_of(explanation),
        advisory=named,
        alpha=None if own_alarm else model.policy.alpha or None,
        entity_id=None if track is None else track.id,
        horizon_s=arrival_s if times_s is None else times_s[1],
        within=within,
        time_to_visible_s=times_s,
    )


def _times(
    kept: SequenceMemory | None, k: int, named: bool
) -> tuple[dict[str, float] | None, tuple[float, float, float] | None]:
    """Return the probabilities of coming into view, and the time to it where somebody is expected."""
    if kept is None:
        return None, None
    posterior = kept.posterior
    # A sum of probabilities may exceed one by rounding, which readers of a snapshot refuse.
    probabilities = np.minimum(posterior.within()[0, k], 1.0).tolist()
    within = dict(zip((f"{end_s:g}" for end_s in HORIZONS_S), probabilities, strict=True))
    # The times are those of whoever comes: of a street where nobody does they would say nothing.
    if not named and posterior.groups[0, k, : COMING_S.index(LONGEST_S) + 1].sum() <= 0.5:
        return within, None
    low, best, high = posterior.time_to_visible_s()[0, k].tolist()
    return within, (low, best, high)


def _range(motion: MotionBelief, hidden: bool) -> float | None:
    known = not hidden and math.sqrt(motion.covariance[LOG_RANGE, LOG_RANGE]) < _KNOWN_LOG_RANGE_STD
    return math.exp(motion.mean[LOG_RANGE]) if known else None


def _place(track: Track, range_m: float | None, hidden: bool, context: Context) -> dict[str, Any]:
    """Return position, velocity and covariance where known, and when a hidden one comes into view."""
    place, motion = track.place, track.motion
    if place is None and range_m is not None:
        azimuth_rad = motion.azimuth_rad
        return {"position_m": (range_m * math.cos(azimuth_rad), range_m * math.sin(azimuth_rad), 0.0)}
    if place is None or place.position_std_m >= _KNOWN_POSITION_STD_M:
        return {}
    x, y, vx, vy = place.mean.tolist()
    moves = place.velocity_std_mps < _KNOWN_VELOCITY_STD_MPS
    times_s = None
    if hidden and moves:
        edge_rad, ego_speed_mps = context.occluders[track.side].edge_azimuth_rad, context.ego_speed_mps or 0.0
        times_s = time_to_visible(place, edge_rad, ego_speed_mps)
    return {
        "position_m": (x, y, 0.0),
        "velocity_mps": (vx, vy, 0.0) if moves else None,
        "covariance": tuple(tuple(row) for row in place.covariance.tolist()),
        "time_to_visible_s": None if times_s is None else _interval(*times_s),
    }


def _interval(mean_s: float, std_s: float) -> tuple[float, float, float]:
    return max(mean_s - _NINE_OF_TEN * std_s, 0.0), mean_s, mean_s + _NINE_OF_TEN * std_s
