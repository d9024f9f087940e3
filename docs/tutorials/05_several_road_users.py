"""Vehicles that come from both sides, one shortly after the other: entities, hand-over, chances."""

import math
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from tutorial_options import tutorial_options

from worldstate import listen
from worldstate.operations.figure_style import HIDDEN, IN_VIEW, SIDE_DASHES, TRUTH, figure_file
from worldstate.simulation import VehicleSettings, draw_settings, simulate_recording, write_recording

COLOURS = {"hidden": HIDDEN, "emerged": IN_VIEW, "visible": IN_VIEW}


def main(out: Path, size: str = "full") -> None:
    """Draw where every entity is believed, and the chance of either side."""
    comes = [("left", 5.0), ("right", 6.0)]
    if size == "full":
        comes = [("left", 6.0), ("right", 7.5), ("left", 13.0)]
    rng = np.random.default_rng(2)
    drawn = draw_settings("SB2", "left", rng, duration_s=7.0 if size == "small" else 16.0)
    others = tuple(VehicleSettings(side, entry_s=at, speed_mps=5.0) for side, at in comes[1:])
    settings = replace(drawn, entry_s=comes[0][1], speed_mps=5.0, braking_mps2=0.0, others=others)
    with TemporaryDirectory() as root:
        recording = simulate_recording(replace(settings, parked_car=False, sample_rate_hz=6000.0), rng)
        states = list(listen(Path(root) / write_recording(root, recording).folder))
    time_s = [state.stamp_ns / 1e9 for state in states]
    with figure_file(out / "05_several_road_users.png", 8.0, 4.4) as figure:
        where, chance = figure.subplots(2, 1, sharex=True)
        for at, state in zip(time_s, states, strict=True):
            for one in state.entities:
                middle, std = math.degrees(one.azimuth_rad), math.degrees(one.azimuth_std_rad)
                colour = COLOURS[one.status]
                where.plot([at, at], [middle - std, middle + std], color=colour, linewidth=1.0, alpha=0.5)
                where.plot(at, middle, ".", color=colour, markersize=4, label=one.status)
            for event in (one for one in state.events if one.kind in ("handed_over", "merged")):
                print(f"{at:.1f} s: {event.entity_id[:8]} {event.kind}")
        for side, dashes in zip(("left", "right"), SIDE_DASHES, strict=False):
            within = [next(c for c in state.cues if c.direction == side).within for state in states]
            told = [math.nan if w is None else w["3"] for w in within]
            chance.plot(time_s, told, dashes, color=HIDDEN, label=side)
        for side, at in comes:
            where.axvline(at, color=TRUTH, linestyle=":", linewidth=1.0)
            where.text(at, 78.0, f" {side}", fontsize=9)
            chance.axvline(at, color=TRUTH, linestyle=":", linewidth=1.0)
        marks, names = where.get_legend_handles_labels()
        where.legend(dict(zip(names, marks, strict=True)).values(), dict.fromkeys(names), loc="lower left")
        where.set(ylim=(-95.0, 95.0), ylabel="azimuth, degrees\n(left positive)")
        chance.set(ylim=(0.0, 1.0), xlim=(0.0, None), xlabel="time, s", ylabel="chance within 3 s")
        chance.legend(loc="upper left")
    most = max(sum(one.status == "hidden" for one in state.entities) for state in states)
    print(f"at most {most} hidden at once; {len({e.id for s in states for e in s.entities})} identities")


if __name__ == "__main__":
    main(*tutorial_options(__doc__))
