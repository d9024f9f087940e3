"""Snapshots of a short scripted approach: hidden on the left, then visible, then with a position."""

from dataclasses import replace

import numpy as np

from worldstate import Measurement, NotUsable, SignatureEvidence, WorldFilter, WorldState
from worldstate.abduction.co_evidence import Absent
from worldstate.abduction.sequence.sequence_model import GROUPS, SequenceAlarm
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.measurement import Look
from worldstate.state import Classification
from worldstate.state.sensor import Ego

SILENT, FLAT = NotUsable("not scripted"), SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)
# In the map its front points to the left of the x axis.
EGO = Ego((100.0, 50.0), 0.5 * np.pi, ((0.04, 0.0, 0.0), (0.0, 0.04, 0.0), (0.0, 0.0, 1e-4)), 0.0, 0.0, True)
SHARE = np.full(len(GROUPS), 1.0 / len(GROUPS))


def scripted_states(hops: int = 5) -> list[WorldState]:
    """Return one snapshot per hop with a hidden vehicle on the left, and two of it in view."""
    world, states = WorldFilter(), []
    for hop in range(1, hops + 1):
        sides = np.stack([_heard(0.9), _heard(0.01)])
        reading = SequenceReading(sides, SHARE, 0.2, SequenceAlarm(1.0, 20.0))
        look = Look("camera", hop * 10**8, Absent(0.1, 0.01))
        world = world.update(
            Measurement(hop * 10**8, FLAT, look.answer, SILENT, SILENT, (), look, None, sequence=reading)
        )
        states.append(replace(world.state, ego=EGO))
    return [*states[1:], *_in_view(states[-1])]


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


def _heard(coming: float) -> np.ndarray:
    # The other groups are empty; a vehicle on both sides is one of unknown side.
    groups = np.where([one.startswith("coming") for one in GROUPS], 0.0, 0.08 * (1.0 - coming))
    groups[GROUPS.index("coming_2s")], groups[GROUPS.index("seen")] = coming, 0.6 * (1.0 - coming)
    return groups
