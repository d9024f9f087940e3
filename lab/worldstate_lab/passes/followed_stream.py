"""What the filter believed along a stream: advisories, forecasts and entities at every hop."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.abduction.sequence.sequence_model import HORIZONS_S
from worldstate.abduction.sequence.street_hearing import StreetListener
from worldstate.adapters.acoustic_sequence import learn_passes
from worldstate.core.filter import WorldFilter
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.measurement.measurement import Measurement
from worldstate.state import Entity, WorldState


@dataclass(frozen=True, slots=True, eq=False)
class FollowedStream:
    """The snapshots of a stream by columns; sides are left and right."""

    time_s: FloatArray  # shape (n,)
    advisory: BoolArray  # shape (n, 2)
    risk: FloatArray  # shape (n, 2)
    within: FloatArray  # shape (n, 2, horizons); NaN where nothing is said
    time_to_visible_s: FloatArray  # shape (n, 2, 3): Low, best, high; NaN where none is stated
    entities: tuple[tuple[Entity, ...], ...]  # Of every hop

    def hidden(self, hop: int, side: int, least: float = 0.0) -> list[Entity]:
        """Return the entities hidden on a side at a hop that exist with at least this probability."""
        return [
            one
            for one in self.entities[hop]
            if one.status != "visible" and one.direction == SIDES[side]
            if one.existence_probability >= least
        ]


def followed(
    world: WorldFilter, measurements: Iterable[Measurement], street: StreetListener | None = None
) -> FollowedStream:
    """Filter a stream; return what was believed after every measurement. `street` is told who came."""
    states: list[WorldState] = []
    for measurement in measurements:
        world = world.update(measurement)
        learn_passes(street, world.state)
        states.append(world.state)
    cues = [sorted(state.cues, key=lambda cue: SIDES.index(cue.direction)) for state in states]
    nothing, never = [np.nan] * len(HORIZONS_S), [np.nan] * 3
    return FollowedStream(
        time_s=np.array([state.stamp_ns for state in states]) * 1e-9,
        advisory=np.array([[cue.advisory is not None for cue in hop] for hop in cues]),
        risk=np.array([[cue.risk for cue in hop] for hop in cues]),
        within=np.array([[list((cue.within or {}).values()) or nothing for cue in hop] for hop in cues]),
        time_to_visible_s=np.array([[cue.time_to_visible_s or never for cue in hop] for hop in cues]),
        entities=tuple(state.entities for state in states),
    )
