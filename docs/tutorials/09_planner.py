"""Read the state in a planner: brake at a blind corner only while the state says that a vehicle may come."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from tutorial_options import tutorial_options
from worldstate_lab.planner.encounters import EgoVehicle

from worldstate import WorldState, listen
from worldstate.adapters import open_source
from worldstate.operations.figure_style import CATEGORIES, figure_file
from worldstate.simulation import DatasetSettings, write_dataset

EGO, HOP_S, BEGINS_M = EgoVehicle(), 0.1, 20.0
THRESHOLDS = {"no knowledge": np.inf, "phantom": 0.0, "chance": 0.01}  # .01 is a choice, `planner` sets it


def chance(state: WorldState) -> float:
    """Return the larger chance of both sides within 3 s; one where nothing is said."""
    return max(1.0 if cue.within is None else cue.within["3"] for cue in state.cues)


def drive(states: list[WorldState], threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Return how far the bumper is beyond the line, metres, and the speed, state by state."""
    beyond_m, speed, way = -BEGINS_M, EGO.limit_mps, []
    for state in states:
        way.append((beyond_m, speed))
        assumed = chance(state) >= threshold and beyond_m < 0.0  # behind the line it sees for itself
        (safe,) = EGO.stopping_speed_mps(np.array([-beyond_m - EGO.gap_m]), EGO.reaction_s)
        wanted = min(safe if assumed else np.inf, EGO.limit_mps, speed + EGO.acceleration_mps2 * HOP_S)
        speed = max(wanted, speed - EGO.full_mps2 * HOP_S, 0.0)
        beyond_m += speed * HOP_S
    return np.array(way)[:, 0], np.array(way)[:, 1]


def main(out: Path, size: str = "full") -> None:
    """Draw three planners at approaches, and at empty corners below."""
    settings = DatasetSettings(n_static=2 if size == "small" else 4, seed=1, bandwidth_hz=2000.0)
    with TemporaryDirectory() as root, figure_file(out / "09_planner.png", 8.0, 4.4) as figure:
        rows = write_dataset(root, settings)
        grid = figure.subplots(2, len(rows) // 2, sharex=True, sharey=True, squeeze=False)
        for axes, row in zip(grid.T.flat, rows, strict=True):
            t0_s = open_source(Path(root) / row.folder).t0_s or 7.0
            begins_ns = 1e9 * (t0_s - BEGINS_M / EGO.limit_mps)  # at the limit it is at the line at T0
            states = [one for one in listen(Path(root) / row.folder) if one.stamp_ns >= begins_ns]
            for (name, threshold), colour in zip(THRESHOLDS.items(), CATEGORIES, strict=False):
                beyond_m, speed = drive(states, threshold)
                axes.plot(beyond_m, 3.6 * speed, "--" if name == "chance" else "-", color=colour, label=name)
                slow_s = HOP_S * np.sum((speed < EGO.limit_mps - 0.1) & (beyond_m < 0.0))
                there = beyond_m[round(BEGINS_M / EGO.limit_mps / HOP_S)]
                print(f"{row.environment} {row.approach}: {name} {slow_s:.1f} s slowed, {there:+.0f} m at T0")
            axes.set(xlim=(-20.0, 5.0), ylim=(0.0, None), title=f"{row.environment}: {row.approach}")
        figure.supxlabel("bumper beyond the line, m", fontsize=10)
        figure.supylabel("speed, km/h", fontsize=10)
        grid[0, 0].legend(loc="lower left")


if __name__ == "__main__":
    main(*tutorial_options(__doc__))
