"""The camera's measured miss rate beta: over the level of each degradation, and over the angle."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from worldstate.ground.typing import FloatArray, IntArray
from worldstate_lab.report.table import Figure, Value

from .panels import legend_below

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

_MARKS = ("o", "s", "^", "D", "v", "P")


def miss_rate_level_figure(families: Mapping[str, Sequence[tuple[str, Value]]]) -> Figure:
    """Draw beta over the level, one line a family; `families` holds (d as text, beta), clean first."""

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        for (name, levels), mark in zip(families.items(), _MARKS, strict=False):
            _line(axes, np.arange(len(levels)), [value for _, value in levels], mark, name)
        names = [level for level, _ in next(iter(families.values()), ())]
        axes.set_xticks(range(len(names)), names)
        axes.set(xlabel="staged degradation d", ylabel=r"miss rate $\beta$", ylim=(-0.02, 1.02))
        legend_below(canvas, columns=3)

    rows = [
        (name, level, value.value, value.low, value.high)
        for name, levels in families.items()
        for level, value in levels
    ]
    return Figure(
        "miss_rate_level",
        "Miss rate of the camera by degradation",
        "Share of the hops with a vehicle in view in which the detector reports none, with its 95 % interval "
        "over recordings. The paper: 0.04 clean at boresight, 0.97 in the harshest noise.",
        draw,
        ("family", "level", "miss_rate", "low", "high"),
        rows,
    )


def miss_rate_angle_figure(states: Mapping[str, Sequence[Value]], edges_deg: Sequence[float]) -> Figure:
    """Draw beta over |azimuth|, one line a state of the camera; one value between two edges."""
    middle = 0.5 * (np.asarray(edges_deg)[1:] + np.asarray(edges_deg)[:-1])

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        for (name, values), mark in zip(states.items(), _MARKS, strict=False):
            _line(axes, middle, values, mark, name)
        axes.set(xlabel="angle off boresight |azimuth| (deg)", ylabel=r"miss rate $\beta$")
        axes.set(ylim=(-0.02, 1.02), xlim=(edges_deg[0], edges_deg[-1]))
        # The last edge is that of the view, such as 35.19 degrees.
        axes.set_xticks(list(edges_deg), [f"{edge:.0f}" for edge in edges_deg])
        legend_below(canvas, columns=2)

    rows = [
        (name, low, high, value.value, value.low, value.high)
        for name, values in states.items()
        for low, high, value in zip(edges_deg[:-1], edges_deg[1:], values, strict=True)
    ]
    return Figure(
        "miss_rate_angle",
        "Miss rate of the camera by angle",
        "As before, by the angle between the vehicle and the optical axis. The paper, clean camera: 0.04 at "
        "boresight, 0.14 at 20 to 30 degrees.",
        draw,
        ("state", "from_deg", "to_deg", "miss_rate", "low", "high"),
        rows,
    )


def _line(axes: "Axes", x: FloatArray | IntArray, values: Sequence[Value], mark: str, label: str) -> None:
    known = np.array([value.value for value in values])
    (line,) = axes.plot(x, known, marker=mark, ms=4, label=label)
    axes.fill_between(
        x, [v.low for v in values], [v.high for v in values], color=line.get_color(), alpha=0.13, lw=0
    )
