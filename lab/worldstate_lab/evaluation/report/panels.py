"""What the panels of a report share: marks and colours, a legend below the axes, thinned curves."""

from typing import TYPE_CHECKING

import numpy as np

from worldstate.ground.typing import FloatArray
from worldstate.operations.figure_style import BLUE, GREEN, ORANGE, PURPLE, RED, SKY

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

# A curve of more points than this looks the same at 600 pixels, and its CSV takes megabytes.
MOST_POINTS = 200
GREY = "0.55"
MARKS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*")
COLOURS = (BLUE, RED, GREEN, ORANGE, PURPLE, SKY)


def legend_below(canvas: "Canvas", columns: int = 2) -> None:
    """Put one legend below all axes, where it hides no data, each label once."""
    found = [axes.get_legend_handles_labels() for axes in canvas.axes]
    once = {label: handle for handles, labels in found for handle, label in zip(handles, labels, strict=True)}
    if once:
        canvas.legend(once.values(), once.keys(), loc="outside lower left", ncols=columns, fontsize=8.5)


def thinned(*columns: FloatArray) -> tuple[FloatArray, ...]:
    """Return evenly spaced rows of curves that have too many, ends included."""
    n = len(columns[0])
    kept = np.unique(np.linspace(0, n - 1, min(n, MOST_POINTS)).astype(int)) if n else np.arange(0)
    return tuple(column[kept] for column in columns)


def mark_chance(axes: "Axes") -> None:
    """Draw the diagonal: chance of a ROC, perfect calibration of a reliability curve."""
    axes.plot([0.0, 1.0], [0.0, 1.0], color=GREY, linewidth=0.8, zorder=0)
    axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.02))
