"""Fault campaign: measurements of the whole accepted range, late, repeated, reordered; clocks that jump."""

import json
from dataclasses import replace

import numpy as np
import pytest
from snapshot_laws import broken_laws
from street_measurements import ABSENT, CORNERS, PRESENT, SHARE, SILENT, UNASKED, Timed, after, hop

from worldstate import (
    Measurement,
    Sighting,
    SignatureEvidence,
    WorldFilter,
    WorldState,
)
from worldstate.abduction.co_evidence import Absent, CoEvidence, Present, Unqueried
from worldstate.abduction.road_users import Familiar, Foreign, WarningSignal
from worldstate.abduction.sequence.sequence_model import GROUPS, AlarmPromise, SequenceAlarm
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.measurement import (
    Approach,
    Bearing,
    CameraLook,
    Heard,
    Look,
    Position,
    PositionScan,
    SearchedSector,
    Sector,
)
from worldstate.measurement.odometry import EgoPose, Odometry
from worldstate.state import Delivery

TINY, SECOND_NS, HOUR_NS = 5e-324, 10**9, 3600 * 10**9
FLAT, LEFT = (0.0,) * 4, (4.0, 0.0, 0.0, 0.0)


def extreme(rng: np.random.Generator, low: float, high: float) -> float:
    """Return an end of a range, a value near zero, or a uniform value."""
    kind = rng.random()
    if kind < 0.2:
        return low if kind < 0.1 else high
    return float(np.clip(rng.normal() * 1e-300, low, high)) if kind < 0.3 else float(rng.uniform(low, high))


def answer(rng: np.random.Generator) -> CoEvidence:
    miss, clutter = extreme(rng, 0.0, 1.0), extreme(rng, TINY, 0.999)
    return (Unqueried("-"), Absent(miss, clutter), Present(miss, clutter))[int(rng.integers(0, 3))]


def reading(rng: np.random.Generator) -> SequenceReading:
    groups = np.nan_to_num(rng.dirichlet(np.full(len(GROUPS), rng.choice([0.01, 0.2, 5.0])), 2)) + 1e-12
    margin_s, rates = abs(extreme(rng, 0.0, 2.0)), np.sort(rng.random(6)).tolist()
    alarm = SequenceAlarm(0.0, 20.0, rates[0] if rng.random() < 0.5 else None, AlarmPromise(*rates))
    return SequenceReading(groups / groups.sum(axis=1, keepdims=True), SHARE, margin_s, alarm)


def sighting(rng: np.random.Generator) -> Sighting:
    azimuth_rad, std_rad = extreme(rng, -np.pi, np.pi), max(extreme(rng, 0.0, 1e3), TINY)
    label = str(rng.choice(["car", "truck", "pedestrian"]))
    moves = bool(rng.random() < 0.7)
    return Sighting(azimuth_rad, std_rad, label, extreme(rng, 0.0, 1.0), extreme(rng, 0.0, 3.0), moves)


def measurement(rng: np.random.Generator, stamp_ns: int) -> Measurement:
    nats = rng.normal(0.0, 1.0, 4) * rng.choice([1.0, 10.0, 500.0])
    left, right, visible, none = nats.clip(-1000.0, 1000.0).tolist()
    said, azimuth_rad, rate_hz = answer(rng), extreme(rng, -np.pi, np.pi), extreme(rng, -1e3, 1e3)
    bearing = Bearing(
        azimuth_rad, max(extreme(rng, 0.0, 1e3), TINY), 1.0 + extreme(rng, 0.0, 10.0), rng.random() < 0.1
    )
    approach = Approach(rate_hz, max(extreme(rng, 0.0, 1e6), TINY))
    taken_ns = stamp_ns - int(rng.integers(0, SECOND_NS))
    look = None if isinstance(said, Unqueried) or rng.random() < 0.5 else Look("camera", taken_ns, said)
    boxes = int(rng.integers(0, 6)) if rng.random() < 0.4 else 0
    looks = [Look(name, taken_ns, answer(rng), (-0.1, 1.5)) for name in ("left", "right")]
    seen = (tuple(sighting(rng) for _ in range(rng.integers(3))) for _ in looks)
    further = tuple(map(CameraLook, looks, seen)) if rng.random() < 0.2 else ()
    reason, kinds = str(rng.choice(["wind", "clipped"])), {"car": extreme(rng, 0.0, 1.0)}
    heard = Heard(extreme(rng, 0.0, 1.0), reason, kinds=kinds) if rng.random() < 0.3 else Heard()
    level = float(rng.normal())
    verdicts = Familiar(level), Foreign(f"like {level}", level), WarningSignal(f"siren {level}", level)
    domain = verdicts[rng.integers(3)] if rng.random() < 0.1 else None
    return Measurement(
        stamp_ns,
        SignatureEvidence(("left", "right"), (left, right), visible, none),
        said,
        bearing if rng.random() < 0.5 else SILENT,
        approach if rng.random() < 0.5 else SILENT,
        tuple(sighting(rng) for _ in range(boxes)),
        look=look,
        sequence=(reading(rng), reading(rng), SILENT, None)[int(rng.integers(0, 4))],
        domain=domain,
        source=str(rng.choice(["acoustic", "v2x", "radar"])),
        further=further,
        heard=heard,
    )


def scan(rng: np.random.Generator, stamp_ns: int) -> PositionScan:
    """Return positions over the whole accepted range, from none to the maximum of one scan."""
    searched = None
    if rng.random() < 0.5:
        sector = Sector(extreme(rng, -np.pi, np.pi), max(extreme(rng, 0.0, np.pi), TINY))
        found, clutter = (min(extreme(rng, low, 1.0), 0.999) for low in (0.0, TINY))
        searched = SearchedSector(sector, max(extreme(rng, 0.0, 1e4), TINY), found, clutter)
    n = 128 if rng.random() < 0.01 else int(rng.integers(0, 5))
    positions = tuple(position(rng) for _ in range(n))
    latency_s = abs(extreme(rng, 0.0, 3.0)) if rng.random() < 0.1 else 0.0
    return PositionScan(str(rng.choice(["v2x", "lidar"])), stamp_ns, positions, searched, latency_s)


def position(rng: np.random.Generator) -> Position:
    known = 4 if rng.random() < 0.5 else 2
    turn, _ = np.linalg.qr(rng.normal(size=(known, known)))
    spread = turn @ np.diag(10.0 ** rng.uniform(-5.9, 5.9, known)) @ turn.T
    reach = float(rng.choice([1.0, 50.0, 1e4]))
    at = (extreme(rng, -reach, reach), extreme(rng, -reach, reach))
    velocity = (extreme(rng, -200.0, 200.0), extreme(rng, -200.0, 200.0)) if known == 4 else None
    exists = float(np.clip(extreme(rng, 0.0, 1.0), TINY, 1.0 - 1e-16))
    return Position(at, tuple(map(tuple, spread)), velocity, exists, (("car", extreme(rng, 0.0, 1.0)),))


def odometry(rng: np.random.Generator, stamp_ns: int) -> Odometry:
    """Return odometry over the whole accepted range, sometimes with a distant pose."""
    at = (extreme(rng, -1e6, 1e6), extreme(rng, -1e6, 1e6)), extreme(rng, -np.pi, np.pi)
    stds = max(extreme(rng, 0.0, 1e3), TINY), max(extreme(rng, 0.0, np.pi), TINY)
    near = EgoPose((float(rng.uniform(-5.0, 5.0)), 0.0), float(rng.uniform(-0.5, 0.5)))
    pose = (None, None, near, EgoPose(*at, *stds))[int(rng.integers(0, 4))]
    twist = extreme(rng, -100.0, 100.0), extreme(rng, -10.0, 10.0)
    deviations = abs(extreme(rng, 0.0, 100.0)), abs(extreme(rng, 0.0, 10.0))
    return Odometry("wheels", stamp_ns, *twist, *deviations, pose=pose)


def something(rng: np.random.Generator, stamp_ns: int) -> Timed:
    kind = rng.random()
    if kind < 0.1:
        return odometry(rng, stamp_ns)
    return scan(rng, stamp_ns) if kind < 0.35 else measurement(rng, stamp_ns)


# The names of all sources and sensors.
NAMES = ("acoustic", "camera", "left", "lidar", "radar", "right", "v2x", "wheels")


def renamed(one: Timed, names: dict[str, str], rng: np.random.Generator) -> Timed:
    """Return a measurement with other names, and with unordered items in another order."""

    def look(told: Look) -> Look:
        return replace(told, sensor=names[told.sensor])

    def mixed(many: tuple) -> tuple:
        return tuple(many[i] for i in rng.permutation(len(many)))

    one = replace(one, source=names[one.source])
    if isinstance(one, PositionScan):
        return replace(one, positions=mixed(one.positions))
    if isinstance(one, Odometry):
        return one
    further = tuple(CameraLook(look(its.look), mixed(its.sightings)) for its in one.further)
    main = None if one.look is None else look(one.look)
    return replace(one, sightings=mixed(one.sightings), look=main, further=mixed(further))


def numbers(state: WorldState, names: dict[str, str]) -> dict[str, object]:
    """Return all values of a state by their path, with other names of sources and sensors."""
    found: dict[str, object] = {}

    def note(place: str, value: object) -> None:
        if isinstance(value, dict):
            for key, part in value.items():
                kind, _, source = key.partition(" ")
                note(f"{place}.{kind}{source and names.get(source, source)}", part)
        elif isinstance(value, list):
            parts = [(one.get("sensor"), one) if isinstance(one, dict) else (one, one) for one in value]
            is_named = place.endswith(("sensors", "searched", "heard", "sources"))
            for number, (sensor, part) in enumerate(parts):
                note(f"{place}.{names.get(sensor, sensor) if is_named else number}", part)
        elif not place.endswith(".sensor") and ".sources." not in place:
            found[place] = value

    note("", state.to_dict())
    return found


def campaign(rng: np.random.Generator, steps: int) -> WorldFilter:
    """Filter random inputs, also renamed and reordered, and check every state against the laws."""
    others = [str(one) for one in rng.permutation([*NAMES, *(f"sensor {one}" for one in NAMES)])]
    names, order = dict(zip(NAMES, others, strict=False)), np.random.default_rng(0)
    first = {name: one for one, name in names.items()}
    world, now_ns, last = WorldFilter(CORNERS), HOUR_NS, something(rng, HOUR_NS)
    other, before = world, world.state
    for step in range(steps):
        now_ns += int(rng.choice([10**7, 10**8, 10**8, 5 * 10**8]))
        kind = rng.random()
        if kind < 0.004:
            now_ns = max(now_ns + HOUR_NS if kind < 0.002 else now_ns - HOUR_NS, HOUR_NS)
        late_ns = int(rng.integers(0, 3 * SECOND_NS)) if rng.random() < 0.1 else 0
        last = last if rng.random() < 0.05 else something(rng, now_ns - late_ns)
        pairs = [(world.update(last), other.update(renamed(last, names, order)))]
        if rng.random() < 0.02:
            then_ns = pairs[0][0].stamp_ns + int(rng.integers(0, 2 * SECOND_NS))
            pairs.append(tuple(one.predict_to(then_ns) for one in pairs[0]))
        for one, _ in pairs:
            assert not broken_laws(one.state, before), step
            before = one.state
        world, other = pairs[-1]
        if step % 10 == 0:
            assert numbers(other.state, first) == pytest.approx(numbers(before, {}), rel=1e-6, abs=1e-9), step
        if step % 100 == 0:
            copy = WorldFilter.from_dict(json.loads(json.dumps(world.to_dict(), allow_nan=False)))
            again = something(rng, world.stamp_ns + 10**8)
            assert copy.update(again).state == world.update(again).state
    return world


def test_accepted_measurements_keep_state_and_checkpoint_valid() -> None:
    world = campaign(np.random.default_rng(1), 700)
    assert world.state.delivery.replayed > 20 and world.state.delivery.repeated > 10


def crowd(rng: np.random.Generator, n: int) -> tuple[Sighting, ...]:
    """Return boxes across an image, a third of them parked."""
    azimuths_rad, scores = rng.uniform(-0.55, 0.55, n).tolist(), rng.uniform(0.3, 1.0, n).tolist()
    drawn = zip(azimuths_rad, scores, rng.random(n) < 0.67, strict=True)
    return tuple(Sighting(at, 0.01, "car", score, moving=bool(moves)) for at, score, moves in drawn)


def test_at_most_64_boxes_of_an_image_are_used() -> None:
    rng = np.random.default_rng(5)
    boxes = crowd(rng, 600)
    counting = sorted(boxes, key=lambda one: (not one.moving, -one.score))[:64]
    order = rng.permutation(600).tolist()
    world = WorldFilter().update(hop(1, FLAT, *(boxes[i] for i in order), answer=PRESENT))
    few = WorldFilter().update(hop(1, FLAT, *counting, answer=PRESENT))
    assert few.state.delivery == Delivery()
    assert world.state == replace(few.state, delivery=Delivery(boxes_left_out=536))
    again = world.update(hop(1, FLAT, *boxes, answer=PRESENT))  # The same delivery
    assert again.state.delivery == Delivery(boxes_left_out=536, repeated=1)
    # The limit applies to each image.
    camera = CameraLook(Look("left", 10**8, PRESENT, (0.5, 1.5)), crowd(rng, 70))
    both = WorldFilter().update(hop(1, FLAT, *boxes[:66], answer=PRESENT, further=(camera,)))
    assert both.state.delivery.boxes_left_out == 2 + 6


def test_the_128_likeliest_and_hidden_entities_are_kept() -> None:
    rng, world = np.random.default_rng(6), after(*(hop(at, LEFT, answer=ABSENT) for at in range(1, 12)))
    (hidden,) = world.state.entities
    for at in range(12, 16):
        # Positions of a radio may appear anywhere.
        claims = tuple(
            Position(tuple(rng.uniform(5.0, 90.0, 2).tolist()), ((0.2, 0.0), (0.0, 0.2)), None, chance)
            for chance in rng.uniform(0.1, 0.9, 100).tolist()
        )
        world = world.update(PositionScan(f"radio {at}", at * 10**8, claims))
        copy = WorldFilter.from_dict(json.loads(json.dumps(world.to_dict())))
        assert copy.state == world.state
    state = world.state
    assert len(state.entities) <= 128 and hidden.id in [one.id for one in state.entities]
    assert state.delivery.tracks_left_out > 50
    chances = [one.existence_probability for one in state.entities if one.id != hidden.id]
    assert min(chances) > 0.25  # Claims begin at 0.1
    # The counters continue if the belief is reset.
    last = hop(1, answer=ABSENT)
    anew = after(*(replace(last, stamp_ns=last.stamp_ns - at) for at in (2 * HOUR_NS, HOUR_NS)), world=world)
    assert anew.state.delivery == replace(state.delivery, too_late=1, reanchored=1)


def test_sources_silent_for_an_hour_are_forgotten() -> None:
    def told(at: int, name: str, world: WorldFilter) -> WorldFilter:
        look = Look(f"camera {name}", at * 10**8, ABSENT)
        sound = hop(at, (-4.0, 0.0, 0.0, 0.0), answer=ABSENT, source=f"sound {name}", look=look)
        scan, twist = PositionScan(f"radar {name}", at * 10**8), Odometry(f"wheels {name}", at * 10**8, 5.0)
        return after(sound, scan, twist, world=world)

    def named(world: WorldFilter) -> list[str]:
        text = json.dumps(world.to_dict())
        return [kind for kind in ("sound", "camera", "radar", "wheels") if f'"{kind} old' in text]

    once = world = told(1, "new", WorldFilter())
    for number in range(30):
        world = told(1, f"old {number}", world)
    for at in (12_000, 24_000, 36_001, 36_002, 36_030):
        if at == 36_002:
            assert len(named(world)) == 4 and len(world.state.sensors) == 4 * 31
        once, world = (told(at, "new", one.predict_to(at * 10**8)) for one in (once, world))
    assert len(world.state.sensors) == 4
    assert named(world) == []
    assert len(json.dumps(world.to_dict())) < 1.1 * len(json.dumps(once.to_dict()))


@pytest.mark.parametrize("off_ns", [-HOUR_NS, 3 * SECOND_NS, HOUR_NS])
def test_a_look_with_a_wrong_stamp_is_ignored(off_ns: int) -> None:
    """The clock of the camera has stopped, or one stamp is wrong."""
    rng, stamp_ns = np.random.default_rng(7), 2 * HOUR_NS
    quiet, world = WorldFilter(start_ns=stamp_ns), WorldFilter(start_ns=stamp_ns)
    for number in range(1, 5):
        now_ns, boxes = stamp_ns + number * 10**8, crowd(rng, 3)
        heard, look = replace(hop(1), stamp_ns=now_ns), Look("camera", now_ns, PRESENT)
        stray = replace(look, stamp_ns=now_ns + off_ns)
        if number < 3:
            world = world.update(replace(heard, look=stray, sightings=boxes))
            quiet = quiet.update(replace(heard, look=replace(look, answer=UNASKED)))
        else:
            world, quiet = (one.update(replace(heard, look=look, sightings=boxes)) for one in (world, quiet))
        assert len(world.state.entities) == len(quiet.state.entities)
    assert world.state.entities


@pytest.mark.slow
def test_a_hundred_thousand_faults() -> None:
    world = campaign(np.random.default_rng(2), 100_000)
    delivery = world.state.delivery
    assert min(delivery.replayed, delivery.repeated, delivery.too_late, delivery.reanchored) > 100
