"""Birth and death of hidden entities."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from worldstate.ground.values import NANOSECONDS_PER_SECOND
from worldstate.measurement.measurement import Measurement

from .explanation import ExplanationBelief
from .site_geometry import SiteGeometry
from .track import Track, entity_id

HIDDEN_LABEL = "vehicle"


@dataclass(frozen=True, slots=True)
class BirthDeath:
    """Outcome: tracks, explanations, entities that each side has brought forth, sides that began one."""

    tracks: tuple[Track, ...]
    explanation: ExplanationBelief
    births: tuple[int, ...]
    begun: tuple[int, ...]


def birth_death(
    tracks: tuple[Track, ...],
    explanation: ExplanationBelief,
    births: tuple[int, ...],
    alarmed: Sequence[bool],
    rearmed: Sequence[bool],
    measurement: Measurement,
    scene: SiteGeometry,
) -> BirthDeath:
    """Return the world with hidden entities born, refreshed and dropped, one at most per side.

    Shapes: alarmed (K,), rearmed (K,).
    """
    settings, kept, counts = scene.settings, list(tracks), list(births)
    begun = []
    for k in range(len(scene.sides)):
        current = next((track for track in kept if not track.seen and track.side == k), None)
        if current is None:
            heard = explanation.hidden[k] >= settings.birth_probability or alarmed[k]
            if heard and rearmed[k]:
                explanation = explanation.disown(k)
                begun.append(k)
                returning = _returning(kept, k, measurement.stamp_ns, scene)
                if returning is None:
                    kept.append(_born(k, counts[k], explanation.hidden[k], measurement, scene))
                    counts[k] += 1
                else:
                    kept.remove(returning)
                    kept.append(_hidden_again(returning, k, explanation.hidden[k], measurement, scene))
        else:
            kept.remove(current)
            # The sum of two exponentials exceeds one by rounding where nothing else is possible.
            existence = min(explanation.hidden[k] + explanation.emerged[k], 1.0)
            if existence >= settings.death_probability or alarmed[k]:
                kept.append(replace(current, existence=existence))
    return BirthDeath(tuple(kept), explanation, tuple(counts), tuple(begun))


def _returning(tracks: list[Track], k: int, stamp_ns: int, scene: SiteGeometry) -> Track | None:
    """Return the entity that left view near this side a moment ago, if there is one."""
    side, settings = scene.sides[k], scene.settings
    earliest_ns = stamp_ns - settings.reocclusion_s * NANOSECONDS_PER_SECOND
    latest_ns = stamp_ns - settings.reocclusion_after_s * NANOSECONDS_PER_SECOND
    candidates = [
        track
        for track in tracks
        if track.seen and track.moving and track.last_seen_ns is not None
        if earliest_ns <= track.last_seen_ns <= latest_ns
        if side.distance_rad(track.motion.azimuth_rad) <= settings.handover_gate_rad
    ]
    return min(candidates, key=lambda track: side.distance_rad(track.motion.azimuth_rad), default=None)


def _hidden_again(
    track: Track, k: int, existence: float, measurement: Measurement, scene: SiteGeometry
) -> Track:
    return replace(
        track,
        side=k,
        seen=False,
        was_hidden=True,
        existence=existence,
        motion=scene.prior(k),
        updated_ns=measurement.stamp_ns,
    )


def _born(k: int, number: int, existence: float, measurement: Measurement, scene: SiteGeometry) -> Track:
    return Track(
        id=entity_id(scene.settings.stream, scene.sides[k].label, number),
        side=k,
        seen=False,
        existence=existence,
        motion=scene.prior(k),
        labels=((HIDDEN_LABEL, 1.0),),
        moving=True,
        sources=(measurement.source,),
        created_ns=measurement.stamp_ns,
        updated_ns=measurement.stamp_ns,
        was_hidden=True,
    )
