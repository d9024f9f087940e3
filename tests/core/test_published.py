"""Every published quantity changes with the measurements."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
from published_quantities import quantities
from watched_street import START_NS as WATCHED_NS
from watched_street import arrival, false_alarms

from worldstate import Context, Measurement, NotUsable, Sighting, SignatureEvidence, WorldFilter, WorldState
from worldstate.abduction.co_evidence import Absent, Present
from worldstate.abduction.cueing.cueing_policy import uncalibrated_policy
from worldstate.abduction.road_users import Familiar, Foreign, WarningSignal
from worldstate.abduction.sequence.sequence_model import GROUPS, AlarmPromise, SequenceAlarm
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.measurement import (
    Approach,
    Bearing,
    Heard,
    Look,
    Position,
    PositionScan,
    SearchedSector,
    Sector,
)
from worldstate.measurement.odometry import EgoPose, Odometry
from worldstate.state import Priors, Rates
from worldstate.state.context import corner_at, open_side

SHARE = np.full(len(GROUPS), 1.0 / len(GROUPS))
SECOND_NS, START_NS = 10**9, 7200 * 10**9


def reading(rng: np.random.Generator, comes: tuple[str | None, str | None], alone: float) -> SequenceReading:
    """Return a reading with a time bin per side; `alone` adds weight to the other side only."""
    groups = rng.uniform(1e-4, 1e-2, (2, len(GROUPS)))
    for side, name in enumerate(comes):
        groups[side, GROUPS.index(name or ("other" if any(comes) else "none"))] += rng.uniform(1.0, 1.2)
    groups[:, GROUPS.index("other")] += alone * any(comes)
    rates = np.sort(groups[0, :6]).tolist()
    alarm = SequenceAlarm(1.0, 20.0, rates[0] if any(comes) else None, AlarmPromise(*rates))
    return SequenceReading(groups / groups.sum(axis=1, keepdims=True), SHARE, 0.1, alarm)


def street(
    rng: np.random.Generator, hops: int, sequence: bool
) -> Iterator[Measurement | PositionScan | Odometry]:
    """Yield hidden vehicles left, on either side and on both, a visible one, messages, radar and odometry."""
    two, phases = ("coming_2s", "coming_2s"), [("coming_2s", None)]
    phases += [two, two, two, ("coming_8s", "coming_8s"), (None, None), ("coming_0.5s", None)]
    for hop in range(1, hops + 1):
        stamp_ns, phase = START_NS + hop * 10**8, hop // 8 % len(phases)
        comes = phases[phase]
        levels = [3.0 * (name is not None) for name in comes]
        said = SignatureEvidence(("left", "right"), tuple(rng.normal(levels).tolist()), 0.0, rng.normal())
        seen = [Sighting(0.5 - 0.05 * (hop % 8), 0.02, "car", 0.9, 0.1)] if phase == 5 else []
        if hop % 7 == 0:
            seen.append(Sighting(-0.1, 0.02, str(rng.choice(["truck", "person"])), 0.8, 0.02, moving=False))
        answer = (Present if seen else Absent)(rng.uniform(0.02, 0.6), rng.uniform(0.01, 0.02))
        sector = None if hop % 5 else (-0.6, 0.6 + 0.01 * hop)
        kinds = {"bicycle": 0.1, "car": 0.8}
        dull = Heard(rng.uniform(0.2, 1.0), str(rng.choice(["wind", "clipped"])), kinds=kinds)
        read = (
            reading(rng, comes, 1.0 * (phase == 2)) if phase != 6 or hop % 2 else NotUsable(f"refused {hop}")
        )
        yield Measurement(
            stamp_ns,
            said,
            answer,
            Bearing(rng.normal(0.6, 0.1), rng.uniform(0.1, 0.3), rng.uniform(2.0, 3.0), at_edge=hop == 1)
            if hop % 3
            else NotUsable("-"),
            Approach(rng.normal(0.4, 0.02), rng.uniform(0.05, 0.1)) if hop % 2 else NotUsable("-"),
            tuple(seen),
            look=Look(f"camera {hop % 2}", stamp_ns - 10**7, answer, sector),
            domain=(
                None,
                Familiar(rng.normal()),
                Foreign(f"like {hop}", rng.normal()),
                WarningSignal(f"siren {hop}", rng.normal()),
            )[hop % 4],
            heard=dull if phase == 4 else Heard(),
            source=("acoustic", "roof")[hop % 2],
            sequence=read if sequence else None,
        )
        if hop % 4 == 0 and (hop > 24 or not sequence):  # An entity with a position has no unknown side
            spread = np.diag(rng.uniform(0.1, 0.4, 4))
            there = Position(
                (9.0, 25.0 - 0.3 * hop),
                tuple(map(tuple, spread)),
                (0.0, -8.0),
                rng.uniform(0.8, 0.9),
                (("van", 0.8),),
            )
            yield PositionScan("v2x", stamp_ns + 10**6, (there,))
            ahead = Position((12.0 + 0.1 * hop, 0.5), tuple(map(tuple, spread)), (2.0, 0.1), 0.8)
            behind = replace(ahead, position_m=(25.0, 0.4))
            yield PositionScan(
                "radar",
                stamp_ns + 2 * 10**6,
                (ahead, behind),
                SearchedSector(Sector(0.0, 0.5), 80.0, rng.uniform(0.8, 0.9)),
            )
        if hop % 6 == 0:
            pose = EgoPose((0.02 * hop, 0.01 * hop), 0.001 * hop) if hop % 12 == 0 else None
            yield Odometry(
                "wheels", stamp_ns + 3 * 10**6, rng.uniform(0.0, 0.5), rng.normal() * 0.01, pose=pose
            )


def odd_deliveries(last: Measurement) -> Iterator[Measurement | PositionScan]:
    """Yield repeated, late, too late and future measurements, and too many boxes and positions."""
    yield last
    yield replace(last, stamp_ns=last.stamp_ns - 10**8 - 1)
    yield replace(last, stamp_ns=last.stamp_ns - 9 * SECOND_NS)
    boxes = tuple(Sighting(0.01 * one - 0.3, 0.001, "car", 0.9) for one in range(70))
    yield replace(last, stamp_ns=last.stamp_ns + 10**8, sightings=boxes)
    many = tuple(Position((5.0 + one, 20.0), ((0.01, 0.0), (0.0, 0.01))) for one in range(128))
    yield PositionScan("lidar", last.stamp_ns + 2 * 10**8, many)
    yield replace(last, stamp_ns=last.stamp_ns + 3600 * SECOND_NS)
    for late_s in (3600, 3598):
        yield replace(last, stamp_ns=last.stamp_ns - late_s * SECOND_NS)


def states() -> Iterator[WorldState]:
    """Yield snapshots with a sequence, a budget, other corners, no model and a monitored budget."""
    rng = np.random.default_rng(0)
    there = Context(
        rates=Rates(*rng.uniform(0.01, 0.1, 6).tolist()),
        occluders=(corner_at("left", (8.0, 4.0), 12.0), open_side("right", -1)),
        priors=Priors(0.1, 0.3, 0.6),
        hidden_by_side={"left": 0.2},
        ego_speed_mps=1.0,
        degradation=0.2,
        site="there",
        view_half_angle_rad=0.7,
    )
    corners = (corner_at("left", (9.0, 5.0), 13.0), corner_at("right", (8.0, -4.0), 12.0))
    budget = replace(uncalibrated_policy(), alpha=0.02)
    worlds = [
        (WorldFilter(start_ns=START_NS), True),
        (WorldFilter(there, budget, start_ns=START_NS), False),
        (WorldFilter(Context(occluders=corners), start_ns=START_NS), True),
        (WorldFilter(start_ns=START_NS, no_model=NotUsable("no model")), False),
    ]
    for world, sequence in worlds:
        yield world.state
        last = None
        for one in street(rng, 60, sequence):
            world = world.update(one)
            yield world.state
            last = one if isinstance(one, Measurement) else last
        for one in odd_deliveries(last):
            world = world.update(one)
            yield world.state
        yield world.predict(2.0).state
        yield world.refused(3).state
    # A camera monitors the budget, which breaks; a later vehicle is not announced.
    world = WorldFilter(start_ns=WATCHED_NS)
    for one in (*false_alarms(), *arrival(500, level=2.0)):
        world = world.update(one)
        yield world.state


def told(value: Any, values: dict[str, set[str]]) -> None:
    """Collect the values of every quantity of a snapshot."""
    for one in value if isinstance(value, tuple) else ():
        told(one, values)
    if is_dataclass(value):
        for field in fields(value):
            values[f"{type(value).__name__}.{field.name}"].add(repr(getattr(value, field.name)))
            told(getattr(value, field.name), values)


def test_no_published_quantity_stays_at_one_value() -> None:
    values: dict[str, set[str]] = defaultdict(set)
    for state in states():
        told(state, values)
    assert [name for name in quantities() if len(values[name]) < 2] == []
