"""Panels on a camera that fails: its miss rate by level and by angle, and hazard awareness over it."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from worldstate.ground.typing import FloatArray, IntArray
from worldstate_lab.report.table import Figure, Value

from .panels import GREY, MARKS, legend_below

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas


def miss_rate_level_figure(families: Mapping[str, Sequence[tuple[str, Value]]]) -> Figure:
    """Draw beta over the level, one line a family; `families` holds (d as text, beta), clean first."""
    levels = [level for level, _ in next(iter(families.values()), ())]

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        rates = {name: [value for _, value in one] for name, one in families.items()}
        _bands(axes, {name: (np.arange(len(one)), one) for name, one in rates.items()})
        axes.set_xticks(range(len(levels)), levels)
        axes.set(xlabel="staged degradation d", ylabel=r"miss rate $\beta$", ylim=(-0.02, 1.02))
        legend_below(canvas, columns=3)

    return Figure(
        "miss_rate_level",
        "Miss rate of the camera by degradation",
        "Share of the hops with a vehicle in view in which the detector reports none, with its 95 % interval "
        "over recordings. The paper: 0.04 clean at boresight, 0.97 in the harshest noise.",
        draw,
        ("family", "level", "miss_rate"),
        [(name, level, value) for name, one in families.items() for level, value in one],
    )


def miss_rate_angle_figure(states: Mapping[str, Sequence[Value]], edges_deg: Sequence[float]) -> Figure:
    """Draw beta over |azimuth|, one line a state of the camera; one value between two edges."""
    middle = 0.5 * (np.asarray(edges_deg)[1:] + np.asarray(edges_deg)[:-1])

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        _bands(axes, {name: (middle, values) for name, values in states.items()})
        axes.set(xlabel="angle off boresight |azimuth| (deg)", ylabel=r"miss rate $\beta$")
        axes.set(ylim=(-0.02, 1.02), xlim=(edges_deg[0], edges_deg[-1]))
        # The last edge is that of the view, such as 35.19 degrees.
        axes.set_xticks(list(edges_deg), [f"{edge:.0f}" for edge in edges_deg])
        legend_below(canvas)

    return Figure(
        "miss_rate_angle",
        "Miss rate of the camera by angle",
        "As before, by the angle between the vehicle and the optical axis. The paper, clean camera: 0.04 at "
        "boresight, 0.14 at 20 to 30 degrees.",
        draw,
        ("state", "from_deg", "to_deg", "miss_rate"),
        [
            (name, *row)
            for name, values in states.items()
            for row in zip(edges_deg[:-1], edges_deg[1:], values, strict=True)
        ],
    )


def awareness_figure(families: Mapping[str, Sequence[tuple[Value, Value]]], paper_least: float) -> Figure:
    """Draw hazard awareness over the measured miss rate beta, one line a family of degradations.

    `families` holds (beta, awareness) by level, the clean camera first.
    """

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        axes.plot([0.0, 1.0], [1.0, 0.0], color=GREY, linestyle="--", label=r"vision alone, $1-\beta$")
        pairs = {name: tuple(zip(*levels, strict=True)) for name, levels in families.items()}
        _bands(
            axes, {name: (np.array([b.value for b in beta]), aware) for name, (beta, aware) in pairs.items()}
        )
        axes.axhline(paper_least, color="black", linewidth=0.9, linestyle=":", label="paper, least")
        axes.set(xlabel=r"measured miss rate $\beta$ of the camera", ylabel="hazard awareness after $T_0$")
        axes.set(xlim=(-0.02, 1.02), ylim=(0.0, 1.03))
        legend_below(canvas)

    return Figure(
        "cueing_awareness",
        "(d) Hazard awareness while the camera fails",
        "Share of the hops after T0 in which the vehicle is seen or reported, over the share that the camera "
        "misses; level 0 is the clean camera. Bands are 95 % intervals over recordings.",
        draw,
        ("family", "level", "miss_rate", "awareness"),
        [
            (name, level, beta.value, aware)
            for name, levels in families.items()
            for level, (beta, aware) in enumerate(levels)
        ],
        size_in=(4.4, 4.2),
    )


def _bands(axes: "Axes", lines: Mapping[str, tuple[FloatArray | IntArray, Sequence[Value]]]) -> None:
    """Draw a line with its band of intervals for each name."""
    for (name, (x, values)), mark in zip(lines.items(), MARKS, strict=False):
        (line,) = axes.plot(x, [v.value for v in values], marker=mark, ms=4, label=name)
        low, high = [v.low for v in values], [v.high for v in values]
        axes.fill_between(x, low, high, color=line.get_color(), alpha=0.13, lw=0)
