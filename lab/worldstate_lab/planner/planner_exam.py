"""What planners make of the same corners: collisions, needless braking, time lost."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

import numpy as np

from worldstate.ground.typing import FloatArray, IndexArray
from worldstate.operations.figure_style import BLUE, GREEN, ORANGE, RED, SKY, figure_file
from worldstate.operations.metrics.approach_table import share_interval
from worldstate_lab.metrics.intervals import draw_weights, middle, stratified_draws

from .closed_loop import Drives, drive_through, sight_m
from .encounters import (
    STEP_S,
    BelievedStream,
    EgoVehicle,
    Encounters,
    approach_encounters,
    empty_encounters,
    recorded_approaches,
)

Of = TypeVar("Of")
UNAWARE, PHANTOM, FULL, CHANCE, LOUD = (
    "no knowledge",
    "phantom",
    "phantom, full brakes",
    "chance",
    "chance, loud",
)
THRESHOLDS = tuple(round(0.001 * 2.0 ** (0.5 * step), 4) for step in range(13))
# Of corners at which a vehicle comes.
SHARES = (0.05, 0.2)
HARD_MPS2 = 4.0
_QUIET = 100_000  # Numbers of quiet approaches beside those of loud ones


class ByKind(NamedTuple, Generic[Of]):
    """One thing each of loud approaches, of those with a quiet vehicle, and of moments without vehicles."""

    loud: Of
    quiet: Of
    empty: Of


Corners = ByKind[Encounters]
CornerDrives = ByKind[Drives]  # One planner's, through such corners


def draw_corners(
    streams: Sequence[BelievedStream], count: int, ego: EgoVehicle, rng: np.random.Generator
) -> Corners:
    """Draw approaches of loud vehicles, quiet ones by their share, and as many moments without vehicles."""
    loud, quiet = approaches_drawn(streams, count, ego, rng)
    return Corners(loud, quiet, empty_encounters([one for one in streams if not one.ways], count, rng))


def approaches_drawn(
    streams: Sequence[BelievedStream], count: int, ego: EgoVehicle, rng: np.random.Generator
) -> tuple[Encounters, Encounters]:
    """Draw so many approaches of loud vehicles, and of quiet ones as many as their share asks for."""
    loud, quiet = (recorded_approaches(streams, quiet=kind) for kind in (False, True))
    quiet_count = max(round(count * len(quiet) / max(len(loud), 1)), 1)
    return approach_encounters(loud, count, ego, rng), approach_encounters(quiet, quiet_count, ego, rng)


def safe_threshold(approached: Sequence[Encounters], ego: EgoVehicle) -> float:
    """Return the threshold below the largest up to which no vehicle is hit; 0, the phantom, without one."""
    # What hits no vehicle at some 130 approaches may hit one elsewhere: one step is kept in hand.
    kept = 0.0
    for lower, threshold in pairwise((0.0, *THRESHOLDS)):
        if any(drive_through(one, threshold, ego).collided.any() for one in approached):
            break
        kept = lower
    return kept


def drives_of(corners: Corners, threshold: float, ego: EgoVehicle) -> CornerDrives:
    """Return the drives of the planner that assumes vehicles from a chance on."""
    return CornerDrives(*(drive_through(one, threshold, ego) for one in corners))


def every_planner(corners: Corners, chance: float, loud: float, ego: EgoVehicle) -> dict[str, CornerDrives]:
    """Return the drives of all planners; only the one with full brakes has another stopping law."""
    return {
        UNAWARE: drives_of(corners, np.inf, ego),
        PHANTOM: drives_of(corners, 0.0, ego),
        FULL: drives_of(corners, 0.0, replace(ego, comfortable_mps2=ego.full_mps2)),
        CHANCE: drives_of(corners, chance, ego),
        LOUD: drives_of(corners, loud, ego),
    }


def planner_figures(
    corners: Corners, planners: Mapping[str, CornerDrives], rng: np.random.Generator
) -> dict[str, dict[str, float | int]]:
    """Return the figures of every planner, ready for a table and for JSON; intervals are of 95 %."""
    approached = np.r_[corners.loud.recorded, _QUIET + corners.quiet.recorded]
    # Replays of one vehicle, and moments of one minute, are drawn together.
    drawn = _with_mean(approached, rng), _with_mean(corners.empty.recorded, rng)
    phantom = _needless_s(planners[PHANTOM], *drawn)
    return {name: _figures(corners, one, _needless_s(one, *drawn), phantom) for name, one in planners.items()}


def _with_mean(recorded: IndexArray, rng: np.random.Generator) -> FloatArray:
    """Return the weights of replays in the mean, then in draws of what was recorded, each summing to one."""
    which, members = np.unique(recorded, return_inverse=True)
    drawn = draw_weights(stratified_draws([0] * which.size, rng), which.size)[:, members]
    every = np.concatenate([np.ones((1, recorded.size)), drawn])
    return np.asarray(every / every.sum(axis=1, keepdims=True))


def _needless_s(drives: CornerDrives, approached: FloatArray, empty: FloatArray) -> FloatArray:
    """Return needless braking a corner in the mean and in every draw, shape (1 + draws, shares)."""
    met = np.r_[drives.loud.needless_s, drives.quiet.needless_s]
    share = np.array(SHARES)
    return np.outer(approached @ met, share) + np.outer(empty @ drives.empty.needless_s, 1.0 - share)


def _figures(
    corners: Corners, drives: CornerDrives, needless_s: FloatArray, phantom_s: FloatArray
) -> dict[str, float | int]:
    told: dict[str, float | int] = {}
    for name, replays, driven in (
        ("loud", corners.loud, drives.loud),
        ("quiet", corners.quiet, drives.quiet),
    ):
        hit = driven.collided
        low, high = share_interval(int(hit.sum()), hit.size)
        told |= {f"{name}_collisions": int(hit.sum()), f"{name}_replays": hit.size}
        told |= {f"{name}_collided_low": low, f"{name}_collided_high": high}
        told |= {f"{name}_recorded": np.unique(replays.recorded).size}
        told |= {f"{name}_recorded_collided": np.unique(replays.recorded[hit]).size}
        told |= {f"{name}_needless_s": float(driven.needless_s.mean())}
    told["empty_needless_s"] = float(drives.empty.needless_s.mean())
    told["empty_hard_braking"] = float((drives.empty.hardest_mps2 > HARD_MPS2).mean())
    told["empty_took_s"] = float(drives.empty.took_s.mean())
    less = 1.0 - needless_s / phantom_s
    for i, share in enumerate(SHARES):
        told[f"needless_s_at_{share:g}"] = float(needless_s[0, i])
        told[f"less_at_{share:g}"] = float(less[0, i])
        told[f"less_at_{share:g}_low"], told[f"less_at_{share:g}_high"] = middle(less[1:, i])
    return told


if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = {UNAWARE: RED, PHANTOM: BLUE, FULL: ORANGE, CHANCE: GREEN, LOUD: SKY}
_TOLD = {UNAWARE: "no knowledge", PHANTOM: "phantom at every corner", FULL: "phantom, full brakes"}
_ARM_M, _BEHIND_M, _BEYOND_M = 13.0, 9.0, 2.0


def write_planner_figure(
    corners: Corners,
    planners: Mapping[str, CornerDrives],
    curve: Sequence[Mapping[str, float | int]],
    figures: Mapping[str, Mapping[str, float | int]],
    ego: EgoVehicle,
    path: Path,
) -> None:
    """Draw an approach in which only the unaware planner collides, an empty corner, and the costs."""
    with figure_file(path, 11.0, 3.5) as figure:
        above, speeds, costs = figure.subplots(1, 3, width_ratios=(1.15, 1.0, 1.0))
        hit = planners[UNAWARE].loud.collided & ~planners[CHANCE].loud.collided
        _draw_corner(above, corners.loud, int(np.flatnonzero(hit)[0]), planners, ego)
        _draw_speeds(speeds, corners.empty, planners)
        _draw_costs(costs, curve, figures)


def _draw_corner(
    axes: "Axes", met: Encounters, i: int, planners: Mapping[str, CornerDrives], ego: EgoVehicle
) -> None:
    """Draw the first moment at which the planners without knowledge and with it are a metre apart."""
    from matplotlib.patches import Rectangle

    apart = planners[UNAWARE].loud.front_m[i] - planners[CHANCE].loud.front_m[i]
    step = int(np.flatnonzero(apart > 1.0)[0])
    ahead, (left, right) = met.corner_ahead_m[i], met.corner_m[i]
    for y, width in ((left, _ARM_M), (-right - _ARM_M, _ARM_M)):
        axes.add_patch(Rectangle((y, -_BEHIND_M), width, ahead + _BEHIND_M, color="0.75", linewidth=0))
    for name in (UNAWARE, CHANCE):
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
    # The corner at which the planner that listens brakes as long as in the mean: no picked one.
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
