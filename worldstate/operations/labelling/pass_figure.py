"""Bird's-eye of the passes of a recording: smoothed tracks with ellipses, and the lines of sight at T0."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate.ground.typing import FloatArray
from worldstate.operations.figure_style import figure_file

from .pass_labels import PassLabel

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_EVERY = 5  # Half a second apart, they can still be told from one another
_FARTHEST_M = 40.0
_COLOURS = {"left": "tab:blue", "right": "tab:orange"}


def write_pass_figure(passes: Sequence[PassLabel], path: Path, title: str) -> None:
    """Draw every pass seen from above, the ego at the origin and looking up; hidden parts are dashed."""
    with figure_file(path, 7.0, 4.5) as figure:
        axes = figure.add_subplot()
        for one in passes:
            _draw(axes, one)
        axes.plot(0.0, 0.0, "k^", markersize=9)
        span = {"xlim": (_FARTHEST_M, -_FARTHEST_M), "ylim": (-2.0, 25.0)}
        axes.set(**span, xlabel="left, m", ylabel="ahead, m", title=title, aspect="equal")


def _draw(axes: "Axes", one: PassLabel) -> None:
    from matplotlib.patches import Ellipse

    states, colour = one.track.states, _COLOURS[one.arm]
    hidden = one.track.time_s < one.t0.time_s
    for part, style in ((hidden, "--"), (~hidden, "-")):
        axes.plot(states[part, 1], states[part, 0], style, color=colour, linewidth=1.2)
    for place, spread in zip(states[::_EVERY], one.track.covariance[::_EVERY], strict=True):
        lengths, axis = np.linalg.eigh(spread[:2, :2])
        angle = np.degrees(np.arctan2(axis[0, 1], axis[1, 1]))
        # Four deviations from end to end hold .86 of a Gaussian of two dimensions.
        along, across = 4.0 * np.sqrt(lengths[::-1])
        outline = Ellipse(
            (place[1], place[0]), along, across, angle=angle, fill=False, color=colour, alpha=0.3
        )
        axes.add_patch(outline)
    entry = _at(one, one.t0.time_s)
    axes.plot([0.0, entry[1]], [0.0, entry[0]], color="0.7", linewidth=0.8, zorder=0)
    axes.plot(entry[1], entry[0], "o", color=colour, markersize=4)


def _at(one: PassLabel, time_s: float) -> FloatArray:
    return np.array([np.interp(time_s, one.track.time_s, row) for row in one.track.states[:, :2].T])
