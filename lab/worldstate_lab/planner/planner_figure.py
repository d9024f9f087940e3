"""The figure of planners: a corner from above, a way through an empty one, braking against collisions."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate.operations.figure_style import BLUE, GREEN, ORANGE, RED, SKY, figure_file

from .closed_loop import sight_m
from .encounters import STEP_S, EgoVehicle, Encounters
from .planner_exam import CHANCE, FULL, LOUD, NOBODY, PHANTOM, SHARES, CornerDrives, Corners

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = {NOBODY: RED, PHANTOM: BLUE, FULL: ORANGE, CHANCE: GREEN, LOUD: SKY}
_TOLD = {NOBODY: "no knowledge", PHANTOM: "phantom at every corner", FULL: "phantom, full brakes"}
_ARM_M, _BEHIND_M, _BEYOND_M = 13.0, 9.0, 2.0


def write_planner_figure(
    corners: Corners,
    planners: Mapping[str, CornerDrives],
    curve: Sequence[Mapping[str, float | int]],
    figures: Mapping[str, Mapping[str, float | int]],
    ego: EgoVehicle,
    path: Path,
) -> None:
    """Draw one approach that hits who knows nothing, one empty corner, and what every threshold costs."""
    with figure_file(path, 11.0, 3.5) as figure:
        above, speeds, costs = figure.subplots(1, 3, width_ratios=(1.15, 1.0, 1.0))
        hit = planners[NOBODY].loud.collided & ~planners[CHANCE].loud.collided
        _draw_corner(above, corners.loud, int(np.flatnonzero(hit)[0]), planners, ego)
        _draw_speeds(speeds, corners.empty, planners)
        _draw_costs(costs, curve, figures)


def _draw_corner(
    axes: "Axes", met: Encounters, i: int, planners: Mapping[str, CornerDrives], ego: EgoVehicle
) -> None:
    """Draw the moment at which who knows nothing and who listens are farthest from being one."""
    from matplotlib.patches import Rectangle

    apart = planners[NOBODY].loud.front_m[i] - planners[CHANCE].loud.front_m[i]
    step = int(np.flatnonzero(apart > 1.0)[0])
    ahead, (left, right) = met.corner_ahead_m[i], met.corner_m[i]
    for y, width in ((left, _ARM_M), (-right - _ARM_M, _ARM_M)):
        axes.add_patch(Rectangle((y, -_BEHIND_M), width, ahead + _BEHIND_M, color="0.75", linewidth=0))
    for name in (NOBODY, CHANCE):
        front = planners[name].loud.front_m[i, step]
        body = (-0.5 * ego.width_m, front - ego.length_m), ego.width_m, ego.length_m
        axes.add_patch(Rectangle(*body, fill=False, edgecolor=_COLOURS[name], linewidth=1.8))
    eye = planners[CHANCE].loud.front_m[i, step] - ego.eye_m
    for side, sight in zip((1.0, -1.0), sight_m(met, np.full(len(met), eye))[i], strict=True):
        lane = met.lane_m[i, 0 if side > 0 else 1]
        axes.plot([0.0, side * sight], [eye, lane], color=GREEN, linewidth=0.8, linestyle=":")
    for k in np.flatnonzero(met.length_m[i]).tolist():
        y0, sign = met.to_come_m[i, step, k], 1.0 if met.side[i, k] == 0 else -1.0
        low = min(sign * y0, sign * (y0 + met.length_m[i, k]))
        corner = low, met.lane_m[i, met.side[i, k]] - 0.5 * met.width_m[i, k]
        axes.add_patch(Rectangle(corner, met.length_m[i, k], met.width_m[i, k], color="black"))
    far = met.lane_m[i].max() + _BEYOND_M
    axes.set(xlim=(_ARM_M, -_ARM_M), ylim=(-_BEHIND_M, far), aspect="equal")
    axes.set(xlabel="left, m", ylabel="ahead, m", title="a vehicle that neither of them sees yet")


def _draw_speeds(axes: "Axes", empty: Encounters, planners: Mapping[str, CornerDrives]) -> None:
    # The corner at which who listens brakes as long as in the mean: no picked one.
    braking = planners[CHANCE].empty.braking_s
    i = int(np.abs(braking - np.median(braking)).argmin())
    for name, told in (*_TOLD.items(), (CHANCE, "chance of the state")):
        front = planners[name].empty.front_m[i]
        driven = front < front[-1]
        speed = np.gradient(front, STEP_S)
        axes.plot((front - empty.line_m[i])[driven], 3.6 * speed[driven], color=_COLOURS[name], label=told)
    axes.axvline(0.0, color="0.75", linewidth=0.8, zorder=0)
    axes.set(xlabel="bumper beyond the line, m", ylabel="speed, km/h", ylim=(0.0, None))
    axes.set_title("an empty corner")
    axes.legend(loc="lower left", fontsize=8)


def _draw_costs(
    axes: "Axes", curve: Sequence[Mapping[str, float | int]], figures: Mapping[str, Mapping[str, float | int]]
) -> None:
    rare = f"needless_s_at_{SHARES[0]:g}"

    def place(one: Mapping[str, float | int]) -> tuple[float, float]:
        return one[rare], 1000.0 * one["loud_collisions"] / one["loud_replays"]

    axes.plot(*zip(*(place(one) for one in curve), strict=True), color=GREEN, marker=".", zorder=2)
    for name, one in figures.items():
        axes.plot(*place(one), color=_COLOURS[name], marker="o", markersize=8, linestyle="", clip_on=False)
    axes.set(xlabel=f"needless braking, s ({SHARES[0]:.0%} with a vehicle)", xlim=(0.0, None))
    axes.set(ylabel="collisions in 1,000 approaches", ylim=(0.0, None), title="what each threshold costs")
