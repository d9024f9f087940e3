"""Several cameras per hop: each searches its own view, and one vehicle stays one entity."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate import (
    Absent,
    Context,
    Measurement,
    NotUsable,
    Present,
    Sighting,
    SignatureEvidence,
    Unqueried,
    WorldFilter,
)
from worldstate.abduction.sequence.sequence_model import GROUPS, SequenceAlarm
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.measurement import Bearing, Odometry, Position, PositionScan, SearchedSector, Sector
from worldstate.measurement.measurement import CameraLook, Look
from worldstate.state import blind_corner
from worldstate.state.context import corner_at

SILENT, EVEN = NotUsable("-"), SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)
FRONT, LEFT, REAR = (-0.6, 0.6), (0.3, 1.5), (2.4, -2.4)
SHARE = np.full(len(GROUPS), 1.0 / len(GROUPS))


def car(azimuth_rad, std_rad=0.02, score=0.9):
    return Sighting(azimuth_rad, std_rad, "car", score, 0.05)


def camera(name, time_s, sector_rad, *sightings, miss_rate=0.05):
    answer = Present(miss_rate, 0.01) if sightings else Absent(miss_rate, 0.01)
    return CameraLook(Look(name, round(time_s * 1e9), answer, sector_rad), sightings)


def measured(time_s, first, *further, source="acoustic", sequence=None):
    stamp_ns, answer = round(time_s * 1e9), first.look.answer
    seen = first.sightings, first.look
    return Measurement(
        stamp_ns, EVEN, answer, SILENT, SILENT, *seen, sequence=sequence, source=source, further=further
    )


def after(*measurements):
    world = WorldFilter()
    for one in measurements:
        world = world.update(one)
    return world


def reading(rng):
    return SequenceReading(rng.dirichlet(np.full(len(GROUPS), 0.5), 2), SHARE, 0.2, SequenceAlarm(1.0, 20.0))


def test_boxes_in_the_overlap_of_two_cameras_are_fused() -> None:
    hops = (1.0, 1.1, 1.2)
    both = after(*(measured(t, camera("front", t, FRONT, car(0.45)), camera("left", t, LEFT, car(0.46)))
                   for t in hops))  # fmt: skip
    alone = after(*(measured(t, camera("front", t, FRONT, car(0.45))) for t in hops))
    (entity,), (other,) = both.state.entities, alone.state.entities
    assert other.azimuth_rad < entity.azimuth_rad < 0.46
    assert entity.azimuth_std_rad < other.azimuth_std_rad
    assert [one.sensor for one in both.state.searched] == ["front", "left"]
    assert both.state.searched[1].sector_rad == LEFT


def test_two_vehicles_in_the_overlap_stay_two() -> None:
    boxes = car(0.35), car(0.55)
    one = measured(1.0, camera("front", 1.0, FRONT, *boxes), camera("left", 1.0, LEFT, *boxes))
    assert len(after(one).state.entities) == 2


@pytest.mark.parametrize("boxes", [(), (car(2.9),), (car(2.9), car(-2.6))])
def test_a_rear_camera_does_not_change_the_front(boxes) -> None:
    rng, times = np.random.default_rng(4), [1.0 + 0.1 * hop for hop in range(10)]
    readings = [reading(rng) for _ in times]

    def ahead(*, rear):
        hops = []
        for at, heard in zip(times, readings, strict=True):
            seen = (car(0.5 - 0.05 * (at - 1.0)),) if at < 1.55 else ()
            others = (camera("rear", at, REAR, *boxes),) if rear else ()
            hops.append(measured(at, camera("front", at, FRONT, *seen), *others, sequence=heard))
        state = after(*hops).state
        near = [one for one in state.entities if abs(one.azimuth_rad) < 1.5]
        cues = [(cue.risk, *(cue.within or {}).values(), cue.hypotheses.visible) for cue in state.cues]
        return [(one.existence_probability, one.azimuth_rad, one.azimuth_std_rad) for one in near], cues

    for told, alone in zip(ahead(rear=True), ahead(rear=False), strict=True):
        np.testing.assert_allclose(told, alone, rtol=0.0, atol=1e-12)


def test_the_miss_rates_of_two_cameras_multiply() -> None:
    begun = after(measured(1.0, camera("front", 1.0, FRONT, car(0.45))))
    alive = begun.predict_to(1_400_000_000).state.entities[0].existence_probability
    both = measured(1.4, camera("front", 1.4, FRONT, miss_rate=0.3), camera("left", 1.4, LEFT, miss_rate=0.2))
    missed = 0.3 * 0.2
    expected = alive * missed / (1.0 - alive + alive * missed)
    (entity,) = begun.update(both).state.entities
    assert entity.existence_probability == pytest.approx(expected, rel=1e-9)


def test_absence_counts_by_the_searched_share_of_the_line_of_sight() -> None:
    """A camera that searches half of the visible sector has less effect than one that searches all of it."""
    rng = np.random.default_rng(5)
    heard = reading(rng)
    half = (math.radians(-64.0), math.radians(0.0))  # Half of the 64 degrees between the corners

    def seen_nobody(sector):
        world = after(measured(1.0, camera("one", 1.0, sector), sequence=heard))
        terms = world.state.cues[0].evidence.terms_nats
        return abs(terms["looks"])

    assert seen_nobody(REAR) == pytest.approx(0.0, abs=1e-9)  # Up to the accuracy of the prediction
    assert 0.0 < seen_nobody(half) < seen_nobody(FRONT)


def test_a_look_counts_once_per_camera() -> None:
    begun = after(measured(1.0, camera("front", 1.0, FRONT, car(0.45))))
    looks = camera("front", 1.4, FRONT, miss_rate=0.3), camera("left", 1.4, LEFT, miss_rate=0.2)
    once = begun.update(measured(1.4, *looks))
    again = once.update(measured(1.4, *looks, source="second"))
    assert again.state.entities == once.state.entities
    # Only the second camera is new.
    half = begun.update(measured(1.4, looks[0])).update(measured(1.4, *looks, source="second"))
    assert half.state.entities[0].existence_probability == pytest.approx(
        once.state.entities[0].existence_probability, rel=1e-9
    )


def test_extreme_deviations_and_contradictions_stay_finite() -> None:
    """Squares of the deviations underflow, and two perfect cameras disagree."""
    sharp = measured(
        1.0, camera("front", 1.0, FRONT, car(0.45, 1e-300)), camera("left", 1.0, LEFT, car(0.45, 1e-300))
    )
    (entity,) = after(sharp).state.entities
    assert entity.azimuth_rad == pytest.approx(0.45)
    coming = np.full((2, len(GROUPS)), 1e-3)
    coming[:, GROUPS.index("coming_2s")] = 0.9
    said = SequenceReading(coming / coming.sum(axis=1, keepdims=True), SHARE, 0.2, SequenceAlarm(1.0, 20.0))
    sure = (Present(0.0, 1e-12), Absent(0.0, 1e-12))
    looks = [CameraLook(Look(f"camera {k}", 10**9, one)) for k, one in enumerate(sure)]
    state = after(measured(1.0, *looks, sequence=said)).state
    for cue in state.cues:
        soon = cue.within["3"]
        terms = sum(cue.evidence.terms_nats.values())
        assert terms == pytest.approx(math.log(soon / (1.0 - soon)), abs=1e-6)


@given(st.floats(0.3, 1.0), st.floats(0.0, 0.5), st.floats(0.0, 0.5))
def test_a_camera_may_cover_the_whole_line_of_sight(edge_rad, right_rad, left_rad) -> None:
    """The overlap may exceed the whole by a rounding error."""
    left, right = (replace(blind_corner(name, side), edge_azimuth_rad=side * edge_rad)
                   for name, side in (("left", 1), ("right", -1)))  # fmt: skip
    look = camera("front", 1.0, (-edge_rad - right_rad, edge_rad + left_rad), miss_rate=0.0)
    state = WorldFilter(Context(occluders=(left, right))).update(measured(1.0, look)).state
    assert state.searched[0].miss_rate == 0.0


def test_a_vehicle_stays_visible_between_two_cameras() -> None:
    path = [(1.0 + 0.1 * hop, 0.5 + 0.04 * hop) for hop in range(12)]
    world = after(*(
        measured(at, camera("front", at, FRONT, *[car(az)] * (az < 0.58)),
                 camera("left", at, LEFT, *[car(az)] * (az > 0.32)))
        for at, az in path
    ))  # fmt: skip
    (entity,) = world.state.entities
    assert (entity.visibility.answer, entity.status) == ("visible", "visible")
    assert entity.azimuth_rad == pytest.approx(path[-1][1], abs=0.03)
    # Only the front camera has a new image, so the last image of the left one still holds.
    (entity,) = world.update(measured(2.15, camera("front", 2.15, FRONT))).state.entities
    assert entity.visibility.answer == "visible"


def test_a_checkpoint_holds_the_looks_of_all_cameras() -> None:
    at = measured(1.0, camera("front", 1.0, FRONT, car(0.45)), camera("left", 1.0, LEFT, car(0.46)))
    world = after(at)
    copy = WorldFilter.from_dict(json.loads(json.dumps(world.to_dict(), allow_nan=False)))
    late = measured(0.9, camera("front", 0.9, FRONT, car(0.44)), camera("left", 0.9, LEFT))
    assert copy.update(late).state == world.update(late).state


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.permutations(["front", "left", "rear"]))
def test_camera_names_do_not_matter(seed: int, names: list[str]) -> None:
    """The identity of a box in the overlap does not depend on the name of a camera."""
    rng, views = np.random.default_rng(seed), ((-0.6, 0.6), (0.2, 1.5), (-1.5, 0.5))
    hops = []
    for hop in range(10, 20):
        found = [[car(rng.uniform(*ends), score=rng.uniform(0.5, 1.0)) for _ in range(rng.integers(4))]
                 for ends in views]  # fmt: skip
        hops.append((0.1 * hop, reading(rng), found))

    def stated(names):
        looks = [(at, heard, [camera(*one) for one in
                  [(name, at, view, *boxes) for name, view, boxes in zip(names, views, found, strict=True)]])
                 for at, heard, found in hops]  # fmt: skip
        world = after(*(measured(at, *cameras, sequence=heard) for at, heard, cameras in looks))
        return numbers(world.state)

    np.testing.assert_allclose(stated(names), stated(["front", "left", "rear"]), atol=1e-9)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10**6), st.permutations(["acoustic", "radar", "second", "v2x"]))
def test_source_names_do_not_matter(seed: int, names: list[str]) -> None:
    """Sound, two radars and messages have equal stamps."""
    rng = np.random.default_rng(seed)
    radar = SearchedSector(Sector(0.0, 1.0), 60.0, 0.9)
    hops = []
    for hop in range(10, 20):
        places = [Position((rng.uniform(8.0, 40.0), rng.uniform(-12.0, 12.0)), ((0.3, 0.0), (0.0, 0.3)))
                  for _ in range(6)]  # fmt: skip
        box = car(rng.uniform(-0.5, 0.5))
        hops.append((0.1 * hop, reading(rng), box, places))

    def stated(names):
        world, (sound, *others) = WorldFilter(), names
        for at, heard, box, places in hops:
            stamp_ns, searched = round(at * 1e9), (radar, radar, None)
            scans = [PositionScan(name, stamp_ns, tuple(places[2 * i : 2 * i + 2]), searched[i])
                     for i, name in enumerate(others)]  # fmt: skip
            look = camera("front", at, FRONT, box)
            for one in (measured(at, look, source=sound, sequence=heard), *scans):
                world = world.update(one)
        return numbers(world.state)

    np.testing.assert_allclose(stated(names), stated(["acoustic", "radar", "second", "v2x"]), atol=1e-9)


def test_boxes_of_three_cameras_are_fused_by_their_precisions() -> None:
    stds, azimuths = (0.02, 0.01, 0.04), (0.40, 0.41, 0.43)
    views = (FRONT, LEFT, (-1.5, 0.5))
    seen = [camera(name, 1.0, view, car(azimuth, std)) for name, view, azimuth, std in
            zip("abc", views, azimuths, stds, strict=True)]  # fmt: skip
    (entity,) = after(measured(1.0, *seen)).state.entities
    weights = 1.0 / np.square(stds)
    assert entity.azimuth_rad == pytest.approx(weights @ azimuths / weights.sum(), abs=1e-6)
    assert entity.azimuth_std_rad == pytest.approx(weights.sum() ** -0.5, rel=1e-6)


def numbers(state):
    """Return the numbers of entities and sides as one row."""
    entities = [(one.existence_probability, one.hidden_probability, one.azimuth_rad, one.azimuth_std_rad,
                 len(one.classification)) for one in state.entities]  # fmt: skip
    cues = [(one.risk, *(one.within or {}).values(), *vars_of(one.hypotheses)) for one in state.cues]
    return [number for row in (*entities, *cues) for number in row]


def vars_of(priors):
    return priors.hidden, priors.visible, priors.none


def test_an_all_round_look_searches_the_line_of_sight() -> None:
    sound = Measurement(
        10**9, EVEN, Absent(0.1, 0.01), SILENT, SILENT, sequence=reading(np.random.default_rng(1))
    )
    ahead, round_about = (
        after(replace(sound, look=Look("camera", 10**9, Absent(0.1, 0.01), ends))).state
        for ends in ((-1.5, 1.5), (-math.pi, math.pi))
    )
    assert round_about.searched[0].sector_rad == (-math.pi, math.pi)
    assert numbers(round_about) == pytest.approx(numbers(ahead), abs=1e-12)
    assert Sector.between(0.0, math.tau) == Sector.between(-math.pi, math.pi) == Sector(0.0, math.pi)


@pytest.mark.parametrize("context, ends", [(Context(view_half_angle_rad=0.0), None), (Context(), (0.3, 0.3))])
def test_a_look_at_an_empty_sector_changes_nothing(context, ends) -> None:
    look = Look("camera", 10**9, Absent(0.1, 0.01), ends)
    state = (
        WorldFilter(context).update(Measurement(10**9, EVEN, Unqueried("-"), SILENT, SILENT, look=look)).state
    )
    assert len(state.searched) == 1 and not state.entities


def test_a_mirrored_world_has_the_mirrored_state() -> None:
    for seed in (0, 2, 3):
        rng = np.random.default_rng(seed)
        world = reflection = WorldFilter(CORNERS)
        for hop in range(30):
            one = something(rng, 0.1 * hop + 0.1)
            world, reflection = world.update(one), reflection.update(mirrored(one))
            here, there = (published(one, sign) for one, sign in ((world.state, 1), (reflection.state, -1)))
            assert there == pytest.approx(here, abs=2e-5), (seed, hop)


CORNERS = Context(occluders=(corner_at("left", (8.0, 4.0), 12.0), corner_at("right", (8.0, -4.0), 12.0)))


def something(rng, time_s):
    """Return a random measurement of two cameras, a radar, a radio or odometry."""
    stamp_ns, kind = round(time_s * 1e9), rng.random()
    if kind < 0.1:
        return Odometry("wheels", stamp_ns, float(rng.uniform(0.0, 2.0)), float(rng.normal(0.0, 0.3)))
    if kind < 0.4:
        places = [
            (float(rng.uniform(3.0, 30.0)), float(rng.uniform(-25.0, 25.0))) for _ in range(rng.integers(3))
        ]
        exists = float(rng.uniform(0.5, 0.95))
        found = tuple(Position(at, ((0.3, 0.1), (0.1, 0.4)), None, exists, (("car", 0.8),)) for at in places)
        sector = SearchedSector(Sector(float(rng.uniform(-0.5, 0.5)), 0.8), 60.0, 0.9)
        return (
            PositionScan("radar", stamp_ns, found, sector)
            if kind < 0.25
            else PositionScan("v2x", stamp_ns, found)
        )

    def boxes(low, high):
        return [Sighting(float(rng.uniform(low, high)), 0.03, str(rng.choice(["car", "truck"])), 0.9, 0.1)
                for _ in range(rng.integers(3))]  # fmt: skip

    looks = camera("front", time_s, FRONT, *boxes(-0.7, 0.7)), camera("left", time_s, LEFT, *boxes(0.3, 1.5))
    left, right, visible, none = rng.normal(0.0, 2.0, 4).tolist()
    said = SignatureEvidence(("left", "right"), (left, right), visible, none)
    bearing = Bearing(float(rng.uniform(-1.5, 1.5)), 0.1)
    return replace(measured(time_s, *looks), signature=said, bearing=bearing)


def mirrored(one):
    """Return the mirrored measurement."""
    if isinstance(one, Odometry):
        return replace(one, yaw_rate_rad_s=-one.yaw_rate_rad_s)
    if isinstance(one, PositionScan):
        places = tuple(replace(place, position_m=(place.position_m[0], -place.position_m[1]),
                               covariance=((0.3, -0.1), (-0.1, 0.4))) for place in one.positions)  # fmt: skip
        sector = one.searched and replace(one.searched.sector, centre_rad=-one.searched.sector.centre_rad)
        return replace(one, positions=places, searched=one.searched and replace(one.searched, sector=sector))

    def flipped(boxes):
        return tuple(replace(box, azimuth_rad=-box.azimuth_rad) for box in boxes)

    def turned(look):
        right_rad, left_rad = look.sector_rad
        return replace(look, sector_rad=(-left_rad, -right_rad))

    return replace(
        one,
        signature=replace(one.signature, hidden=one.signature.hidden[::-1]),
        bearing=replace(one.bearing, azimuth_rad=-one.bearing.azimuth_rad),
        sightings=flipped(one.sightings),
        look=turned(one.look),
        further=tuple(CameraLook(turned(seen.look), flipped(seen.sightings)) for seen in one.further),
    )


def published(state, sign):
    """Return the numbers of entities and sides as one row, mirrored if sign is -1."""
    entities = sorted(
        # Sorted by azimuth, because existence may be equal up to rounding.
        (sign * one.azimuth_rad, one.existence_probability, one.hidden_probability, one.azimuth_std_rad)
        for one in state.entities
    )
    cues = sorted(state.cues, key=lambda cue: sign * cue.azimuth_rad)
    sides = [(cue.risk, cue.advisory is not None, *vars_of(cue.hypotheses)) for cue in cues]
    return [float(number) for row in (*entities, *sides) for number in row]
