"""Several cameras per hop: each searches its own view, and one vehicle stays one entity."""

import math
from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from street_measurements import (
    ABSENT,
    CORNERS,
    after,
    car,
    drawn_groups,
    hop,
    ordinary,
    ordinary_scan,
    reading,
    run,
)

from worldstate import Absent, Context, Present, WorldFilter
from worldstate.measurement import Approach, Bearing, CameraLook, Look, Odometry, PositionScan, Sector
from worldstate.state import blind_corner

FRONT, LEFT, REAR = (-0.6, 0.6), (0.3, 1.5), (2.4, -2.4)


def camera(name, number, sector_rad, *sightings, miss_rate=0.05):
    answer = Present(miss_rate, 0.01) if sightings else Absent(miss_rate, 0.01)
    return CameraLook(Look(name, round(number * 1e8), answer, sector_rad), sightings)


def looked(number, first, *further, **parts):
    told = {"answer": first.look.answer, "look": first.look, "further": further}
    return hop(number, (0.0,) * 4, *first.sightings, **told, **parts)


def test_two_vehicles_in_the_overlap_stay_two() -> None:
    boxes = car(0.35), car(0.55)
    one = looked(10, camera("front", 10, FRONT, *boxes), camera("left", 10, LEFT, *boxes))
    assert len(after(one).state.entities) == 2


@pytest.mark.parametrize("boxes", [(), (car(2.9),), (car(2.9), car(-2.6))])
def test_a_rear_camera_does_not_change_the_front(boxes) -> None:
    readings = drawn_groups(np.random.default_rng(4), 10, 2)

    def ahead(*, rear):
        hops = []
        for number, heard in enumerate(readings, 10):
            seen = [car(0.5 - 0.005 * (number - 10))] * (number < 16)
            others = [camera("rear", number, REAR, *boxes)] * rear
            front = camera("front", number, FRONT, *seen)
            hops.append(looked(number, front, *others, sequence=reading(heard, 1.0)))
        state = after(*hops).state
        near = [one for one in state.entities if abs(one.azimuth_rad) < 1.5]
        cues = [(cue.risk, *(cue.within or {}).values(), cue.hypotheses.visible) for cue in state.cues]
        return [(one.existence_probability, one.azimuth_rad, one.azimuth_std_rad) for one in near], cues

    for told, alone in zip(ahead(rear=True), ahead(rear=False), strict=True):
        np.testing.assert_allclose(told, alone, rtol=0.0, atol=1e-12)


def test_the_miss_rates_of_two_cameras_multiply() -> None:
    begun = after(looked(10, camera("front", 10, FRONT, car(0.45))))
    alive = begun.predict_to(1_400_000_000).state.entities[0].existence_probability
    both = looked(14, camera("front", 14, FRONT, miss_rate=0.3), camera("left", 14, LEFT, miss_rate=0.2))
    missed = 0.3 * 0.2
    expected = alive * missed / (1.0 - alive + alive * missed)
    (entity,) = begun.update(both).state.entities
    assert entity.existence_probability == pytest.approx(expected, rel=1e-9)


def test_absence_counts_by_the_searched_share_of_the_line_of_sight() -> None:
    """A camera that searches half of the visible sector has less effect than one that searches all of it."""
    heard = reading(drawn_groups(np.random.default_rng(5), 2))
    half = (math.radians(-64.0), math.radians(0.0))  # Half of the 64 degrees between the corners

    def seen_nobody(sector):
        world = after(looked(10, camera("one", 10, sector), sequence=heard))
        return abs(world.state.cues[0].evidence.terms_nats["looks"])

    assert seen_nobody(REAR) == pytest.approx(0.0, abs=1e-9)  # Up to the accuracy of the prediction
    assert 0.0 < seen_nobody(half) < seen_nobody(FRONT)


def test_a_look_counts_once_per_camera() -> None:
    begun = after(looked(10, camera("front", 10, FRONT, car(0.45))))
    looks = camera("front", 14, FRONT, miss_rate=0.3), camera("left", 14, LEFT, miss_rate=0.2)
    once, again = begun.update(looked(14, *looks)), looked(14, *looks, source="second")
    twice = once.update(again)
    assert twice.state.entities == once.state.entities
    assert twice.belief.hypotheses == pytest.approx(once.belief.hypotheses, abs=1e-9)
    # Only the second camera is new.
    half = after(looked(14, looks[0]), again, world=begun)
    chances = [one.state.entities[0].existence_probability for one in (half, once)]
    assert chances[0] == pytest.approx(chances[1], rel=1e-9)


def test_extreme_deviations_and_contradictions_stay_finite() -> None:
    """Squares of the deviations underflow, and two perfect cameras disagree."""
    sharp = [camera(name, 10, at, car(0.45, 1e-300)) for name, at in (("front", FRONT), ("left", LEFT))]
    (entity,) = after(looked(10, *sharp)).state.entities
    assert entity.azimuth_rad == pytest.approx(0.45)
    sure = (Present(0.0, 1e-12), Absent(0.0, 1e-12))
    looks = [CameraLook(Look(f"camera {k}", 10**9, one)) for k, one in enumerate(sure)]
    state = after(looked(10, *looks, sequence=reading({"coming_2s": 0.9}, 1.0))).state
    for cue in state.cues:
        soon = cue.within["3"]
        terms = sum(cue.evidence.terms_nats.values())
        assert terms == pytest.approx(math.log(soon / (1.0 - soon)), abs=1e-6)


@given(st.floats(0.3, 1.0), st.floats(0.0, 0.5), st.floats(0.0, 0.5))
def test_a_camera_may_cover_the_whole_line_of_sight(edge_rad, right_rad, left_rad) -> None:
    """The overlap may exceed the whole by a rounding error."""
    left, right = (replace(blind_corner(name, side), edge_azimuth_rad=side * edge_rad)
                   for name, side in (("left", 1), ("right", -1)))  # fmt: skip
    look = camera("front", 10, (-edge_rad - right_rad, edge_rad + left_rad), miss_rate=0.0)
    state = WorldFilter(Context(occluders=(left, right))).update(looked(10, look)).state
    assert state.searched[0].miss_rate == 0.0


def test_a_vehicle_stays_visible_between_two_cameras() -> None:
    path = [(10 + step, 0.5 + 0.04 * step) for step in range(12)]
    world = after(*(
        looked(at, camera("front", at, FRONT, *[car(az)] * (az < 0.58)),
               camera("left", at, LEFT, *[car(az)] * (az > 0.32)))
        for at, az in path
    ))  # fmt: skip
    (entity,) = world.state.entities
    assert (entity.visibility.answer, entity.status) == ("visible", "visible")
    assert entity.azimuth_rad == pytest.approx(path[-1][1], abs=0.03)
    # Only the front camera has a new image, so the last image of the left one still holds.
    (entity,) = world.update(looked(21.5, camera("front", 21.5, FRONT))).state.entities
    assert entity.visibility.answer == "visible"


def test_boxes_of_three_cameras_are_fused_by_their_precisions() -> None:
    stds, azimuths = (0.02, 0.01, 0.04), (0.40, 0.41, 0.43)
    views = (FRONT, LEFT, (-1.5, 0.5))
    seen = [camera(name, 10, view, car(azimuth, std)) for name, view, azimuth, std in
            zip("abc", views, azimuths, stds, strict=True)]  # fmt: skip
    state = after(looked(10, *seen)).state
    (entity,) = state.entities
    weights = 1.0 / np.square(stds)
    assert entity.azimuth_rad == pytest.approx(weights @ azimuths / weights.sum(), abs=1e-6)
    assert entity.azimuth_std_rad == pytest.approx(weights.sum() ** -0.5, rel=1e-6)
    assert [(one.sensor, one.sector_rad) for one in state.searched] == [*zip("abc", views, strict=True)]


def numbers(state, sign=1):
    """Return the numbers of entities and sides as one row, mirrored if sign is -1."""
    # Sorted by azimuth, because existence may be equal up to rounding.
    entities = sorted(
        (sign * one.azimuth_rad, one.existence_probability, one.hidden_probability, one.azimuth_std_rad,
         one.inverse_tta_hz or 0.0, one.moving, len(one.classification)) for one in state.entities
    )  # fmt: skip
    cues = sorted(state.cues, key=lambda cue: sign * cue.azimuth_rad)
    sides = [(cue.risk, *(cue.within or {}).values(), cue.advisory is not None, *astuple(cue.hypotheses),
              *(cue.time_to_visible_s or ())) for cue in cues]  # fmt: skip
    relations = sorted(one.probability for one in state.relations)
    return [float(number) for row in (*entities, *sides, relations) for number in row]


def test_an_all_round_look_searches_the_line_of_sight() -> None:
    heard, ends = reading(drawn_groups(np.random.default_rng(1), 2)), ((-1.5, 1.5), (-math.pi, math.pi))
    ahead, round_about = (after(looked(10, camera("camera", 10, one), sequence=heard)).state for one in ends)
    assert round_about.searched[0].sector_rad == (-math.pi, math.pi)
    assert numbers(round_about) == pytest.approx(numbers(ahead), abs=1e-12)
    assert Sector.between(0.0, math.tau) == Sector.between(-math.pi, math.pi) == Sector(0.0, math.pi)


@pytest.mark.parametrize("context, ends", [(Context(view_half_angle_rad=0.0), None), (Context(), (0.3, 0.3))])
def test_a_look_at_an_empty_sector_changes_nothing(context, ends) -> None:
    state = WorldFilter(context).update(hop(10, look=Look("camera", 10**9, ABSENT, ends))).state
    assert len(state.searched) == 1 and not state.entities


@pytest.mark.parametrize("sequence", [False, True])
# In the two last ones an entity behind a corner loses its cover: it keeps its side.
@pytest.mark.parametrize("seed", [*range(4), 21, 540169])
def test_a_mirrored_world_has_the_mirrored_state(sequence, seed) -> None:
    rng = np.random.default_rng(seed)
    told = [anything(rng, number + 1, sequence) for number in range(30)]
    worlds = run(WorldFilter(CORNERS), told), run(WorldFilter(CORNERS), map(mirrored, told))
    for here, there in zip(*worlds, strict=True):
        assert numbers(there.state, -1) == pytest.approx(numbers(here.state), abs=2e-5)


def anything(rng, number, sequence):
    """Return a random measurement of two cameras, a radar, a radio or odometry."""
    kind = rng.random()
    if kind < 0.1:
        twist = float(rng.uniform(0.0, 2.0)), float(rng.normal(0.0, 0.3))
        return Odometry("wheels", number * 10**8, *twist)
    if kind < 0.4:
        return ordinary_scan(rng, number, kind < 0.25)
    azimuths_rad = rng.uniform(0.3, 1.5, rng.integers(3)).tolist()
    boxes = [car(at, moving=bool(rng.random() < 0.8)) for at in azimuths_rad]
    bearing, approach = Bearing(rng.uniform(-1.5, 1.5), 0.1), Approach(rng.normal(0.0, 0.5), 0.2)
    one = replace(ordinary(rng, number, sequence), bearing=bearing, approach=approach)
    return replace(one, further=(camera("left", number, LEFT, *boxes),))


def mirrored(one):
    """Return the mirrored measurement."""
    if isinstance(one, Odometry):
        return replace(one, yaw_rate_rad_s=-one.yaw_rate_rad_s)
    if isinstance(one, PositionScan):
        places = tuple(replace(place, position_m=(place.position_m[0], -place.position_m[1]),
                               covariance=((1.0, -0.2), (-0.2, 0.5))) for place in one.positions)  # fmt: skip
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
        further=tuple(CameraLook(turned(seen.look), flipped(seen.sightings)) for seen in one.further),
        sequence=one.sequence and replace(one.sequence, groups=one.sequence.groups[::-1]),
    )
