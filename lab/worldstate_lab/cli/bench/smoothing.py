"""`worldstate-lab bench smoothing`: a step of the fixed-lag smoother, beside an RTS smoother over its lag.

Three entities, lag 15 s, two corners, four walls. Each entity is heard by bearing and approach rate and, at
every tenth hop, by its image in a wall; past its corner it is seen by bearing and box height, and looks say
on which side of the edge it is. The peer, which is not incremental, filters and smooths the same lag
anew at every hop: constant velocity in Cartesian coordinates, positions measured. Processor time of one
thread, in ms.
"""

import argparse
import math
import time
from functools import partial

import numpy as np

from worldstate.cli.common.output import CommandResult
from worldstate.measurement import Approach, Bearing
from worldstate.smoothing import AngularHeight, FixedLagSmoother, PastEdge, ReflectedBearing
from worldstate.smoothing.observations import Observation
from worldstate_lab.benchmarks.hop_costs import Milliseconds, elapsed_ms

EXAMPLE = "example: worldstate-lab bench smoothing --seconds 40"

HOP_S, HOP_NS, LAG_HOPS, PASS_HOPS, ENTITIES = 0.1, 100_000_000, 150, 160, 3
WALLS = ("opposite", "west", "back", "east")


def smoothing_times(hops: int, rng: np.random.Generator) -> tuple[Milliseconds, int]:
    """Milliseconds of processor time per step, and the factor slots at the end."""
    smoother = FixedLagSmoother()
    smoother.add_corner("left", 1, (5.0, 3.0), (1.0, 0.5))
    smoother.add_corner("right", -1, (5.0, -3.0), (1.0, 0.5))
    for number, name in enumerate(WALLS):
        smoother.add_wall(name, number * math.pi / 2.0, 8.0, (0.05, 0.5))
    spent = []
    for hop in range(hops):
        seen = {}
        for number in range(ENTITIES):
            # Each comes again when it has passed, under another name: 16 s, 24 m to 40 m away at first.
            after, passes = (hop + 53 * number) % PASS_HOPS, (hop + 53 * number) // PASS_HOPS
            seen[f"{number}-{passes}"] = observed(after, number, rng)
        spent.append(elapsed_ms(partial(smoother.update, hop * HOP_NS, seen), time.process_time))
    return spent, smoother.n_factor_slots


def observed(hop: int, number: int, rng: np.random.Generator) -> list[Observation]:
    """Return what one entity is measured by at a hop of its pass."""
    side = 1 if number % 2 == 0 else -1
    x, y, speed = 8.0 + number, side * (24.0 - 0.3 * hop), 3.0
    azimuth, r = math.atan2(y, x), math.hypot(x, y)
    inverse_tta = side * y * speed / r**2
    heard: list[Observation] = [
        Bearing(azimuth + rng.normal(0.0, 0.07), 0.07),
        Approach(inverse_tta + rng.normal(0.0, 0.25), 0.25),
    ]
    hidden = side * y / x > 0.6
    corner = "left" if side > 0 else "right"
    if hop % 10 == 0:
        image = math.atan2(y, 16.0 - x)
        heard.append(ReflectedBearing("opposite", image + rng.normal(0.0, 0.1), 0.1))
    if abs(side * y / x - 0.6) < 0.2:
        heard.append(PastEdge(corner, seen=not hidden))
    if not hidden:
        heard[0] = Bearing(azimuth + rng.normal(0.0, 0.01), 0.01)
        heard.append(AngularHeight(1.5 / r * math.exp(rng.normal(0.0, 0.03)), 0.03))
    return heard


def rts_times(hops: int, rng: np.random.Generator) -> Milliseconds:
    """Milliseconds of processor time per hop: filter and RTS over the lag, for every entity."""
    from filterpy.kalman import KalmanFilter

    peer = KalmanFilter(dim_x=4, dim_z=2)
    peer.F, peer.H = np.eye(4) + HOP_S * np.eye(4, k=2), np.eye(2, 4)
    t = HOP_S
    peer.Q = np.kron([[t**3 / 3.0, t**2 / 2.0], [t**2 / 2.0, t]], np.eye(2))
    measured = rng.standard_normal((LAG_HOPS, 2))

    def smooth_every_entity() -> None:
        for _ in range(ENTITIES):
            peer.x, peer.P = np.zeros(4), 10.0 * np.eye(4)
            means, covariances, *_ = peer.batch_filter(measured)
            peer.rts_smoother(means, covariances)

    return [elapsed_ms(smooth_every_entity, time.process_time) for _ in range(hops)]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--seconds", type=float, default=40.0, help="of stream (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the benchmark; return what it found."""
    rng = np.random.default_rng(0)
    spent, slots = smoothing_times(round(arguments.seconds / HOP_S), rng)
    # The first lag is cheaper: nothing is marginalised yet.
    steady = np.array(spent[LAG_HOPS:] or spent)
    peer = float(np.mean(rts_times(10, rng)))
    figures = {
        "mean_ms": float(steady.mean()),
        "p99_ms": float(np.percentile(steady, 99)),
        "rts_over_the_lag_ms": peer,
        "of_rts": float(steady.mean() / peer),
        "factor_slots": slots,
    }
    return CommandResult(figures)
