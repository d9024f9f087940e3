"""A planner: be ready to stop at a blind corner only while a vehicle may come into view."""

from worldstate import WorldState, listen
from worldstate.simulation import DatasetSettings, write_dataset


def chance(state: WorldState) -> float:
    """Return the larger chance of the two sides within 3 s; 1 if the state has none."""
    return max(1.0 if cue.within is None else cue.within["3"] for cue in state.cues)


rows = write_dataset("out/tutorials/streets", DatasetSettings(n_static=2, seed=1, bandwidth_hz=2000.0))
runs = [[*listen(f"out/tutorials/streets/{row.folder}")] for row in rows]
for row, states in zip(rows, runs, strict=True):
    ready = sum(chance(state) >= 0.01 for state in states)
    print(f"vehicle: {row.approach}; ready to stop in {ready} of {len(states)} states")

# The figure: the speed of this planner, of one that always assumes a vehicle, and of one that never does.
import numpy as np
from tutorial_figures import tutorial_figure

LIMIT_MPS, HOP_S, BEGINS_M, BRAKES_MPS2 = 25.0 / 3.6, 0.1, 20.0, 3.0
THRESHOLDS = {"no knowledge": np.inf, "phantom": 0.0, "chance": 0.01}


def drive(states: list[WorldState], threshold: float) -> np.ndarray:
    """Return the position beyond the line in metres and the speed in km/h of a car, for each state."""
    beyond_m, speed, way = -BEGINS_M, LIMIT_MPS, []
    for state in states:
        way.append((beyond_m, 3.6 * speed))
        ready = chance(state) >= threshold and beyond_m < 0.0
        safe = np.sqrt(-2.0 * BRAKES_MPS2 * beyond_m) if ready else LIMIT_MPS
        speed = min(safe, LIMIT_MPS, speed + 2.0 * HOP_S)
        beyond_m += speed * HOP_S
    return np.array(way)


with tutorial_figure(__file__, 8.0, 3.2) as figure:
    for axes, row, states in zip(figure.subplots(1, 2, sharey=True), rows, runs, strict=True):
        begins_s = 0.1 * row.t0_frame - BEGINS_M / LIMIT_MPS  # reaches the line at T0 if it does not brake
        driven = [state for state in states if state.stamp_ns >= 1e9 * begins_s]
        for (name, threshold), dashes in zip(THRESHOLDS.items(), ("-", "-", "--"), strict=True):
            axes.plot(*drive(driven, threshold).T, dashes, label=name)
        axes.set(xlim=(-20.0, 5.0), ylim=(0.0, None), title=f"vehicle: {row.approach}")
    axes.legend(loc="lower left")
    figure.supxlabel("bumper beyond the line, m", fontsize=10)
    figure.supylabel("speed, km/h", fontsize=10)
