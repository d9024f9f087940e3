"""The scene of a snapshot as markers, which RViz draws."""

from collections.abc import Iterator
from typing import Any

from worldstate.adapters.export.scene import scene_update
from worldstate.adapters.export.scene_messages import SceneItem
from worldstate.ground.serialisation import encode
from worldstate.state import WorldState

from .message_types import header

# Of visualization_msgs/Marker.
ARROW, CUBE, LINE_STRIP, TEXT, TRIANGLE_LIST = 0, 1, 4, 9, 11
ADD, DELETE_ALL = 0, 3


def scene_markers(state: WorldState) -> dict[str, Any]:
    """Return the values of a MarkerArray: what was drawn before goes, what the snapshot says comes.

    Examples
    --------
    >>> [one["ns"] for one in scene_markers(WorldState(0, 0))["markers"]][:3]
    ['', 'ego', 'occluder corner_left']
    """
    head = header(state.stamp_ns, state.frame_id)
    markers: list[dict[str, Any]] = [{"header": head, "ns": "", "action": DELETE_ALL}]
    for item in scene_update(state).entities:
        lifetime = {"sec": item.lifetime.sec, "nanosec": item.lifetime.nsec}
        for number, shape in enumerate(_shapes(item)):
            named = {"header": head, "ns": item.id, "id": number, "action": ADD}
            markers.append(named | {"lifetime": lifetime, "frame_locked": item.frame_locked} | shape)
    return {"markers": markers}


def _shapes(item: SceneItem) -> Iterator[dict[str, Any]]:
    for arrow in item.arrows:
        length = arrow.shaft_length + arrow.head_length
        yield _shape(ARROW, arrow, (length, arrow.shaft_diameter, arrow.shaft_diameter))
    for cube in item.cubes:
        yield _shape(CUBE, cube, (cube.size.x, cube.size.y, cube.size.z))
    for line in item.lines:
        yield _shape(
            LINE_STRIP, line, (line.thickness, 0.0, 0.0), points=[encode(one) for one in line.points]
        )
    for area in item.triangles:
        yield _shape(TRIANGLE_LIST, area, (1.0, 1.0, 1.0), points=[encode(one) for one in area.points])
    for text in item.texts:
        yield _shape(TEXT, text, (0.0, 0.0, text.font_size), text=text.text)


def _shape(kind: int, drawn: Any, scale: tuple[float, float, float], **more: Any) -> dict[str, Any]:
    x, y, z = scale
    size = {"x": x, "y": y, "z": z}
    return {"type": kind, "pose": encode(drawn.pose), "scale": size, "color": encode(drawn.color)} | more
