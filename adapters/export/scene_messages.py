"""Foxglove's scene and image messages, with the fields of their published JSON form."""

from dataclasses import dataclass
from typing import Annotated, TypeAlias

from worldstate.ground.serialisation import Check, Count, Probability

# Primitives that are not drawn here; the message has a list of them all the same.
NoPrimitives: TypeAlias = Annotated[
    tuple[str, ...], Check("an empty list", lambda value: not value, {"maxItems": 0})
]
# In the words of JSON Schema; it is what tells a viewer to decode the text.
Base64: TypeAlias = Annotated[str, Check("base64", str.isascii, {"contentEncoding": "base64"})]


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
    """What appears in a scene and what goes, as `foxglove.SceneUpdate`."""

    deletions: tuple[SceneRemoval, ...]
    entities: tuple[SceneItem, ...]


@dataclass(frozen=True, slots=True)
class CompressedImage:
    """An image of the camera, as `foxglove.CompressedImage`."""

    timestamp: SceneTime
    frame_id: str
    data: Base64
    format: str = "jpeg"
