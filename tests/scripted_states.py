"""Snapshots of a short scripted approach: hidden on the left, then visible, then with a position."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from street_measurements import EVEN, hop, reading

from worldstate import WorldFilter, WorldState
from worldstate.abduction.co_evidence import Absent
from worldstate.abduction.sequence.sequence_model import GROUPS
from worldstate.measurement import Look
from worldstate.state import Classification
from worldstate.state.sensor import Ego

# In the map its front points to the left of the x axis.
EGO = Ego((100.0, 50.0), 0.5 * np.pi, ((0.04, 0.0, 0.0), (0.0, 0.04, 0.0), (0.0, 0.0, 1e-4)), 0.0, 0.0, True)


def scripted_states(hops: int = 5) -> list[WorldState]:
    """Return one snapshot per hop with a hidden vehicle on the left, and two of it in view."""
    world, states, coming = WorldFilter(), [], np.array([0.9, 0.01])
    # The other bins are empty; a vehicle on both sides is one of unknown side.
    bins = {name: 0.0 for name in GROUPS if name.startswith("coming")}
    rest = {name: 0.08 * (1.0 - coming) for name in GROUPS if name not in bins}
    weights = bins | rest | {"coming_2s": coming, "seen": 0.6 * (1.0 - coming)}
    said = replace(reading(weights, 1.0, share=EVEN), margin_s=0.2)
    for number in range(1, hops + 1):
        look = Look("camera", number * 10**8, Absent(0.1, 0.01))
        world = world.update(hop(number, answer=look.answer, look=look, sequence=said))
        states.append(replace(world.state, ego=EGO))
    return [*states[1:], *_in_view(states[-1])]


def write_states(path: Path, states: list[WorldState]) -> Path:
    """Write snapshots as JSON lines."""
    path.write_text("".join(state.to_json() + "\n" for state in states))
    return path


def _in_view(last: WorldState) -> list[WorldState]:
    """Return the snapshots in view: by azimuth only, then with a position."""
    seen = replace(
        last.entities[0], status="visible", hidden_probability=0.0, existence_probability=0.98,
        azimuth_rad=0.5, azimuth_std_rad=0.03, sector_rad=None, sides=(),
        classification=(Classification("car", 0.7), Classification("unknown", 0.3)),
        forecast={"1": (0.2, 0.05), "2": (-0.2, 0.1)},
    )  # fmt: skip
    placed = replace(seen, position_m=(8.0, 4.4, 0.0), velocity_mps=(0.0, -4.0, 0.0), range_m=9.1)
    after = [replace(last, stamp_ns=last.stamp_ns + 10**8 * k, seq=last.seq + k) for k in (1, 2)]
    return [replace(after[0], entities=(seen,)), replace(after[1], entities=(placed,))]
