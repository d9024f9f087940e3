"""Prediction of the memory to a later time: sides, entities and the ego vehicle."""

from collections.abc import Sequence
from dataclasses import replace

from worldstate.belief.association import HANDOVER_RESIDUAL
from worldstate.belief.kinematics.cartesian import corrected, driven
from worldstate.belief.track import Track, hidden_share, predict_tracks, turned
from worldstate.ground.values import seconds
from worldstate.measurement import Odometry

from .birth_death import past_edges, surviving
from .memory import CountedLook, Memory, without_forgotten
from .sequence_memory import carried
from .site_model import FilterModel, from_here


def advance(memory: Memory, stamp_ns: int, model: FilterModel) -> Memory:
    """Return the memory predicted to a later time."""
    step_ns, sides = stamp_ns - memory.stamp_ns, memory.sides
    model = from_here(model, memory.ego)
    shares = [hidden_share(track, sides) for track in memory.tracks]
    tracks = predict_tracks(memory.tracks, shares, seconds(step_ns), model.site)
    kept = without_forgotten(memory, stamp_ns)
    predicted = replace(
        kept,
        stamp_ns=stamp_ns,
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


def update_odometry(memory: Memory, told: Odometry) -> Memory:
    """Return the memory after odometry: azimuth rates are those of axes that turn with the ego vehicle."""
    before, ego = memory.ego, corrected(memory.ego, told)
    faster = ego.yaw_rate_rad_s - (0.0 if before is None else before.yaw_rate_rad_s)
    tracks = memory.tracks if not faster else tuple(turned(one, faster) for one in memory.tracks)
    look = CountedLook(told.source, told.stamp_ns, told.source)
    return replace(memory.with_look(look), ego=ego, tracks=tracks, seq=memory.seq + 1)
