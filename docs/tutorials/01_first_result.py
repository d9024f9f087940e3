"""Blind corners, heard: simulate recordings, listen, and draw what the state says of either side."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from tutorial_options import tutorial_options

from worldstate import WorldState, listen
from worldstate.adapters import open_source
from worldstate.operations.figure_style import DECISION, HIDDEN, SIDE_DASHES, TRUTH, figure_file
from worldstate.simulation import DatasetSettings, write_dataset

DASHES = dict(zip(("left", "right"), SIDE_DASHES, strict=False))


def chance(state: WorldState, side: str) -> float:
    """Return the probability that a vehicle comes into view from a side within three seconds."""
    (cue,) = (one for one in state.cues if one.direction == side)
    return float("nan") if cue.within is None else cue.within["3"]


def main(out: Path, size: str = "full") -> None:
    """Draw two approaches and two recordings without a vehicle; one of each kind if size == "small"."""
    # Sound up to 2 kHz is all that the front-end reads, at an eighth of the samples.
    settings = DatasetSettings(n_static=2 if size == "small" else 4, seed=1, bandwidth_hz=2000.0)
    with TemporaryDirectory() as root, figure_file(out / "01_first_result.png", 8.0, 4.2) as figure:
        rows = write_dataset(root, settings)
        grid = figure.subplots(2, len(rows) // 2, sharex=True, sharey=True, squeeze=False)
        for axes, row in zip(grid.T.flat, rows, strict=True):
            states = list(listen(Path(root) / row.folder))
            time_s = [state.stamp_ns / 1e9 for state in states]
            t0_s = open_source(Path(root) / row.folder).t0_s
            warned = []
            for y, (side, dashes) in zip((0.97, 0.9), DASHES.items(), strict=True):
                axes.plot(time_s, [chance(s, side) for s in states], dashes, color=HIDDEN, label=side)
                on = [any(c.advisory and c.direction == side for c in state.cues) for state in states]
                warned += [f"{side} at {time_s[on.index(True)]:.1f} s"] if any(on) else []
                axes.plot(time_s, np.where(on, y, np.nan), dashes, color=DECISION, lw=3.0)
            came = f"from the {row.approach}" if row.approach != "none" else "no vehicle comes"
            if row.approach != "none" and t0_s is not None:
                axes.axvline(t0_s, color=TRUTH, linestyle=":")
                came += f", in view at {t0_s:.1f} s"
            axes.set(ylim=(0.0, 1.0), title=f"{row.environment}: {came}")
            print(f"{row.environment}, {came}; advisory {', '.join(warned) or 'none'}")
        figure.supxlabel("time, s", fontsize=10)
        figure.supylabel("chance to come into view within 3 s", fontsize=10)
        grid[0, 0].legend(loc="upper left")


if __name__ == "__main__":
    main(*tutorial_options(__doc__))
