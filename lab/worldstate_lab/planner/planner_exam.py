"""Closed-loop comparison of planners at the same corners: collisions, needless braking, lost time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

import numpy as np

from worldstate.abduction.sequence.sequence_model import HORIZONS_S
from worldstate.commissioning.stream_exam import approaches
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.operations.figure_style import CATEGORIES, TRUTH, figure_file
from worldstate.operations.metrics.approach_table import share_interval
from worldstate_lab.metrics.intervals import draw_weights, middle, stratified_draws

from .encounters import (
    HALF_LANE_M,
    HOP_STEPS,
    STEP_S,
    STEPS,
    BelievedStream,
    EgoVehicle,
    Encounters,
    approach_encounters,
    empty_encounters,
)

HORIZON_S = 3.0
NEEDED_WITHIN_S = 1.0
_FAR_M = 200.0
_LEAST_MPS = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Drives:
    """Result of every encounter."""

    collided: BoolArray  # shape (n,)
    # shape (n,): Time below the permitted acceleration: braking, stopped, or not accelerating
    braking_s: FloatArray
    hardest_mps2: FloatArray  # shape (n,)
    took_s: FloatArray  # shape (n,): Time until its rear has left the conflict zone
    needed: BoolArray  # shape (n,): Whether an ego that never brakes comes within a second of a vehicle
    front_m: FloatArray  # shape (n, STEPS): Position of its bumper

    @property
    def needless_s(self) -> FloatArray:
        """Braking time in encounters without a need to brake."""
        return np.where(self.needed, 0.0, self.braking_s)


def drive_through(met: Encounters, threshold: float, ego: EgoVehicle, *, remembers: bool = False) -> Drives:
    """Drive through all encounters, braking for visible and for assumed vehicles.

    A vehicle at the speed limit is assumed just beyond the visible part of a side if the chance that a
    vehicle comes into view from there within `HORIZON_S` is at least the threshold. With a threshold of 0 it
    is always assumed, with infinity never. With memory, the assumed vehicle is no nearer than a vehicle that
    was never in sight can be.
    """
    assumed = met.within[..., HORIZONS_S.index(HORIZON_S)] >= threshold
    n = len(met)
    x, v = met.line_m - ego.begins_m, np.full(n, ego.begins_mps)
    end_m = met.lane_m.max(axis=1) + HALF_LANE_M + ego.length_m
    collided, braking, hardest, took = np.zeros(n, bool), np.zeros(n), np.zeros(n), np.full(n, np.nan)
    first_seen = np.full(met.side.shape, STEPS * 2)
    late = round(ego.reaction_s / STEP_S)
    fronts, reach = np.empty((n, STEPS)), np.zeros((n, 2))
    for step in range(STEPS):
        fronts[:, step] = x
        sight = sight_m(met, x - ego.eye_m)
        mine = np.take_along_axis(sight, met.side, axis=1)
        to_come = met.to_come_m[:, step]
        visible = ((to_come <= mine) | met.in_view[:, step]) & (to_come > -_FAR_M)
        first_seen = np.minimum(first_seen, np.where(visible, step, STEPS * 2))
        hop = max(step - late, 0) // HOP_STEPS
        free = np.minimum(ego.acceleration_mps2, (ego.limit_mps - v) / STEP_S)
        # A view that has just opened is used only after the reaction time.
        then = sight_m(met, fronts[:, max(step - late, 0)] - ego.eye_m)
        reach = unseen_from_m(reach, then, ego.limit_mps * STEP_S) if remembers else then
        for_hidden = _for_assumed(met, ego, x, v, reach, assumed[:, hop])
        for_seen = _for_seen(met, ego, x, v, step, step - first_seen >= late)
        chosen = np.clip(np.minimum(np.minimum(for_hidden, for_seen), free), -ego.full_mps2, None)
        chosen = np.maximum(chosen, -v / STEP_S)
        driving = np.isnan(took) & ~collided
        if not driving.any():
            fronts[:, step:] = x[:, None]
            break
        braking += STEP_S * ((chosen < free - 0.05) & driving)
        hardest = np.where(driving, np.maximum(hardest, -chosen), hardest)
        x = np.where(driving, x + v * STEP_S + 0.5 * chosen * STEP_S**2, x)
        v = np.where(driving, np.maximum(v + chosen * STEP_S, 0.0), v)
        collided |= driving & _overlaps(met, ego, x, min(step + 1, STEPS - 1))
        took = np.where(driving & (x >= end_m), (step + 1) * STEP_S, took)
    return Drives(collided, braking, hardest, took, _needed(met, ego), fronts)


def sight_m(encounters: Encounters, eye_m: FloatArray) -> FloatArray:
    """Return the visible length of either lane beyond the corner, shape (n, 2)."""
    before = (encounters.corner_ahead_m - eye_m)[:, None]
    reach = (encounters.lane_m - eye_m[:, None]) / np.maximum(before, 1e-3)
    return np.where(before > 0.0, np.minimum(encounters.corner_m * reach, _FAR_M), _FAR_M)


def unseen_from_m(before_m: FloatArray, sight_m: FloatArray, driven_m: float) -> FloatArray:
    r"""Return the smallest distance of a vehicle never in sight, one step after it was `before_m`.

    .. math:: R(t) = \max(S(t), R(t - \Delta t) - v \Delta t) = \max_{t' \le t} S(t') - v (t - t')

    S is the visible length of the lane and v the highest speed. A vehicle at speed v that was at the edge of
    sight at the maximising t' is now at the distance R. While S grows, R equals S: a vehicle just beyond the
    edge may have come from farther away without being in sight.

    Examples
    --------
    >>> unseen_from_m(np.array([40.0, 40.0]), np.array([5.0, 45.0]), driven_m=7.0)
    array([33., 45.])
    """
    return np.maximum(sight_m, before_m - driven_m)


def _for_assumed(
    met: Encounters, ego: EgoVehicle, x: FloatArray, v: FloatArray, reach_m: FloatArray, assumed: BoolArray
) -> FloatArray:
    """Return the acceleration with which the ego can still stop before an assumed vehicle."""
    room = met.line_m - ego.gap_m - x
    out_m = met.lane_m + HALF_LANE_M + ego.length_m - x[:, None]
    arrives_s = (reach_m - 0.5 * ego.width_m) / ego.limit_mps - ego.reaction_s
    passes = ego.soonest_s(out_m, v[:, None]) + ego.gap_s <= arrives_s
    # Beyond the line it is too late to stop for an assumed vehicle.
    stops = (assumed & ~passes).any(axis=1) & (v**2 <= 2.0 * ego.full_mps2 * room)
    return np.where(stops, _towards(ego, room, v, ego.reaction_s), np.inf)


def _towards(ego: EgoVehicle, room_m: FloatArray, v: FloatArray, reaction_s: float) -> FloatArray:
    """Return the acceleration that permits a stop within a distance, beyond the comfort limit if needed."""
    target = ego.stopping_speed_mps(room_m - v * STEP_S, reaction_s)
    needed = v**2 / (2.0 * np.maximum(room_m, 1e-3))
    return np.maximum((target - v) / STEP_S, -np.clip(needed, ego.comfortable_mps2, ego.full_mps2))


def _for_seen(
    encounters: Encounters, ego: EgoVehicle, x: FloatArray, v: FloatArray, step: int, known: BoolArray
) -> FloatArray:
    """Return the acceleration with which the ego gives way to visible vehicles that it would meet."""
    # Observations are as old as the reaction time.
    late = round(ego.reaction_s / STEP_S)
    steps = max(step - late, 0), max(step - late - 2, 0)
    now, before = (encounters.to_come_m[:, one] for one in steps)
    speed = np.maximum((before - now) / (2.0 * STEP_S), _LEAST_MPS)
    now = now - speed * late * STEP_S
    starts_m, ends_m = encounters.paths_m
    # A vehicle that braked before the corner accelerates after it: its present speed must not be
    # extrapolated.
    enters_s = ego.soonest_s(now - 0.5 * ego.width_m, speed)
    leaves_s = (now + 0.5 * ego.width_m + encounters.length_m) / speed
    in_m, out_m = starts_m - x[:, None], ends_m + ego.length_m - x[:, None]
    first = ego.soonest_s(out_m, v[:, None]) + ego.gap_s <= enters_s
    after = leaves_s + ego.gap_s <= ego.soonest_s(in_m, v[:, None])
    lets_pass = known & ~first & ~after & (leaves_s > 0.0) & (out_m > 0.0)
    line = (encounters.line_m - x)[:, None]
    can = v[:, None] ** 2 <= 2.0 * ego.full_mps2 * np.maximum(line - ego.gap_m, 0.0)
    # If the ego is past the line, or too fast to stop there, it stops at least before this vehicle's path.
    room = np.where(can & (line > 0), line, in_m) - ego.gap_m
    braked = _towards(ego, room, v[:, None], 0.0)
    inside = in_m <= 0.0
    return np.asarray(np.where(lets_pass & ~inside, braked, np.inf).min(axis=1))


def _overlaps(encounters: Encounters, ego: EgoVehicle, x: FloatArray, step: int) -> BoolArray:
    """Return whether the footprint of the ego overlaps that of a vehicle."""
    starts_m, ends_m = encounters.paths_m
    along = (x[:, None] > starts_m) & (x[:, None] - ego.length_m < ends_m)
    front = encounters.to_come_m[:, step]
    across = (front < 0.5 * ego.width_m) & (front + encounters.length_m > -0.5 * ego.width_m)
    return np.asarray((along & across).any(axis=1))


def _needed(encounters: Encounters, ego: EgoVehicle) -> BoolArray:
    """Return whether an ego that never brakes comes so close in time to a vehicle that braking is needed."""
    starts_m, ends_m = encounters.paths_m
    begins, speed = (encounters.line_m - ego.begins_m)[:, None], np.array([ego.begins_mps])
    in_s = ego.soonest_s(starts_m - begins, speed) - NEEDED_WITHIN_S
    out_s = ego.soonest_s(ends_m + ego.length_m - begins, speed) + NEEDED_WITHIN_S
    clock_s = (np.arange(STEPS) * STEP_S)[:, None]
    there = (clock_s >= in_s[:, None]) & (clock_s <= out_s[:, None])
    front, length = encounters.to_come_m, encounters.length_m[:, None]
    crossing = (front < 0.5 * ego.width_m) & (front + length > -0.5 * ego.width_m)
    return np.asarray((there & crossing).any(axis=(1, 2)))


Of = TypeVar("Of")
UNAWARE, PHANTOM, FULL = "no knowledge", "phantom", "phantom, full brakes"
MEMORY, CHANCE, LOUD = "memory", "chance", "chance, loud"
THRESHOLDS = tuple(round(0.001 * 2.0 ** (0.5 * step), 4) for step in range(13))
# Shares of corners with a vehicle.
SHARES = (0.05, 0.2)
HARD_MPS2 = 4.0
_QUIET = 100_000  # Offset of the numbers of quiet approaches from those of loud ones


class ByKind(NamedTuple, Generic[Of]):
    """One item each for loud approaches, approaches with a quiet vehicle, and times without vehicles."""

    loud: Of
    quiet: Of
    empty: Of


Corners = ByKind[Encounters]
CornerDrives = ByKind[Drives]  # Drives of one planner


def draw_corners(
    streams: Sequence[BelievedStream], count: int, ego: EgoVehicle, rng: np.random.Generator
) -> Corners:
    """Draw approaches of loud vehicles, quiet ones by their share, and as many times without vehicles."""
    loud, quiet = approaches_drawn(streams, count, ego, rng)
    return Corners(loud, quiet, empty_encounters([one for one in streams if not one.ways], count, rng))


def approaches_drawn(
    streams: Sequence[BelievedStream], count: int, ego: EgoVehicle, rng: np.random.Generator
) -> tuple[Encounters, Encounters]:
    """Draw this many approaches of loud vehicles, and quiet ones in proportion to their share."""
    every = [(stream, one) for stream in streams for one in approaches(stream.heard)]
    loud, quiet = ([pair for pair in every if pair[1].quiet is kind] for kind in (False, True))
    quiet_count = max(round(count * len(quiet) / max(len(loud), 1)), 1)
    return approach_encounters(loud, count, ego, rng), approach_encounters(quiet, quiet_count, ego, rng)


def safe_threshold(approached: Sequence[Encounters], ego: EgoVehicle) -> float:
    """Return the largest threshold without collisions, less one step; 0 (the phantom) if there is none."""
    # A threshold without collisions in about 130 approaches may cause one elsewhere: one step is kept as a
    # margin.
    kept = 0.0
    for lower, threshold in pairwise((0.0, *THRESHOLDS)):
        if any(drive_through(one, threshold, ego).collided.any() for one in approached):
            break
        kept = lower
    return kept


def drives_of(corners: Corners, threshold: float, ego: EgoVehicle, remembers: bool = False) -> CornerDrives:
    """Return the drives of the planner that assumes a vehicle if its chance is above a threshold."""
    return CornerDrives(*(drive_through(one, threshold, ego, remembers=remembers) for one in corners))


def every_planner(corners: Corners, chance: float, loud: float, ego: EgoVehicle) -> dict[str, CornerDrives]:
    """Return the drives of all planners; only the one with full brakes has another stopping law."""
    return {
        UNAWARE: drives_of(corners, np.inf, ego),
        PHANTOM: drives_of(corners, 0.0, ego),
        FULL: drives_of(corners, 0.0, replace(ego, comfortable_mps2=ego.full_mps2)),
        MEMORY: drives_of(corners, 0.0, ego, remembers=True),
        CHANCE: drives_of(corners, chance, ego),
        LOUD: drives_of(corners, loud, ego),
    }


def planner_figures(
    corners: Corners, planners: Mapping[str, CornerDrives], rng: np.random.Generator
) -> dict[str, dict[str, float | int]]:
    """Return the figures of every planner, for a table and for JSON, with 95 % intervals."""
    approached = np.r_[corners.loud.recorded, _QUIET + corners.quiet.recorded]
    # Replays of one vehicle, and times of one minute, are drawn together.
    drawn = _with_mean(approached, rng), _with_mean(corners.empty.recorded, rng)
    phantom = _needless_s(planners[PHANTOM], *drawn)
    return {name: _figures(corners, one, _needless_s(one, *drawn), phantom) for name, one in planners.items()}


def _with_mean(recorded: IndexArray, rng: np.random.Generator) -> FloatArray:
    """Return weights of replays, each row with sum 1: equal weights, then one row per draw of items."""
    which, members = np.unique(recorded, return_inverse=True)
    drawn = draw_weights(stratified_draws([0] * which.size, rng), which.size)[:, members]
    every = np.concatenate([np.ones((1, recorded.size)), drawn])
    return np.asarray(every / every.sum(axis=1, keepdims=True))


def _needless_s(drives: CornerDrives, approached: FloatArray, empty: FloatArray) -> FloatArray:
    """Return needless braking per corner, the mean and every draw, shape (1 + draws, shares)."""
    met = np.r_[drives.loud.needless_s, drives.quiet.needless_s]
    share = np.array(SHARES)
    return np.outer(approached @ met, share) + np.outer(empty @ drives.empty.needless_s, 1.0 - share)


def _figures(
    corners: Corners, drives: CornerDrives, needless_s: FloatArray, phantom_s: FloatArray
) -> dict[str, float | int]:
    told: dict[str, float | int] = {}
    pairs = (corners.loud, drives.loud), (corners.quiet, drives.quiet)
    for name, (replays, driven) in zip(("loud", "quiet"), pairs, strict=True):
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

_COLOURS = dict(zip((UNAWARE, FULL, PHANTOM, CHANCE, LOUD), CATEGORIES, strict=False))
_COLOURS[MEMORY] = _COLOURS[PHANTOM]  # Both drive alike if sight only grows
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
    """Draw the first moment at which the planners with and without knowledge are a metre apart."""
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
        axes.plot([0.0, side * sight], [eye, lane], color=_COLOURS[CHANCE], linewidth=0.8, linestyle=":")
    for k in np.flatnonzero(met.length_m[i]).tolist():
        y0, sign = met.to_come_m[i, step, k], 1.0 if met.side[i, k] == 0 else -1.0
        low = min(sign * y0, sign * (y0 + met.length_m[i, k]))
        corner = low, met.lane_m[i, met.side[i, k]] - 0.5 * met.width_m[i, k]
        axes.add_patch(Rectangle(corner, met.length_m[i, k], met.width_m[i, k], color=TRUTH))
    far = met.lane_m[i].max() + _BEYOND_M
    axes.set(xlim=(_ARM_M, -_ARM_M), ylim=(-_BEHIND_M, far), aspect="equal")
    axes.set(xlabel="left, m", ylabel="ahead, m", title="a vehicle that neither of them can see yet")


def _draw_speeds(axes: "Axes", empty: Encounters, planners: Mapping[str, CornerDrives]) -> None:
    # A typical corner is drawn: the one at which the planner with the chances brakes for the median time.
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

    axes.plot(*zip(*(place(one) for one in curve), strict=True), color=_COLOURS[CHANCE], marker=".", zorder=2)
    for name, one in figures.items():
        told = "chance, set on loud ones" if name == LOUD else None
        axes.plot(*place(one), "o", color=_COLOURS[name], markersize=8, clip_on=False, label=told)
    axes.legend(loc="upper right", fontsize=8)
    axes.set(xlabel=f"needless braking, s ({SHARES[0]:.0%} with a vehicle)", xlim=(0.0, None))
    axes.set(ylabel="collisions in 1,000 approaches", ylim=(0.0, None), title="cost of each threshold")
