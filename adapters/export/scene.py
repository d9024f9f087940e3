"""The world-state as a scene for Foxglove: the messages, with sectors, lines and labels."""

import base64
import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, TypeAlias

import numpy as np

from worldstate.core.snapshot_builder import NINE_OF_TEN
from worldstate.ground.serialisation import Check, Count, Probability
from worldstate.ground.typing import FloatArray
from worldstate.state import Entity, Occluder, RiskCue, SearchedView, WorldState

# Unused primitives, for which the message must have an empty list.
NoPrimitives: TypeAlias = Annotated[
    tuple[str, ...], Check("an empty list", lambda value: not value, {"maxItems": 0})
]


def _is_base64(text: str) -> bool:
    try:
        base64.b64decode(text, validate=True)
    except ValueError:
        return False
    return True


# Keyword of JSON Schema by which a viewer decodes the text.
Base64: TypeAlias = Annotated[str, Check("base64", _is_base64, {"contentEncoding": "base64"})]


@dataclass(frozen=True, slots=True)
class SceneTime:
    """A time stamp or a duration."""

    sec: Count
    nsec: Count

    @classmethod
    def of_ns(cls, time_ns: int) -> "SceneTime":
        """Split nanoseconds.

        Examples
        --------
        >>> SceneTime.of_ns(1_500_000_000)
        SceneTime(sec=1, nsec=500000000)
        """
        return cls(*divmod(time_ns, 1_000_000_000))


@dataclass(frozen=True, slots=True)
class Xyz:
    """A point or a size, metres."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass(frozen=True, slots=True)
class Rotation:
    """A unit quaternion."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


@dataclass(frozen=True, slots=True)
class Placed:
    """Position and orientation."""

    position: Xyz = Xyz()
    orientation: Rotation = Rotation()


@dataclass(frozen=True, slots=True)
class Rgba:
    """A colour."""

    r: Probability
    g: Probability
    b: Probability
    a: Probability


@dataclass(frozen=True, slots=True)
class ScenePair:
    """A key with its value, shown when the entity is clicked."""

    key: str
    value: str


@dataclass(frozen=True, slots=True)
class SceneArrow:
    """An arrow along the x axis of its pose."""

    pose: Placed
    shaft_length: float
    shaft_diameter: float
    head_length: float
    head_diameter: float
    color: Rgba


@dataclass(frozen=True, slots=True)
class SceneSolid:
    """A cuboid or an ellipsoid."""

    pose: Placed
    size: Xyz
    color: Rgba


@dataclass(frozen=True, slots=True)
class SceneLine:
    """A line through points; type 0 an open strip, 1 a loop, 2 a list of segments."""

    type: Count
    points: tuple[Xyz, ...]
    color: Rgba
    thickness: float = 0.15
    scale_invariant: bool = False
    colors: tuple[Rgba, ...] = ()
    indices: tuple[Count, ...] = ()
    pose: Placed = Placed()


@dataclass(frozen=True, slots=True)
class SceneTriangles:
    """Triangles, three points each."""

    points: tuple[Xyz, ...]
    color: Rgba
    colors: tuple[Rgba, ...] = ()
    indices: tuple[Count, ...] = ()
    pose: Placed = Placed()


@dataclass(frozen=True, slots=True)
class SceneText:
    """A label."""

    pose: Placed
    text: str
    color: Rgba
    font_size: float = 1.0
    billboard: bool = True
    scale_invariant: bool = False


@dataclass(frozen=True, slots=True)
class SceneItem:
    """One entity of a scene."""

    timestamp: SceneTime
    frame_id: str
    id: str
    lifetime: SceneTime
    frame_locked: bool = True
    metadata: tuple[ScenePair, ...] = ()
    arrows: tuple[SceneArrow, ...] = ()
    cubes: tuple[SceneSolid, ...] = ()
    spheres: tuple[SceneSolid, ...] = ()
    cylinders: NoPrimitives = ()
    lines: tuple[SceneLine, ...] = ()
    triangles: tuple[SceneTriangles, ...] = ()
    texts: tuple[SceneText, ...] = ()
    models: NoPrimitives = ()


@dataclass(frozen=True, slots=True)
class SceneRemoval:
    """Remove entities that are older than the stamp: type 0 the one of this id, 1 all of the topic."""

    timestamp: SceneTime
    type: Count = 1
    id: str = ""


@dataclass(frozen=True, slots=True)
class SceneUpdate:
    """Additions and removals of a scene, as `foxglove.SceneUpdate`."""

    deletions: tuple[SceneRemoval, ...]
    entities: tuple[SceneItem, ...]


@dataclass(frozen=True, slots=True)
class CompressedImage:
    """An image of the camera, as `foxglove.CompressedImage`."""

    timestamp: SceneTime
    frame_id: str
    data: Base64
    format: str = "jpeg"


@dataclass(frozen=True, slots=True)
class RawAudio:
    """A block of sound of one microphone, 16 bits per sample, as `foxglove.RawAudio`."""

    timestamp: SceneTime
    data: Base64
    sample_rate: Count
    number_of_channels: Count = 1
    format: str = "pcm-s16"


@dataclass(frozen=True, slots=True)
class FrameTransform:
    """Pose of a frame in another frame, as `foxglove.FrameTransform`."""

    timestamp: SceneTime
    parent_frame_id: str
    child_frame_id: str
    translation: Xyz
    rotation: Rotation


# Radii of the sectors. Sound gives no distance: the radii only separate the layers.
SECTOR_M, SEARCHED_M, CUE_M, SRP_M = 30.0, 15.0, 24.0, 12.0
# Later sectors are slightly higher: in one plane they would flicker in a viewer.
_HEIGHT_M = {"occluder": 0.0, "searched": 0.02, "cue": 0.04, "entity": 0.06}
# Largest angle of one triangle of a sector.
_STEP_RAD = math.radians(5.0)
_CAR = Xyz(4.5, 1.8, 1.5)
# Colours of the figures, by meaning; occluders are grey. Decisions have a lighter colour than in the figures,
# because viewers have a dark background.
_GREY = (0.5, 0.5, 0.5)
_HIDDEN = (0.835, 0.369, 0.0)
_IN_VIEW = (0.0, 0.447, 0.698)
_SEARCHED = (0.0, 0.62, 0.451)
_DECISION = (0.5, 0.42, 0.9)
_HEARD = (0.8, 0.475, 0.655)


def scene_update(state: WorldState) -> SceneUpdate:
    """Return the drawing of a snapshot; it removes the drawings of earlier ones.

    Examples
    --------
    >>> [item.id for item in scene_update(WorldState(0, 0)).entities]
    ['ego', 'occluder corner_left', 'occluder corner_right']
    """
    items = [
        _item(state, "ego", arrows=(SceneArrow(Placed(), 2.0, 0.6, 0.9, 1.2, Rgba(0.2, 0.2, 0.2, 1.0)),)),
        *(_occluder(state, one) for one in state.context.occluders),
        *(_searched(state, one) for one in state.searched),
        *(_cue(state, one) for one in state.cues),
        *(_entity(state, part) for one in state.entities if one.moving for part in one.on_each_side()),
    ]
    return SceneUpdate((SceneRemoval(SceneTime.of_ns(state.stamp_ns)),), tuple(items))


def srp_scene(state: WorldState, azimuths_rad: FloatArray, srp: FloatArray) -> SceneUpdate:
    """Return the power of the sound over azimuth as a line about the array.

    Its radius is 12 m times the power over the median over azimuth.
    """
    level = srp / max(float(np.median(srp)), np.finfo(np.float64).tiny)
    radii = SRP_M * np.clip(level, 0.0, 2.0)
    line = SceneLine(0, tuple(map(_at, azimuths_rad.tolist(), radii.tolist())), Rgba(*_HEARD, 1.0))
    removal = SceneRemoval(SceneTime.of_ns(state.stamp_ns))
    return SceneUpdate((removal,), (_item(state, "srp", lines=(line,)),))


def sector_of(
    azimuth_rad: float, std_rad: float, sector_rad: tuple[float, float] | None
) -> tuple[float, float]:
    """Return the 90 % interval of an azimuth: as stated, otherwise by its standard deviation.

    Examples
    --------
    >>> right_rad, left_rad = sector_of(1.0, 0.1, None)
    >>> round(right_rad, 3), round(left_rad, 3)
    (0.836, 1.164)
    """
    half_rad = NINE_OF_TEN * std_rad
    return sector_rad or (azimuth_rad - half_rad, azimuth_rad + half_rad)


def hidden_sector(occluder: Occluder) -> tuple[float, float]:
    """Return the 90 % interval of the azimuth of a vehicle behind an occluder, from right to left."""
    edge_rad, hidden_rad = occluder.edge_azimuth_rad, occluder.hidden_azimuth_rad
    far_rad = hidden_rad + math.copysign(NINE_OF_TEN * occluder.hidden_std_rad, hidden_rad - edge_rad)
    return min(edge_rad, far_rad), max(edge_rad, far_rad)


def label_of(entity: Entity) -> str:
    """Return the likeliest class of an entity and its existence probability.

    Examples
    --------
    >>> label_of(Entity("id", "hidden", 0.9, 0.8, 0.8, azimuth_std_rad=0.3, created_ns=0, updated_ns=0))
    'hidden 0.90'
    """
    likeliest = max(entity.classification or (), key=lambda one: one.probability, default=None)
    kind = likeliest.label if likeliest is not None and likeliest.label != "unknown" else None
    told = entity.status, kind, f"{entity.existence_probability:.2f}"
    return " ".join(one for one in told if one is not None)


def _occluder(state: WorldState, occluder: Occluder) -> SceneItem:
    """Draw the edge as a line and the hidden area as a sector."""
    near, far = (_at(occluder.edge_azimuth_rad, radius_m) for radius_m in (4.0, SECTOR_M))
    edge = SceneLine(0, (near, far), Rgba(*_GREY, 1.0))
    behind = _sector(hidden_sector(occluder), SECTOR_M, Rgba(*_GREY, 0.12), "occluder")
    pairs = _pairs(direction=occluder.direction, assumed=occluder.assumed)
    return _item(state, f"occluder {occluder.id}", metadata=pairs, lines=(edge,), triangles=(behind,))


def _searched(state: WorldState, view: SearchedView) -> SceneItem:
    color = Rgba(*_SEARCHED, 0.4 if view.found else 0.15)
    pairs = _pairs(found=view.found, miss_rate=view.miss_rate, clutter_rate=view.clutter_rate)
    shape = _sector(view.sector_rad, SEARCHED_M, color, "searched")
    return _item(state, f"searched {view.sensor}", metadata=pairs, triangles=(shape,))


def _cue(state: WorldState, cue: RiskCue) -> SceneItem:
    """Draw the risk of a side as a density, with a label of the probability within 3 s."""
    sector_rad = sector_of(cue.azimuth_rad, cue.azimuth_std_rad, cue.sector_rad)
    raised = cue.advisory is not None
    color = Rgba(*(_DECISION if raised else _HIDDEN), 0.05 + 0.5 * (cue.risk or 0.0))
    shape = () if cue.risk is None else (_sector(sector_rad, CUE_M, color, "cue"),)
    said = [] if cue.risk is None else [f"risk {cue.risk:.2f}"]
    if cue.within is not None and "3" in cue.within:
        said.append(f"in 3 s {cue.within['3']:.2f}")
    said += ["ADVISORY"] * raised + [f"not usable: {', '.join(cue.why_not)}"] * (not cue.usable)
    side = cue.direction or "side unknown"
    text = _text(cue.azimuth_rad, CUE_M + 2.0, f"{side}: {', '.join(said)}", _DECISION if raised else _GREY)
    pairs = _pairs(
        risk=cue.risk, confidence=cue.confidence, advisory=raised, within=cue.within, usable=cue.usable,
        why_not=", ".join(cue.why_not) or None,
    )  # fmt: skip
    return _item(state, f"cue {side}", metadata=pairs, triangles=shape, texts=(text,))


def _entity(state: WorldState, entity: Entity) -> SceneItem:
    """Draw the 90 % interval of its azimuth and its forecast, and a box if its position is known."""
    color = _HIDDEN if entity.status == "hidden" else _IN_VIEW
    density = entity.existence_probability
    sector_rad = sector_of(entity.azimuth_rad, entity.azimuth_std_rad, entity.sector_rad)
    shapes = (_sector(sector_rad, SECTOR_M, Rgba(*color, 0.05 + 0.3 * density), "entity"),)
    middle = SceneLine(0, (Xyz(), _at(entity.azimuth_rad, SECTOR_M)), Rgba(*color, 0.2 + 0.8 * density))
    coming = tuple(_forecast(*ahead, color) for ahead in (entity.forecast or {}).values())
    cubes: tuple[SceneSolid, ...] = ()
    if entity.position_m is not None:
        middle_m = Xyz(*entity.position_m[:2], 0.5 * _CAR.z)
        cubes = (SceneSolid(Placed(middle_m), _CAR, Rgba(*color, 0.2 + 0.8 * density)),)
    pairs = _pairs(
        status=entity.status,
        existence_probability=entity.existence_probability,
        hidden_probability=entity.hidden_probability,
        time_to_visible_s=entity.time_to_visible_s,
        **{f"P({one.label})": one.probability for one in entity.classification or ()},
    )
    text = _text(entity.azimuth_rad, SECTOR_M + 2.0, label_of(entity), color)
    return _item(
        state, f"entity {entity.id}", metadata=pairs, cubes=cubes, lines=(middle, *coming), triangles=shapes,
        texts=(text,),
    )  # fmt: skip


def _forecast(azimuth_rad: float, std_rad: float, color: tuple[float, float, float]) -> SceneLine:
    """Draw a future azimuth as an arc at the rim, as wide as its 90 % interval."""
    arc = _azimuths(sector_of(azimuth_rad, std_rad, None))
    return SceneLine(0, tuple(_at(each, SECTOR_M) for each in arc), Rgba(*color, 0.6), thickness=0.4)


def _item(state: WorldState, name: str, **shapes: tuple[object, ...]) -> SceneItem:
    # After this time the snapshot is not valid, and a viewer must not show it.
    lifetime_ns = 0 if state.valid_until_ns is None else max(state.valid_until_ns - state.stamp_ns, 1)
    stamp, lifetime = SceneTime.of_ns(state.stamp_ns), SceneTime.of_ns(lifetime_ns)
    return SceneItem(stamp, state.frame_id, name, lifetime, **shapes)  # type: ignore[arg-type]


def _sector(sector_rad: tuple[float, float], radius_m: float, color: Rgba, layer: str) -> SceneTriangles:
    height_m = _HEIGHT_M[layer]
    rim = [_at(azimuth_rad, radius_m, height_m) for azimuth_rad in _azimuths(sector_rad)]
    corners = ((Xyz(0.0, 0.0, height_m), *pair) for pair in pairwise(rim))
    return SceneTriangles(tuple(point for triangle in corners for point in triangle), color)


def _azimuths(sector_rad: tuple[float, float]) -> list[float]:
    """Divide a sector from its right end to its left end."""
    first_rad, last_rad = sector_rad
    width_rad = (last_rad - first_rad) % (2.0 * math.pi) if last_rad < first_rad else last_rad - first_rad
    count = max(math.ceil(width_rad / _STEP_RAD), 1)
    return [first_rad + width_rad * step / count for step in range(count + 1)]


def _at(azimuth_rad: float, radius_m: float, height_m: float = 0.0) -> Xyz:
    return Xyz(radius_m * math.cos(azimuth_rad), radius_m * math.sin(azimuth_rad), height_m)


def _text(azimuth_rad: float, radius_m: float, text: str, color: tuple[float, float, float]) -> SceneText:
    return SceneText(Placed(_at(azimuth_rad, radius_m, 1.0)), text, Rgba(*color, 1.0))


def _pairs(**values: object) -> tuple[ScenePair, ...]:
    return tuple(ScenePair(key, _words(value)) for key, value in values.items() if value is not None)


def _words(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
