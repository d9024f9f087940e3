"""One step of the filter as pure functions: evidence, sightings, advisories, entities."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter

import numpy as np

from worldstate.abduction.co_evidence import Absent, CoEvidence, Present, Unqueried
from worldstate.abduction.cueing.cueing_policy import AdaptiveThreshold, CueingPolicy
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.abduction.posterior import posterior_of
from worldstate.abduction.sequence.sequence_model import COMING_S, GROUPS
from worldstate.abduction.sequence.sequence_reader import TOO_FEW, SequenceReading
from worldstate.abduction.signature.domain_guard import Foreign
from worldstate.belief.explanation import LOG_FLOOR, ExplanationBelief, SourceEvidence
from worldstate.belief.hidden_bearing import announced, hidden_motion
from worldstate.belief.kinematics.cartesian import EgoBelief, corrected, driven
from worldstate.belief.settings import FilterSettings
from worldstate.belief.site_geometry import SideGeometry, SiteGeometry
from worldstate.belief.track import Track, hidden_share, predict_tracks, turned
from worldstate.ground.values import NotUsable, nanoseconds, seconds
from worldstate.measurement import CameraLook, Measurement, Odometry, PositionScan
from worldstate.state import Context
from worldstate.state.context import seen_from

from .acoustic_update import acoustic_update
from .birth_death import (
    HIDDEN,
    birth_death,
    events_between,
    halves_of_one,
    merged_tracks,
    past_edges,
    published,
    surviving,
)
from .fixed_lag import LAG_NS
from .memory import (
    FORGOTTEN_NS,
    NEWS_HOLDS_NS,
    CountedLook,
    Instant,
    Memory,
    SourceRule,
    priors_of,
    without_forgotten,
)
from .position_update import position_update
from .relations import relations_at
from .sequence_memory import carried, informed
from .vision_update import log_co_evidence

# Relative: rounding must not choose a side, or the mirrored world would have the other one.
_TIE = 1e-9
_MOST_CERTAIN = 0.999  # Of a message
_NONE = 1e-12  # Of a coming group where no vehicle can come: shares of none at all are not defined
_NO_LOOK = Unqueried("sound alone")


@dataclass(frozen=True, slots=True)
class FilterModel:
    """Context, policy and site geometry, constant while the filter runs."""

    context: Context
    policy: CueingPolicy
    site: SiteGeometry


def site_geometry_of(
    context: Context, settings: FilterSettings, ego: EgoBelief | None = None
) -> SiteGeometry:
    """Return the site geometry of a context, as the ego vehicle has it."""
    yaw_rad = 0.0 if ego is None else float(ego.pose[2])
    sides = (
        SideGeometry(
            one.direction,
            one.edge_azimuth_rad,
            one.hidden_azimuth_rad,
            one.hidden_std_rad,
            one.edge_std_rad,
            one.pace_hz,
            one.hides,
            0.0 if one.corner_m is None else yaw_rad,
        )
        for one in context.occluders
    )
    twist = (context.ego_speed_mps or 0.0, 0.0) if ego is None else (ego.speed_mps, ego.yaw_rate_rad_s)
    return SiteGeometry(tuple(sides), context.view_half_angle_rad, settings, *twist)


def from_here(model: FilterModel, ego: EgoBelief | None) -> FilterModel:
    """Return the model as the ego vehicle has it where it is now; without odometry, as the context says."""
    if ego is None:
        return model
    x_var, y_var, yaw_var = ego.covariance.diagonal().tolist()
    stds = math.sqrt(0.5 * (x_var + y_var)), math.sqrt(yaw_var)
    x, y, yaw = ego.pose.tolist()
    occluders = tuple(seen_from(one, (x, y, yaw), *stds) for one in model.context.occluders)
    context = replace(model.context, occluders=occluders, ego_speed_mps=ego.speed_mps)
    return replace(model, context=context, site=site_geometry_of(context, model.site.settings, ego))


def update_odometry(memory: Memory, told: Odometry) -> Memory:
    """Return the memory after odometry: azimuth rates are those of axes that turn with the ego vehicle."""
    before, ego = memory.ego, corrected(memory.ego, told)
    faster = ego.yaw_rate_rad_s - (0.0 if before is None else before.yaw_rate_rad_s)
    tracks = memory.tracks if not faster else tuple(turned(one, faster) for one in memory.tracks)
    looks = _with_look(memory, CountedLook(told.source, told.stamp_ns, told.source))
    return replace(memory, ego=ego, tracks=tracks, looks=looks, seq=memory.seq + 1)


def where_nobody_hides(measurement: Measurement, context: Context) -> Measurement:
    """Remove the evidence for hidden vehicles on sides without an occluder."""
    is_open = np.array([not one.hides for one in context.occluders])
    if not is_open.any():
        return measurement
    said, reading = measurement.signature, measurement.sequence
    hidden = np.where(is_open, LOG_FLOOR, said.hidden).tolist()
    measurement = replace(measurement, signature=replace(said, hidden=tuple(hidden)))
    if not isinstance(reading, SequenceReading):
        return measurement
    groups = reading.groups.copy()
    groups[is_open] = np.maximum(groups[is_open] * (np.arange(len(GROUPS)) >= len(COMING_S)), _NONE)
    groups /= groups.sum(axis=1, keepdims=True)
    return replace(measurement, sequence=replace(reading, groups=groups))


def sound_weight(memory: Memory, measurement: Measurement, start_ns: int, settings: FilterSettings) -> float:
    r"""Return the overlap discount of a window from the time since the source's last measurement.

    .. math:: \kappa = \min(dt / T, 1), \quad T = window
    """
    before_ns = dict(memory.last_ns).get(measurement.source, start_ns)
    return min(max(seconds(measurement.stamp_ns - before_ns), 0.0) / settings.window_s, 1.0)


def new_looks(
    memory: Memory, measurement: Measurement, start_ns: int, settings: FilterSettings
) -> tuple[Memory, Measurement, list[tuple[CameraLook, float]]]:
    r"""Return the memory that knows of the looks of a measurement, it, and the new ones, weighed.

    .. math:: \kappa = \min(dt / T, 1), \quad T = look interval

    by the time since the last look of the sensor. A look belongs to the sensor that looked. Carried by a
    second source, or delivered again, it says nothing new; the source that carried it first keeps its answer,
    since each of its windows is weighed anew.
    """
    new = []
    for one in measurement.looks:
        look, last = one.look, _last_look(memory, one.look.sensor)
        # One stray stamp must not hide the looks after it, nor an image of long ago be new for ever.
        in_time = -FORGOTTEN_NS < look.stamp_ns - measurement.stamp_ns <= LAG_NS
        if in_time and (last is None or look.stamp_ns > last.stamp_ns):
            since_s = seconds(look.stamp_ns - (start_ns if last is None else last.stamp_ns))
            new.append((one, min(max(since_s, 0.0) / settings.look_interval_s, 1.0)))
            counted = CountedLook(
                look.sensor, look.stamp_ns, measurement.source, look.answer, look.sector_rad
            )
            memory = replace(memory, looks=_with_look(memory, counted))
        elif not in_time or (last is not None and last.source != measurement.source):
            when = "was counted before" if in_time else "is of another time"
            said = Unqueried(f"this look of {look.sensor} {when}")
            measurement = replace(measurement, co_evidence=said)
    return memory, measurement, new


def _with_look(memory: Memory, look: CountedLook) -> tuple[CountedLook, ...]:
    others = (one for one in memory.looks if one.sensor != look.sensor)
    return tuple(sorted((*others, look), key=attrgetter("sensor")))


def _last_look(memory: Memory, sensor: str) -> CountedLook | None:
    return next((one for one in memory.looks if one.sensor == sensor), None)


def advance(memory: Memory, stamp_ns: int, model: FilterModel) -> Memory:
    """Return the memory predicted to a later time."""
    step_ns, explanation, sides = stamp_ns - memory.stamp_ns, memory.explanation, memory.sides
    model = from_here(model, memory.ego)
    shares = [hidden_share(track, sides) for track in memory.tracks]
    tracks = predict_tracks(memory.tracks, shares, seconds(step_ns), model.site)
    predicted = replace(
        without_forgotten(replace(memory, stamp_ns=stamp_ns)),
        explanation=explanation.predict(model.context.rates.values_hz, step_ns),
        tracks=surviving(tracks, model.site.settings),
        sequence=memory.sequence and carried(memory.sequence, stamp_ns, step_ns, model.context),
        ego=memory.ego and driven(memory.ego, seconds(step_ns)),
    )
    announced_before = [track for track in memory.tracks if not track.seen and track.place is not None]
    return _places_passed(announced_before, predicted, model) if announced_before else predicted


def _places_passed(before: Sequence[Track], memory: Memory, model: FilterModel) -> Memory:
    """Return the memory after announced entities have come past their edge, or their place was lost."""
    now = {track.id: track for track in memory.tracks}
    emerged = tuple(old.side for old in before if old.behind >= 0.5 > now[old.id].behind)
    # Without a place it would be a hidden entity by its sound: of a side where nothing is heard it is gone.
    heard = [chance >= model.site.settings.birth_probability for chance in memory.sides.hidden]
    for old in before:
        others = [one for one in memory.tracks if not one.seen and one.place is None and one.side == old.side]
        if now[old.id] in others and (len(others) > 1 or not heard[old.side]):
            memory = replace(memory, tracks=tuple(one for one in memory.tracks if one.id != old.id))
    left = dict.fromkeys(emerged, model.site.settings.handover_residual)
    return past_edges(memory, left, emerged, memory.stamp_ns)


def update_evidence(memory: Memory, measurement: Measurement, weight: float, model: FilterModel) -> Memory:
    """Return the memory after the signature with its co-evidence, the bearing and the approach rate."""
    settings, source, stamp_ns = model.site.settings, measurement.source, measurement.stamp_ns
    window_ns = nanoseconds(settings.window_s)
    base_ns, belief, others = memory.lag.base(source, stamp_ns, window_ns)
    prior = belief.predict(model.context.rates.values_hz, stamp_ns - base_ns)
    answer = log_co_evidence(measurement.co_evidence, len(model.site.sides))
    signature = _with_hand_overs(measurement.signature, memory.handover_ns, stamp_ns - window_ns)
    explanation = prior.update(signature, answer + others)
    # -inf would stay for the length of the lag and cannot be written as JSON.
    own = np.maximum(signature.log_likelihoods + answer, LOG_FLOOR)
    evidence = SourceEvidence(source, stamp_ns, tuple(own.tolist()))
    lag, predicted = memory.lag.add(evidence, explanation, window_ns), priors_of(prior)
    memory = replace(memory, explanation=explanation, lag=lag, predicted=predicted)
    return acoustic_update(memory, measurement, weight, settings)


def _with_hand_overs(
    signature: SignatureEvidence, handover_ns: tuple[int | None, ...], begin_ns: int
) -> SignatureEvidence:
    """Return the evidence, its visible likelihood at least the hidden one for a window after a hand-over."""
    # A window that begins before a hand-over holds sound of the vehicle while it was hidden; without this,
    # that sound would give birth to a second hidden entity.
    pairs = zip(signature.hidden, handover_ns, strict=True)
    before = [hidden for hidden, stamp_ns in pairs if stamp_ns is not None and stamp_ns > begin_ns]
    # At least, not equal: what already sounds like a source in view stays that.
    return replace(signature, visible=max([signature.visible, *before])) if before else signature


def update_positions(memory: Memory, scan: PositionScan, model: FilterModel) -> Memory:
    """Return the memory after the positions of a radar or a radio: entities, and announced hidden ones."""
    settings, last = model.site.settings, _last_look(memory, scan.source)
    elapsed_s = math.inf if last is None else seconds(scan.stamp_ns - last.stamp_ns)
    weight = min(elapsed_s / settings.look_interval_s, 1.0)
    memory = position_update(memory, scan, weight, model.site)
    memory = replace(memory, looks=_with_look(memory, _scan_look(scan)), seq=memory.seq + 1)
    chances = announced(memory.tracks, model.site)
    if not any(chances):
        # An entity that has come into view, or is gone, ends the rule of the source that announced it.
        return replace(memory, rules=tuple(one for one in memory.rules if one.source != scan.source))
    memory = memory.explained(partial(ExplanationBelief.at_least, hidden=chances))
    if scan.searched is not None:
        return memory
    said = SignatureEvidence(model.context.directions, tuple(map(claimed_nats, chances)), 0.0, 0.0)
    sides = tuple(k for k, chance in enumerate(chances) if chance > 0.5)
    return _ruled(memory, scan.source, scan.stamp_ns, said, _NO_LOOK, model, announced=sides)


def _scan_look(scan: PositionScan) -> CountedLook:
    """Return a scan as a look at its sector, or at none where it is of messages."""
    source, stamp_ns, searched = scan.source, scan.stamp_ns, scan.searched
    if searched is None:
        return CountedLook(source, stamp_ns, source)
    miss, half_rad = 1.0 - searched.detection_probability, searched.sector.half_width_rad
    answer = (Present if scan.positions else Absent)(miss, searched.clutter_rate)
    ends_rad = (searched.sector.centre_rad - half_rad, searched.sector.centre_rad + half_rad)
    return CountedLook(source, stamp_ns, source, answer, ends_rad)


def claimed_nats(probability: float) -> float:
    """Return the log-odds that a message claims for a hidden entity of such existence."""
    # At even odds and below a message claims nothing, as the prior of the rule.
    known = min(max(probability, 0.5), _MOST_CERTAIN)
    return math.log(known / (1.0 - known))


def update_advisories(memory: Memory, measurement: Measurement, model: FilterModel) -> Memory:
    """Return the memory after the sustained rule has seen this window's statistic."""
    stamp_ns, said, answer = measurement.stamp_ns, measurement.signature, measurement.co_evidence
    domain = measurement.domain
    fault = measurement.fault or (domain.reason if isinstance(domain, Foreign) else None)
    memory = _ruled(memory, measurement.source, stamp_ns, said, answer, model, fault)
    return replace(memory, threshold=_adapted(memory, stamp_ns, model.policy))


def _ruled(
    memory: Memory,
    source: str,
    stamp_ns: int,
    said: SignatureEvidence,
    answer: CoEvidence,
    model: FilterModel,
    fault: str | None = None,
    announced: tuple[int, ...] = (),
) -> Memory:
    """Return the memory after one source's sustained rule has seen what it says."""
    # At the policy's own prior, without memory: the statistic that the threshold was calibrated on.
    log_prior = np.log(model.policy.reference_prior)
    instant = posterior_of(log_prior, said, answer)
    heard = instant if isinstance(answer, Unqueried) else posterior_of(log_prior, said, _NO_LOOK)
    held = instant.hidden_total >= model.policy.gamma_at(memory.threshold.shift_nats)
    run = next((one.run for one in memory.rules if one.source == source), 0)
    rule = replace(model.policy.rule(), run=run).advance(held)
    others = (one for one in memory.rules if one.source != source)
    rules = (*others, SourceRule(source, rule.run, rule.alarm, stamp_ns, fault, announced))
    return replace(
        memory,
        instant=Instant.of(instant),
        heard_nats=heard.log_lambda,
        rules=tuple(sorted(rules, key=attrgetter("source"))),
    )


def update_sequence(
    memory: Memory, measurement: Measurement, looks: Iterable[CameraLook], model: FilterModel
) -> Memory:
    """Return the memory after what a sequence model and the cameras say of vehicles that come into view."""
    said, site = measurement.sequence, model.site
    told = [site.in_sight(one) for one in looks if not isinstance(one.look.answer, Unqueried)]
    refused = said if isinstance(said, NotUsable) else None
    return replace(
        memory,
        sequence=informed(memory.sequence, measurement, told, model.context),
        # Other sources do not speak of it: what was said last holds.
        no_sequence=memory.no_sequence if said is None else refused,
    )


def _adapted(memory: Memory, stamp_ns: int, policy: CueingPolicy) -> AdaptiveThreshold:
    """Return the adaptive threshold after this window."""
    if policy.adaptive is None:
        return memory.threshold
    before_ns = max((ns for _, ns in memory.last_ns), default=stamp_ns)
    return memory.threshold.advance(
        policy.adaptive,
        visible=memory.explanation.visible,
        none=memory.explanation.none,
        alarm=_rule_ends_ns(memory) is not None,
        elapsed_s=max(seconds(stamp_ns - before_ns), 0.0),
    )


def advisory_ends_ns(memory: Memory) -> tuple[int | None, ...]:
    """Return for each side when its advisory ends without news, None where there is none.

    The rule names the likeliest side, or all in a tie; the alarm of a sequence model and messages name each
    side by itself.
    """
    return tuple(
        max((end_ns for end_ns in ends_ns if end_ns is not None), default=None)
        for ends_ns in zip(heard_ends_ns(memory), announced_ends_ns(memory), strict=True)
    )


def heard_ends_ns(memory: Memory) -> tuple[int | None, ...]:
    """Return for each side when its advisory by what is heard and seen ends.

    None before the first sequence: the first second of single windows was counted in no budget.
    """
    sequence, hidden = memory.sequence, memory.explanation.hidden
    if memory.no_sequence == TOO_FEW:
        return (None,) * len(hidden)
    if sequence is not None and sequence.alarm is not None:
        return sequence.alarm_ends_ns(memory.stamp_ns)
    end_ns, least = _rule_ends_ns(memory), max(hidden) * (1.0 - _TIE)
    return tuple(end_ns if p >= least else None for p in hidden)


def announced_ends_ns(memory: Memory) -> tuple[int | None, ...]:
    """Return for each side when its advisory by messages ends."""
    return tuple(_rule_ends_ns(memory, k) for k in range(len(memory.births)))


def alarmed(memory: Memory) -> tuple[bool, ...]:
    """Return for each side whether an advisory names it."""
    return tuple(end_ns is not None for end_ns in advisory_ends_ns(memory))


def _rule_ends_ns(memory: Memory, announced: int | None = None) -> int | None:
    """Return when the last rule in alarm ends, of those that hear or of those that announce for a side.

    That of a source that is silent for a second has ended.
    """
    # A rule that announces no vehicle hears, which is asked for with None.
    rules = (one for one in memory.rules if one.alarm and announced in (one.announced or (None,)))
    ends_ns = (one.stamp_ns + NEWS_HOLDS_NS for one in rules)
    return max((end_ns for end_ns in ends_ns if end_ns >= memory.stamp_ns), default=None)


def update_entities(memory: Memory, measurement: Measurement, model: FilterModel) -> Memory:
    """Return the memory after births and deaths of hidden entities."""
    memory = birth_death(memory, alarmed(memory), measurement, model.site)
    last_ns = dict(memory.last_ns) | {measurement.source: measurement.stamp_ns}
    return replace(
        memory,
        tracks=_on_their_way(memory, model.site),
        seq=memory.seq + 1,
        bearing=None if isinstance(measurement.bearing, NotUsable) else measurement.bearing,
        domain=measurement.domain,
        last_ns=tuple(sorted(last_ns.items())),
    )


def _on_their_way(memory: Memory, site: SiteGeometry) -> tuple[Track, ...]:
    """Return the tracks, those that are only heard and hidden where the sequence has them."""
    kept, sides, tracks = memory.sequence, memory.sides, memory.tracks
    if kept is None:
        return tracks
    coming, shares = kept.coming, [hidden_share(one, sides) for one in tracks]
    return tuple(
        replace(one, motion=hidden_motion(coming[one.side], share, site.sides[one.side], one.motion))
        if not one.seen and one.place is None and share >= HIDDEN
        else one
        for one, share in zip(tracks, shares, strict=True)
    )


def chronicled(before: Memory, carried: Memory, after: Memory, model: FilterModel) -> Memory:
    """Return the memory after a step with its events, and since when advisories have been out.

    An advisory that had ended in the memory that was carried to the time of the step begins anew.
    """
    sides = zip(before.advised_ns, alarmed(carried), alarmed(after), strict=True)
    advised_ns = tuple(
        (since_ns if since_ns is not None and held else after.stamp_ns) if named else None
        for since_ns, held, named in sides
    )
    tracks, into = merged_tracks(after.tracks, after.stamp_ns)
    if halves := halves_of_one(before, after):
        # As after a hand-over of its own: the sound of before must not bring it forth again.
        ended = {one.side for one in before.tracks if one.id in halves}
        handover_ns = (after.stamp_ns if k in ended else ns for k, ns in enumerate(after.handover_ns))
        after = replace(after, handover_ns=tuple(handover_ns))
        tracks = tuple(one for one in tracks if one.id not in halves)
    known, now = (published(one, model.site.settings) for one in (before.tracks, tracks))
    events = events_between(known, now, after.stamp_ns, into | halves)
    relations = relations_at(replace(after, relations=before.relations), now, model.context)
    return replace(after, tracks=tracks, advised_ns=advised_ns, events=events, relations=relations)
