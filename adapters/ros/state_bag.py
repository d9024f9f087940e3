"""World-states as a bag: risk advisories, objects, markers that RViz draws, and the snapshots themselves."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from worldstate.adapters.export.lane_objects import CROSSING_M, autoware_objects
from worldstate.adapters.export.scene import SceneItem, scene_update
from worldstate.ground.serialisation import encode
from worldstate.state import RiskCue, WorldState

from .bag_input import open_bag
from .bag_writer import Storage, bag_writer
from .message_types import ADVISORIES, MARKERS, OBJECTS, TEXT, header, time_of

ADVISORIES_TOPIC, OBJECTS_TOPIC = "/worldstate/advisories", "/worldstate/objects"
MARKERS_TOPIC, SNAPSHOT_TOPIC = "/worldstate/markers", "/worldstate/snapshot"
# Of visualization_msgs/Marker.
ARROW, CUBE, LINE_STRIP, LABEL, TRIANGLE_LIST = 0, 1, 4, 9, 11
ADD, DELETE_ALL = 0, 3


@contextmanager
def state_bag(
    path: Path, crossing_m: float = CROSSING_M, storage: Storage = "mcap"
) -> Iterator[Callable[[WorldState], None]]:
    """Lend a function that writes states to a new bag."""
    with bag_writer(path, storage) as write:

        def write_state(state: WorldState) -> None:
            write(ADVISORIES_TOPIC, ADVISORIES, state.stamp_ns, risk_advisories(state))
            write(OBJECTS_TOPIC, OBJECTS, state.stamp_ns, autoware_objects(state, crossing_m))
            write(MARKERS_TOPIC, MARKERS, state.stamp_ns, scene_markers(state))
            write(SNAPSHOT_TOPIC, TEXT, state.stamp_ns, {"data": state.to_json()})

        yield write_state


def bag_snapshot_lines(path: Path) -> Iterator[str]:
    """Yield the snapshots of a bag as the text that was written."""
    with open_bag(path) as bag:
        if bag.count(SNAPSHOT_TOPIC) and bag.kind_of(SNAPSHOT_TOPIC) == TEXT:
            for _, message in bag.messages(SNAPSHOT_TOPIC):
                yield message.data


def risk_advisories(state: WorldState) -> dict[str, Any]:
    """Return the values of a RiskAdvisories message.

    Examples
    --------
    >>> risk_advisories(WorldState(0, 3))["seq"]
    3
    """
    return {
        "header": header(state.stamp_ns, state.frame_id),
        "seq": state.seq,
        "valid_until": time_of(state.valid_until_ns or 0),
        "calibrated": state.calibrated,
        "advisories": [_advisory(cue) for cue in state.cues],
    }


def _advisory(cue: RiskCue) -> dict[str, Any]:
    out = cue.advisory
    within = cue.within or {}
    return {
        "direction": cue.direction,
        "azimuth": cue.azimuth_rad,
        "azimuth_std": cue.azimuth_std_rad,
        "risk": cue.risk,
        "confidence": cue.confidence,
        "hidden": cue.hypotheses.hidden,
        "visible": cue.hypotheses.visible,
        "none": cue.hypotheses.none,
        "raised": out is not None,
        "since": time_of(0 if out is None else out.since_ns),
        "valid_until": time_of(0 if out is None else out.valid_until_ns),
        "alpha": [] if cue.alpha is None else [cue.alpha],
        "horizon": [float(horizon) for horizon in within],
        "within": list(within.values()),
        "time_to_visible": list(cue.time_to_visible_s or ()),
        "entity_id": cue.entity_id or "",
    }


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
        yield _shape(LABEL, text, (0.0, 0.0, text.font_size), text=text.text)


def _shape(kind: int, drawn: Any, scale: tuple[float, float, float], **more: Any) -> dict[str, Any]:
    x, y, z = scale
    size = {"x": x, "y": y, "z": z}
    return {"type": kind, "pose": encode(drawn.pose), "scale": size, "color": encode(drawn.color)} | more
