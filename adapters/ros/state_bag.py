"""World-states as a bag: risk advisories, objects, markers, and the snapshots themselves."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from worldstate.adapters.export.autoware import autoware_objects
from worldstate.adapters.export.lane_objects import CROSSING_M
from worldstate.state import RiskCue, WorldState

from .bag_reader import open_bag
from .bag_writer import Storage, bag_writer
from .message_types import ADVISORIES, MARKERS, OBJECTS, TEXT, header, time_of
from .scene_markers import scene_markers

ADVISORIES_TOPIC, OBJECTS_TOPIC = "/worldstate/advisories", "/worldstate/objects"
MARKERS_TOPIC, SNAPSHOT_TOPIC = "/worldstate/markers", "/worldstate/snapshot"


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
