"""Sensors that are not sound: headlights on a wall as evidence, a radio message as a position, or both."""

from pathlib import Path

import numpy as np
from tutorial_options import tutorial_options

from worldstate import Entity, Measurement, NotUsable, SignatureEvidence, Unqueried, WorldFilter
from worldstate.measurement import Position, PositionScan
from worldstate.operations.figure_style import HIDDEN, TRUTH, figure_file

NOT_ASKED, UNKNOWN = Unqueried("no camera"), NotUsable("not measured by light")
NOISE = tuple(map(tuple, np.diag([2.25, 2.25, 0.25, 0.25]).tolist()))  # of the receiver's x, y, vx, vy
SPEED_MPS, LANE_M, EDGE_M = 6.0, 10.0, 6.2  # in view once less than 6.2 m to the left


def glow_evidence(brighter: float) -> SignatureEvidence:
    """Say how well a brighter wall goes with each explanation, nats: by 3 +- 1 with a hidden car, left."""
    hidden, other = -0.5 * (brighter - 3.0) ** 2, -0.5 * brighter**2
    return SignatureEvidence(("left", "right"), hidden=(hidden, other), visible=other, none=other)


def follow(light: bool, radio: bool, way_m: np.ndarray, glow: np.ndarray) -> list[Entity | None]:
    """Return the likeliest hidden one on the left after every hop; messages come from 1.5 s on."""
    world, found, rng = WorldFilter(), [], np.random.default_rng(3)
    for hop, stamp_ns in enumerate(range(100_000_000, 100_000_000 * (len(way_m) + 1), 100_000_000)):
        if light:
            world = world.update(Measurement(stamp_ns, glow_evidence(glow[hop]), NOT_ASKED, UNKNOWN, UNKNOWN))
        if radio and hop >= 15 and hop % 5 == 0:
            x_m, y_m = rng.normal((LANE_M, way_m[hop]), 1.5).tolist()
            car = Position((x_m, y_m), NOISE, (0.0, -SPEED_MPS), existence_probability=0.9)
            world = world.update(PositionScan("v2x", stamp_ns, (car,)))
        there = world.predict_to(stamp_ns).state.entities
        left = [e for e in there if (e.status, e.direction) == ("hidden", "left")]
        found.append(max(left, key=lambda e: e.existence_probability, default=None))
    return found


def main(out: Path, size: str = "full") -> None:
    """Draw which vehicles are believed hidden on the left, and when they are said to come into view."""
    time_s = np.arange(1, 31 if size == "small" else 51) / 10.0
    way_m = EDGE_M + SPEED_MPS * (time_s[-1] - 0.5 - time_s)
    glow = np.random.default_rng(1).normal(size=time_s.size) + 3.0 * (way_m > EDGE_M) * np.exp(-way_m / 40.0)
    with figure_file(out / "07_another_modality.png", 8.0, 3.6) as figure:
        exists, when = figure.subplots(1, 2, sharex=True)
        for name, light, radio in (("light", True, False), ("radio", False, True), ("both", True, True)):
            left = follow(light, radio, way_m, glow)
            exists.plot(time_s, [0.0 if e is None else e.existence_probability for e in left], label=name)
            told = [(np.nan,) * 3 if e is None else e.time_to_visible_s or (np.nan,) * 3 for e in left]
            print(f"{name}: {sum(map(bool, left))} states, {np.isfinite(told).sum() // 3} with a time")
        when.fill_between(time_s, *np.transpose(told)[[0, 2]], alpha=0.2, color=HIDDEN, linewidth=0)
        when.plot(time_s, np.transpose(told)[1], color=HIDDEN, label="both, nine of ten cases")
        when.plot(time_s, np.maximum((way_m - EDGE_M) / SPEED_MPS, 0.0), ":", color=TRUTH, label="truth")
        exists.set(xlabel="time, s", ylabel="existence of a hidden one, left")
        when.set(ylim=(0.0, None), xlabel="time, s", ylabel="time to visible, s")
        _ = exists.legend(loc="upper left"), when.legend()


if __name__ == "__main__":
    main(*tutorial_options(__doc__))
