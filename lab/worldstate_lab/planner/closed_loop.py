"""The closed loop: at every step a planner brakes for vehicles that it sees or assumes behind a corner."""

from dataclasses import dataclass

import numpy as np

from worldstate.abduction.sequence.sequence_model import HORIZONS_S
from worldstate.ground.typing import BoolArray, FloatArray

from .encounters import HALF_LANE_M, HOP_STEPS, STEP_S, STEPS, EgoVehicle, Encounters

HORIZON_S = 3.0
NEEDED_WITHIN_S = 1.0
_FAR_M = 200.0
_LEAST_MPS = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Drives:
    """What became of every encounter."""

    collided: BoolArray  # shape (n,)
    braking_s: FloatArray  # shape (n,): Held back from what it may do: braking, standing, or not accelerating
    hardest_mps2: FloatArray  # shape (n,)
    took_s: FloatArray  # shape (n,): Until its rear has left the conflict zone
    needed: BoolArray  # shape (n,): Whether one that never brakes comes within a second of a vehicle
    front_m: FloatArray  # shape (n, STEPS): Where its bumper is

    @property
    def needless_s(self) -> FloatArray:
        """Braking where none was due."""
        return np.where(self.needed, 0.0, self.braking_s)


def drive_through(encounters: Encounters, threshold: float, ego: EgoVehicle) -> Drives:
    """Drive through all encounters, braking for vehicles that it sees or assumes.

    One is assumed at the limit just behind what can be seen of a side while the chance that a vehicle comes
    into view from there within `HORIZON_S` is not below the threshold: always at 0, never at infinity.
    """
    assumed = encounters.within[..., HORIZONS_S.index(HORIZON_S)] >= threshold
    n = len(encounters)
    x, v = encounters.line_m - ego.begins_m, np.full(n, ego.begins_mps)
    end_m = encounters.lane_m.max(axis=1) + HALF_LANE_M + ego.length_m
    collided, braking, hardest, took = np.zeros(n, bool), np.zeros(n), np.zeros(n), np.full(n, np.nan)
    first_seen = np.full(encounters.side.shape, STEPS * 2)
    late = round(ego.reaction_s / STEP_S)
    fronts = np.empty((n, STEPS))
    for step in range(STEPS):
        fronts[:, step] = x
        sight = sight_m(encounters, x - ego.eye_m)
        mine = np.take_along_axis(sight, encounters.side, axis=1)
        to_come = encounters.to_come_m[:, step]
        visible = ((to_come <= mine) | encounters.in_view[:, step]) & (to_come > -_FAR_M)
        first_seen = np.minimum(first_seen, np.where(visible, step, STEPS * 2))
        hop = max(step - late, 0) // HOP_STEPS
        free = np.minimum(ego.acceleration_mps2, (ego.limit_mps - v) / STEP_S)
        # A view that has just opened has told nothing yet.
        then = sight_m(encounters, fronts[:, max(step - late, 0)] - ego.eye_m)
        for_hidden = _for_assumed(encounters, ego, x, v, then, assumed[:, hop])
        for_seen = _for_seen(encounters, ego, x, v, step, step - first_seen >= late)
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
        collided |= driving & _overlaps(encounters, ego, x, min(step + 1, STEPS - 1))
        took = np.where(driving & (x >= end_m), (step + 1) * STEP_S, took)
    return Drives(collided, braking, hardest, took, _needed(encounters, ego), fronts)


def sight_m(encounters: Encounters, eye_m: FloatArray) -> FloatArray:
    """Return how far into either lane an eye sees past the corner, shape (n, 2)."""
    before = (encounters.corner_ahead_m - eye_m)[:, None]
    reach = (encounters.lane_m - eye_m[:, None]) / np.maximum(before, 1e-3)
    return np.where(before > 0.0, np.minimum(encounters.corner_m * reach, _FAR_M), _FAR_M)


def _for_assumed(
    encounters: Encounters,
    ego: EgoVehicle,
    x: FloatArray,
    v: FloatArray,
    reach_m: FloatArray,
    assumed: BoolArray,
) -> FloatArray:
    """Return the acceleration that leaves it able to stop before an assumed vehicle."""
    room = encounters.line_m - ego.gap_m - x
    out_m = encounters.lane_m + HALF_LANE_M + ego.length_m - x[:, None]
    arrives_s = (reach_m - 0.5 * ego.width_m) / ego.limit_mps - ego.reaction_s
    passes = ego.soonest_s(out_m, v[:, None]) + ego.gap_s <= arrives_s
    # Beyond the line it is too late to stop for what may come.
    stops = (assumed & ~passes).any(axis=1) & (v**2 <= 2.0 * ego.full_mps2 * room)
    return np.where(stops, _towards(ego, room, v, ego.reaction_s), np.inf)


def _towards(ego: EgoVehicle, room_m: FloatArray, v: FloatArray, reaction_s: float) -> FloatArray:
    """Return the acceleration that keeps it able to stop in some room, harder than comfortably if it must."""
    target = ego.stopping_speed_mps(room_m - v * STEP_S, reaction_s)
    needed = v**2 / (2.0 * np.maximum(room_m, 1e-3))
    return np.maximum((target - v) / STEP_S, -np.clip(needed, ego.comfortable_mps2, ego.full_mps2))


def _for_seen(
    encounters: Encounters, ego: EgoVehicle, x: FloatArray, v: FloatArray, step: int, known: BoolArray
) -> FloatArray:
    """Return the acceleration with which it lets vehicles pass that it sees and would meet."""
    # What it knows is as old as its reaction.
    late = round(ego.reaction_s / STEP_S)
    steps = max(step - late, 0), max(step - late - 2, 0)
    now, before = (encounters.to_come_m[:, one] for one in steps)
    speed = np.maximum((before - now) / (2.0 * STEP_S), _LEAST_MPS)
    now = now - speed * late * STEP_S
    half, lane = 0.5 * encounters.width_m, np.take_along_axis(encounters.lane_m, encounters.side, axis=1)
    # What has braked before the corner speeds up behind it: it is not to be passed at its present pace.
    enters_s = ego.soonest_s(now - 0.5 * ego.width_m, speed)
    leaves_s = (now + 0.5 * ego.width_m + encounters.length_m) / speed
    in_m, out_m = lane - half - x[:, None], lane + half + ego.length_m - x[:, None]
    first = ego.soonest_s(out_m, v[:, None]) + ego.gap_s <= enters_s
    after = leaves_s + ego.gap_s <= ego.soonest_s(in_m, v[:, None])
    lets_pass = known & ~first & ~after & (leaves_s > 0.0) & (out_m > 0.0)
    line = (encounters.line_m - x)[:, None]
    can = v[:, None] ** 2 <= 2.0 * ego.full_mps2 * np.maximum(line - ego.gap_m, 0.0)
    # Past the line, or too fast for it, before this vehicle's own way at least.
    room = np.where(can & (line > 0), line, in_m) - ego.gap_m
    braked = _towards(ego, room, v[:, None], 0.0)
    inside = in_m <= 0.0
    return np.asarray(np.where(lets_pass & ~inside, braked, np.inf).min(axis=1))


def _overlaps(encounters: Encounters, ego: EgoVehicle, x: FloatArray, step: int) -> BoolArray:
    """Tell whether the footprint of the ego lies on that of a vehicle."""
    lane, half = np.take_along_axis(encounters.lane_m, encounters.side, axis=1), 0.5 * encounters.width_m
    along = (x[:, None] > lane - half) & (x[:, None] - ego.length_m < lane + half)
    front = encounters.to_come_m[:, step]
    across = (front < 0.5 * ego.width_m) & (front + encounters.length_m > -0.5 * ego.width_m)
    return np.asarray((along & across).any(axis=1))


def _needed(encounters: Encounters, ego: EgoVehicle) -> BoolArray:
    """Tell whether an ego that never brakes comes so near in time to a vehicle that braking is due."""
    lane, half = np.take_along_axis(encounters.lane_m, encounters.side, axis=1), 0.5 * encounters.width_m
    begins, speed = (encounters.line_m - ego.begins_m)[:, None], np.array([ego.begins_mps])
    in_s = ego.soonest_s(lane - half - begins, speed) - NEEDED_WITHIN_S
    out_s = ego.soonest_s(lane + half + ego.length_m - begins, speed) + NEEDED_WITHIN_S
    clock_s = (np.arange(STEPS) * STEP_S)[:, None]
    there = (clock_s >= in_s[:, None]) & (clock_s <= out_s[:, None])
    front, length = encounters.to_come_m, encounters.length_m[:, None]
    crossing = (front < 0.5 * ego.width_m) & (front + length > -0.5 * ego.width_m)
    return np.asarray((there & crossing).any(axis=(1, 2)))
