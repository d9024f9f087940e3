"""Bird's-eye of a street as it was learned: lines of sight past its edges, and where who comes is."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate.operations.figure_style import BLUE, GREEN, figure_file
from worldstate.smoothing.learned_street import LearnedStreet, context_of
from worldstate.state.context import Context, Occluder

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Bearings hold no metres: places are drawn on a lane this far ahead, where that of OVAD's junctions lies.
_LANE_M = 9.0
_BEFORE_S, _APART_M = (1.0, 2.0, 3.0), 1.3  # Rows of the drawing, so that their bars do not hide one another
_WIDEST_M, _COLUMNS = 26.0, 2


def write_street_figure(
    stages: Sequence[tuple[str, LearnedStreet]], path: Path, truth: Context | None = None
) -> None:
    """Draw a street at some stages side by side, the ego at the origin and looking up.

    Filled is where the edge is believed, two deviations either way; the dots of a row are the median driver
    1, 2 or 3 s before line of sight, bars one deviation of pace. True edges are green and dashed.
    """
    columns = min(len(stages), _COLUMNS)
    rows = math.ceil(len(stages) / columns)
    with figure_file(path, 4.6 * columns, 2.3 * rows) as figure:
        for number, (title, street) in enumerate(stages, start=1):
            axes = figure.add_subplot(rows, columns, number)
            for occluder, arm in zip(context_of(street).occluders, street.arms, strict=True):
                _draw_learned(axes, occluder, arm.pace_spread)
            for occluder in () if truth is None else truth.occluders:
                end_m = _aside_m(occluder.edge_azimuth_rad)
                axes.plot([0.0, end_m], [0.0, _LANE_M], "--", color=GREEN)
            axes.plot(0.0, 0.0, "k^", markersize=8)
            axes.set(xlim=(_WIDEST_M, -_WIDEST_M), ylim=(-1.0, 15.0), title=title, aspect="equal")
            axes.set(
                xlabel="left, m" if number > len(stages) - columns else "",
                ylabel="ahead, m" if number % columns == 1 % columns else "",
            )


def draw_edge(axes: "Axes", one: Occluder, color: str = BLUE) -> None:
    """Draw the line of sight past an edge as it is believed, two deviations either way."""
    low, high = (_aside_m(one.edge_azimuth_rad + k * one.edge_std_rad) for k in (-2.0, 2.0))
    axes.fill([0.0, low, high], [0.0, _LANE_M, _LANE_M], color=color, alpha=0.25, linewidth=0.0)
    axes.plot([0.0, _aside_m(one.edge_azimuth_rad)], [0.0, _LANE_M], color=color, label="edge, as learned")


def _draw_learned(axes: "Axes", one: Occluder, pace_spread: float) -> None:
    draw_edge(axes, one)
    for row, time_s in enumerate(_BEFORE_S, start=1):
        ahead_m = _LANE_M + _APART_M * row
        factors = math.exp(-pace_spread), 1.0, math.exp(pace_spread)
        slow, usual, fast = (_place_m(one, factor, time_s) for factor in factors)
        axes.plot([slow, fast], [ahead_m, ahead_m], color=BLUE, alpha=0.3, linewidth=4.0)
        axes.plot(usual, ahead_m, "o", color=BLUE, markersize=4)


def _aside_m(azimuth_rad: float) -> float:
    return _LANE_M * math.tan(azimuth_rad)


def _place_m(one: Occluder, factor: float, time_s: float) -> float:
    """Return where somebody is so long before line of sight, metres to the left on the drawn lane."""
    slope = math.tan(abs(one.edge_azimuth_rad)) + factor * one.pace_hz * time_s
    return math.copysign(_LANE_M * slope, one.edge_azimuth_rad)
