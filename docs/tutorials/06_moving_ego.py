"""An ego that drives up to the corner: its own noise, the model for it, and how often it warns."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from tutorial_options import tutorial_options

from worldstate import listen
from worldstate.operations.figure_style import DECISION, HIDDEN, SIDE_DASHES, TRUTH, figure_file
from worldstate.simulation import draw_settings, simulate_recording, write_recording


def main(out: Path, size: str = "full") -> None:
    """Draw the risk of either side along drives towards blind junctions, with the ego's speed."""
    sites = ["DA1"] if size == "small" else ["DA1", "DB1"]
    comes = [(site, approach) for site in sites for approach in ("left", "none")]
    with TemporaryDirectory() as root, figure_file(out / "06_moving_ego.png", 8.0, 4.4) as figure:
        grid = figure.subplots(2, len(comes), sharex=True, sharey="row", height_ratios=(2, 1))
        for number, (site, approach) in enumerate(comes):
            rng = np.random.default_rng(number)
            settings = replace(draw_settings(site, approach, rng), sample_rate_hz=6000.0)
            row = write_recording(root, simulate_recording(settings, rng), number)
            states = list(listen(Path(root) / row.folder))
            time_s = np.array([state.stamp_ns / 1e9 for state in states])
            risk, speed = grid[:, number]
            for side, dashes, y in zip(("left", "right"), SIDE_DASHES, (0.97, 0.9), strict=False):
                cues = [next(c for c in state.cues if c.direction == side) for state in states]
                risk.plot(time_s, [cue.risk for cue in cues], dashes, color=HIDDEN, label=side)
                on = [cue.advisory is not None for cue in cues]
                risk.plot(time_s, np.where(on, y, np.nan), dashes, color=DECISION, linewidth=3.0)
                print(f"{site}, {approach}: {side} at most {max(c.risk for c in cues):.2f}, ", end="")
                print(f"advisory in {sum(on)} of {len(on)} hops")
            if approach != "none":
                risk.axvline(settings.entry_s, color=TRUTH, linestyle=":")
            speed.plot(time_s, 3.6 * settings.ego.at_mps(time_s), color="black")
            risk.set(ylim=(0.0, 1.0), xticks=(0, 5, 10), title=f"{site}: {approach}")
        grid[0, 0].set(ylabel="risk")
        grid[0, 0].legend(loc="upper left")
        grid[1, 0].set(ylabel="ego, km/h")
        figure.supxlabel("time, s", fontsize=10)
    print(f"chances over time: {states[-1].cues[0].within}; calibrated: {states[-1].calibrated}")


if __name__ == "__main__":
    main(*tutorial_options(__doc__))
