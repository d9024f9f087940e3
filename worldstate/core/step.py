"""One step of the filter as pure functions: motion, evidence, looks, messages, entities."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from operator import attrgetter

import numpy as np

from worldstate.abduction.co_evidence import Absent, CoEvidence, Present, Unqueried
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.belief.association import HANDOVER_RESIDUAL
from worldstate.belief.detection import camera_scan, position_scan
from worldstate.belief.hidden_bearing import announced, hidden_motion
from worldstate.belief.kinematics.cartesian import corrected, driven
from worldstate.belief.settings import FilterSettings
from worldstate.belief.site_geometry import SiteGeometry
from worldstate.belief.track import Track, hidden_share, predict_tracks, turned
from worldstate.ground import FloatArray
from worldstate.ground.values import NotUsable, nanoseconds, seconds
from worldstate.measurement import CameraLook, Measurement, Odometry, PositionScan

from .acoustic_update import acoustic_update
from .advisories import NO_LOOK, advisories, claimed_nats, ruled
from .birth_death import HIDDEN, birth_death, events_between, merged_tracks, past_edges, published, surviving
from .detection_update import detection_update
from .fixed_lag import LAG_NS
from .memory import FORGOTTEN_NS, CountedLook, Memory, SourceRule, without_forgotten
from .relations import relations_at
from .sequence_memory import alerted, carried, informed
from .site_model import FilterModel, from_here


def update_odometry(memory: Memory, told: Odometry) -> Memory:
    """Return the memory after odometry: azimuth rates are those of axes that turn with the ego vehicle."""
    before, ego = memory.ego, corrected(memory.ego, told)
    faster = ego.yaw_rate_rad_s - (0.0 if before is None else before.yaw_rate_rad_s)
    tracks = memory.tracks if not faster else tuple(turned(one, faster) for one in memory.tracks)
    looks = _with_look(memory, CountedLook(told.source, told.stamp_ns, told.source))
    return replace(memory, ego=ego, tracks=tracks, looks=looks, seq=memory.seq + 1)


def sound_weight(memory: Memory, measurement: Measurement, start_ns: int, settings: FilterSettings) -> float:
    r"""Return the overlap discount of a window from the time since the source's last measurement.

    .. math:: \kappa = \min(dt / T, 1), \quad T = window
    """
    before_ns = memory.rule_of(measurement.source, start_ns).stamp_ns
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
    step_ns, sides = stamp_ns - memory.stamp_ns, memory.sides
    model = from_here(model, memory.ego)
    shares = [hidden_share(track, sides) for track in memory.tracks]
    tracks = predict_tracks(memory.tracks, shares, seconds(step_ns), model.site)
    kept = without_forgotten(replace(memory, stamp_ns=stamp_ns))
    predicted = replace(
        kept,
        windows=kept.windows and kept.windows.predict(model.context.rates.values_hz, step_ns),
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
    left = dict.fromkeys(emerged, HANDOVER_RESIDUAL)
    return past_edges(memory, left, (), memory.stamp_ns)


def update_looks(
    memory: Memory, measurement: Measurement, looks: Sequence[tuple[CameraLook, float]], model: FilterModel
) -> Memory:
    """Return the memory after the new looks of a measurement, all cameras at once."""
    if not looks:
        return memory
    scans = [camera_scan(seen, model.site.view(seen.look), weight) for seen, weight in looks]
    return detection_update(memory, scans, measurement.co_evidence, measurement.stamp_ns, model.site)


def update_evidence(memory: Memory, measurement: Measurement, weight: float, model: FilterModel) -> Memory:
    """Return the memory after the signature with its co-evidence, the bearing and the approach rate."""
    windows = memory.windows
    memory = replace(memory, predicted=memory.sides.hypotheses)
    if windows is not None and measurement.heard.usable:
        source, stamp_ns = measurement.source, measurement.stamp_ns
        window_ns, rates_hz = nanoseconds(model.site.settings.window_s), model.context.rates.values_hz
        looked = log_co_evidence(measurement.co_evidence, len(model.site.sides))
        said = masked_by(measurement.signature, measurement.heard.share)
        signature = _with_hand_overs(said, memory.handover_ns, stamp_ns - window_ns)
        windows, prior = windows.update(source, stamp_ns, signature, looked, rates_hz, window_ns)
        memory = replace(memory, windows=windows, predicted=prior.sides.hypotheses)
    return acoustic_update(memory, measurement, weight)


def masked_by(signature: SignatureEvidence, share: float) -> SignatureEvidence:
    r"""Return the evidence of a window in which a hidden vehicle is noticed with a probability s.

    .. math:: l'_{hid,k} = s\, l_{hid,k} + (1 - s)\, \tfrac{1}{2} (l_{vis} + l_0)

    One that is masked sounds as if it were not there.
    """
    if share >= 1.0:
        return signature
    rest = float(np.logaddexp(signature.visible, signature.none)) + math.log(0.5 * (1.0 - share))
    heard = np.logaddexp(np.array(signature.hidden) + math.log(share), rest)
    return replace(signature, hidden=tuple(heard.tolist()))


def log_co_evidence(answer: CoEvidence, directions: int) -> FloatArray:
    """Return log p(V | hidden_1 .. hidden_K, visible, none), shape (K + 2,), nats."""
    hidden, visible, none = answer.log_likelihoods().tolist()
    return np.array([*[hidden] * directions, visible, none])


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
    memory = detection_update(memory, [position_scan(scan, weight)], None, scan.stamp_ns, model.site)
    memory = replace(memory, looks=_with_look(memory, _scan_look(scan)), seq=memory.seq + 1)
    if memory.sequence is not None:
        memory = replace(memory, sequence=alerted(memory.sequence, model.context))
    chances = announced(memory.tracks, model.site)
    if not any(chances):
        # An entity that has come into view, or is gone, ends the rule of the source that announced it.
        return replace(memory, rules=tuple(one for one in memory.rules if one.source != scan.source))
    if scan.searched is not None:
        return memory
    said = SignatureEvidence(model.context.directions, tuple(map(claimed_nats, chances)), 0.0, 0.0)
    sides = tuple(k for k, chance in enumerate(chances) if chance > 0.5)
    return ruled(memory, SourceRule(scan.source, scan.stamp_ns, announced=sides), said, NO_LOOK, model)


def _scan_look(scan: PositionScan) -> CountedLook:
    """Return a scan as a look at its sector, or at none where it is of messages."""
    source, stamp_ns, searched = scan.source, scan.stamp_ns, scan.searched
    if searched is None:
        return CountedLook(source, stamp_ns, source)
    miss, half_rad = 1.0 - searched.detection_probability, searched.sector.half_width_rad
    answer = (Present if scan.positions else Absent)(miss, searched.clutter_rate)
    ends_rad = (searched.sector.centre_rad - half_rad, searched.sector.centre_rad + half_rad)
    return CountedLook(source, stamp_ns, source, answer, ends_rad)


def update_sequence(
    memory: Memory, measurement: Measurement, looks: Iterable[CameraLook], model: FilterModel
) -> Memory:
    """Return the memory after what a sequence model and the cameras say of vehicles that come into view."""
    said, site = measurement.sequence, model.site
    told = [site.in_sight(one) for one in looks if not isinstance(one.look.answer, Unqueried)]
    refused = said if isinstance(said, NotUsable) else None
    sequence = informed(memory.sequence, measurement, told, model.context)
    return replace(
        memory,
        sequence=sequence,
        windows=memory.windows if sequence is None else None,
        # Other sources do not speak of it: what was said last holds.
        no_sequence=memory.no_sequence if said is None else refused,
    )


def update_entities(memory: Memory, measurement: Measurement, model: FilterModel) -> Memory:
    """Return the memory after births and deaths of hidden entities."""
    alarmed = [one is not None for one in advisories(memory, model)]
    memory = birth_death(memory, alarmed, measurement, model.site)
    return replace(
        memory,
        tracks=_on_their_way(memory, model.site),
        seq=memory.seq + 1,
        bearing=None if isinstance(measurement.bearing, NotUsable) else measurement.bearing,
        domain=measurement.domain,
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
    told = (advisories(one, model) for one in (carried, after))
    advised_ns = tuple(
        (since_ns if since_ns is not None and held is not None else after.stamp_ns) if named else None
        for since_ns, held, named in zip(before.advised_ns, *told, strict=True)
    )
    tracks, into = merged_tracks(after.tracks, after.stamp_ns)
    known, now = (published(one, model.site.settings) for one in (before.tracks, tracks))
    events = events_between(known, now, after.stamp_ns, into)
    relations = relations_at(replace(after, relations=before.relations), now, model.context)
    return replace(after, tracks=tracks, advised_ns=advised_ns, events=events, relations=relations)
