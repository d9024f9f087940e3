"""Measurements of a street: single hops from their parts, and random ones."""

from collections.abc import Iterable, Mapping

import numpy as np
from hypothesis import strategies as st

from worldstate import Measurement, NotUsable, Sighting, SignatureEvidence, WorldFilter
from worldstate.abduction.co_evidence import Absent, CoEvidence, Present, Unqueried
from worldstate.abduction.sequence.sequence_model import COMING_S, GROUPS, SequenceAlarm
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.measurement import (
    Approach,
    Bearing,
    Look,
    Odometry,
    Position,
    PositionScan,
    SearchedSector,
    Sector,
)
from worldstate.state import Context
from worldstate.state.context import corner_at

Timed = Measurement | PositionScan | Odometry
SEEDS = st.integers(0, 2**32 - 1)
SIDES, SILENT, UNASKED = ("left", "right", "rear"), NotUsable("not scripted"), Unqueried("no camera")
ABSENT, PRESENT = Absent(0.04, 0.01), Present(0.04, 0.01)
COMING = len(COMING_S)
# One share for all tests, because a chain is computed once per share.
SHARE = 0.9 * np.random.default_rng(0).dirichlet(np.ones(len(GROUPS))) + 0.1 / len(GROUPS)
EVEN = np.full(len(GROUPS), 1.0 / len(GROUPS))
CORNERS = Context(occluders=(corner_at("left", (8.0, 4.0), 12.0), corner_at("right", (8.0, -4.0), 12.0)))


def hop(
    number: float,
    nats: Iterable[float] = (0.0, 0.0, 0.0, 0.0),
    *boxes: Sighting,
    answer: CoEvidence = UNASKED,
    bearing: Bearing | NotUsable = SILENT,
    approach: Approach | NotUsable = SILENT,
    **parts,
) -> Measurement:
    """Return the measurement of a hop of 0.1 s: nats by side, of visible and of none; a look."""
    *hidden, visible, none = nats
    heard = SignatureEvidence(SIDES[: len(hidden)], tuple(hidden), visible, none)
    return Measurement(round(number * 1e8), heard, answer, bearing, approach, boxes, **parts)


def car(azimuth_rad: float, std_rad: float = 0.02, **parts) -> Sighting:
    return Sighting(azimuth_rad, std_rad, "car", **({"score": 0.9} | parts))


def reading(
    weights: Mapping[str, float | tuple[float, float]] | np.ndarray,
    threshold: float | None = 0.0,
    rest: float = 1e-3,
    share: np.ndarray = SHARE,
) -> SequenceReading:
    """Return a reading from the weights of some groups on both sides or on each; the others have `rest`."""
    groups = np.full((2, len(GROUPS)), rest)
    if isinstance(weights, np.ndarray):
        groups[:] = weights
    else:
        for name, weight in weights.items():
            groups[:, GROUPS.index(name)] = weight
    alarm = None if threshold is None else SequenceAlarm(threshold, 20.0)
    return SequenceReading(groups / groups.sum(axis=1, keepdims=True), share, 0.1, alarm)


def drawn_groups(rng: np.random.Generator, *shape: int, least: float = 0.001) -> np.ndarray:
    """Return random groups, shape (*shape, groups)."""
    return (1.0 - least) * rng.dirichlet(np.full(len(GROUPS), 0.2), shape) + least / len(GROUPS)


def run(world: WorldFilter, measured: Iterable[Timed]) -> list[WorldFilter]:
    """Return the filter after each measurement."""
    return [world := world.update(one) for one in measured]


def after(*measured: Timed, world: WorldFilter | None = None) -> WorldFilter:
    """Return the filter after all measurements."""
    return run(world or WorldFilter(), measured)[-1]


def diagonal(*std: float) -> tuple[tuple[float, ...], ...]:
    """Return a covariance matrix of independent parts."""
    return tuple(map(tuple, np.diag(np.square(std)).tolist()))


def ordinary(
    rng: np.random.Generator, number: float, sequence: bool = True, spread: float = 2.0
) -> Measurement:
    """Return random sound, with a look and boxes in view or without a camera."""
    answer = (UNASKED, ABSENT, PRESENT)[int(rng.integers(3))]
    azimuths_rad = [] if answer is UNASKED else rng.uniform(-0.6, 0.6, rng.integers(0, 3)).tolist()
    look = None if answer is UNASKED else Look("camera", round(number * 1e8), answer)
    said = reading(drawn_groups(rng, 2)) if sequence else None
    nats = rng.normal(0.0, spread, 4).tolist()
    return hop(number, nats, *map(car, azimuths_rad), answer=answer, look=look, sequence=said)


def ordinary_scan(rng: np.random.Generator, number: float, searches: bool) -> PositionScan:
    """Return a radar scan or messages with up to two positions."""
    spread, places = ((1.0, 0.2), (0.2, 0.5)), rng.uniform((5.0, -25.0), (30.0, 25.0), (2, 2)).tolist()
    positions = [Position(tuple(at), spread, None, float(rng.uniform(0.1, 0.9))) for at in places]
    searched = SearchedSector(Sector(float(rng.uniform(-0.5, 0.5)), 1.0), 60.0, 0.8) if searches else None
    name = "radar" if searches else "v2x"
    return PositionScan(name, round(number * 1e8), tuple(positions[rng.integers(3) :]), searched)
