"""The renderers of rays and of mirrors against image sources, a wedge and laws of reflection."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated_sound import street_of

from worldstate.simulation.scene.junction import drawn_site
from worldstate.simulation.scene.presets import preset
from worldstate.simulation.sound import mirrors, rays
from worldstate.simulation.sound.delay import Emission
from worldstate.simulation.sound.mirrors import FADE_M, Fronts, add_mirrored, drawn_fronts, trace_images
from worldstate.simulation.sound.rays import Houses, _at, azimuths_rad, reached
from worldstate.simulation.sound.static_field import PlacedSource

FS = 6000.0
EAR = np.zeros(2)
# A junction of streets with closed ends: own street along x, crossing street along y.
JUNCTION = np.array([(-9, -3), (5, -3), (5, -24), (12, -24), (12, 26), (5, 26), (5, 3), (-9, 3)], float)
YARD = np.array([(-6, -4), (14, -4), (14, 7), (-6, 7)], float)

plans = st.builds("{}{}".format, st.sampled_from(["MA", "MB"]), st.integers(1, 999)).map(drawn_site)
shares = st.floats(0.05, 0.95)


@contextmanager
def built(fronts: Fronts) -> Iterator[None]:
    """Build every street of these fronts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mirrors, "drawn_fronts", lambda _: fronts)
        mirrors.images_at.cache_clear()
        yield
    mirrors.images_at.cache_clear()


def closed(corners: np.ndarray, kept: np.ndarray) -> Fronts:
    return Fronts(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1), np.tile(kept[:, None], 8))


def reaching(images: mirrors.Images, point: np.ndarray, place: np.ndarray) -> list[tuple[float, ...]]:
    """Return length and gain of every path from a place to a point, the shortest first."""
    found = images.reached_from(place)
    return sorted((float(np.hypot(*(place - images.of(i, point)))), float(images.kept[i, 3])) for i in found)


@pytest.mark.parametrize(
    ("corners", "absorbing", "place"),
    [(YARD, [3], (7.3, 4.7)), (JUNCTION, [2, 4, 7], (9.0, 1.0)), (JUNCTION, [2, 4, 7], (8.0, 15.0))],
)
def test_image_sources_equal_those_of_pyroomacoustics(corners, absorbing, place) -> None:
    """All images up to order 3 with their gains; corners hide some, absorbing ends remove some."""
    pra = pytest.importorskip("pyroomacoustics")
    kept = 0.9 + 0.01 * np.arange(len(corners))
    kept[absorbing] = 0.0
    materials = [pra.Material(1.0 - one**2) for one in kept]
    room = pra.Room.from_corners(corners.T, fs=16000, max_order=3, materials=materials)
    room.add_source(list(place))
    room.add_microphone(list(EAR))
    room.image_source_model()
    seen = room.visibility[0][0] > 0
    away, damping = room.sources[0].images[:, seen].T - EAR, room.sources[0].damping[0, seen]
    expected = sorted(zip(np.hypot(*away.T).tolist(), damping.tolist(), strict=True))
    found = reaching(trace_images(closed(corners, kept), EAR, 3), EAR, np.array(place))
    audible = [[way for way in ways if way[1] > 0.0] for ways in (found, expected)]
    assert len(audible[1]) > 2
    np.testing.assert_allclose(audible[0], audible[1], rtol=1e-5)


@given(plans, shares, st.floats(-40.0, 40.0), shares, shares)
@settings(max_examples=25, deadline=None)
def test_paths_are_reciprocal(plan, ahead, y, own_x, own_y) -> None:
    """A source and a microphone may be exchanged."""
    far = plan.far_kerb_m
    place = np.array([plan.corner_ahead_m + ahead * (far - plan.corner_ahead_m), y])
    left, right = plan.side_wall_left_m, plan.side_wall_right_m
    ear = np.array([plan.corner_ahead_m - 8.0 * own_x, own_y * (left + right) - right])
    fronts = drawn_fronts(plan)
    there, back = (reaching(trace_images(fronts, a, 5), a, b) for a, b in ((ear, place), (place, ear)))
    np.testing.assert_allclose(there, back, rtol=1e-6)
    loudest, straight = float(fronts.kept.max()), float(np.hypot(*(place - ear)))
    orders = [np.log(gain) / np.log(loudest) for _, gain in there]
    assert all(length >= straight - 1e-9 for length, _ in there)
    assert all(order < 0.01 or order > 0.99 for order in orders)


@given(plans, st.floats(8.0, 60.0))
@settings(max_examples=20, deadline=None)
def test_the_direct_path_has_weight_one_only_in_view(plan, y) -> None:
    """The tolerance excludes the transition at the edge of the shadow."""
    images, lane = trace_images(drawn_fronts(plan), EAR), plan.lanes_m[0]
    (right, left), direct = plan.sight_m(lane), images.order == 0
    inside, behind = (
        np.array([0.0, left - 2.0 * FADE_M]),
        np.array([left + 2.0 * FADE_M, left + y, right - y]),
    )
    for y_m, weight in ((inside, 1.0), (behind, 0.0)):
        place = np.stack([np.full(len(y_m), lane), y_m, np.ones(len(y_m))])
        np.testing.assert_allclose(images.weights(place)[direct], weight)


def impulses(plan, place: tuple[float, float], positions: np.ndarray) -> np.ndarray:
    """Return the sound of a click in the middle of half a second at the microphones."""
    street = street_of(plan, positions, 0.5, FS, levels=preset())
    click = np.zeros(street.receiver.samples, np.float32)
    click[len(click) // 2] = 1.0
    knots = street.receiver.knots_s
    x, y = (np.full(len(knots), one) for one in place)
    add_mirrored(street, street.source(click, knots, (x, y)), np.random.default_rng(1))
    return street.static.out


RING = np.array([[0.2, 0.1, 1.7], [-0.2, 0.15, 1.6], [0.05, -0.2, 1.9], [-0.05, -0.05, 1.6]])


@given(plans, st.floats(-35.0, 35.0))
@settings(max_examples=8, deadline=None)
def test_a_mirrored_plan_sounds_mirrored(plan, y) -> None:
    """Mirroring the street, the source and the microphones leaves the sound unchanged."""
    fronts, turned = drawn_fronts(plan), np.array([1.0, -1.0])
    left, right = plan.corner_left_m, plan.corner_right_m
    other = replace(
        plan, corner_left_m=right, corner_right_m=left, side_wall_left_m=right, side_wall_right_m=left
    )
    lane, sounds, opened = plan.lanes_m[0], [], []
    for street, ends, sign in ((plan, fronts.ends_m, 1.0), (other, fronts.ends_m * turned, -1.0)):
        with built(Fronts(ends, fronts.kept)):
            sounds.append(impulses(street, (lane, sign * y), RING * np.array([1.0, sign, 1.0])))
            opened.append(mirrors.images_at(street, 0.0, 0.0).opened(mirrors.DIRECTIONS))
    np.testing.assert_allclose(sounds[0], sounds[1], atol=1e-4 * np.abs(sounds[0]).max())
    np.testing.assert_allclose(opened[0], opened[1][::-1], rtol=1e-6)


def test_the_opposite_wall_reflects_a_hidden_vehicle() -> None:
    """Images in that wall are nearly all undiffracted paths and raise the level of a hidden click."""
    louder = []
    for number in range(1, 13):
        plan = drawn_site(f"MA{number}")
        place = np.array([plan.lanes_m[0], plan.sight_m(plan.lanes_m[0])[1] + 6.0])
        fronts, heard = drawn_fronts(plan), impulses(plan, (place[0], place[1]), RING)
        opposite = np.isclose(fronts.ends_m[:, :, 0], plan.opposite_wall_m).all(axis=1)
        with built(Fronts(fronts.ends_m[~opposite], fronts.kept[~opposite])):
            without = impulses(plan, (place[0], place[1]), RING)
        louder.append(10.0 * np.log10(np.square(heard).sum() / np.square(without).sum()))
    assert min(louder) > 0.0 and np.median(louder) > 3.0, np.round(louder, 1)


def silent_at(x_m: float, y_m: np.ndarray) -> PlacedSource:
    time_s = np.arange(len(y_m)) * 0.02
    return PlacedSource(Emission.of(np.zeros(128, np.float32), 0.0, FS), time_s, 0.0 * y_m + x_m, y_m, 0.3)


@given(plans, st.sampled_from([1.0, -1.0]))
@settings(max_examples=15, deadline=None)
def test_the_level_is_continuous_at_the_edge_of_the_shadow(plan, side) -> None:
    """Direct and diffracted sound are each half of the free field at the edge of the shadow."""
    lane, centre = plan.lanes_m[0], np.array([0.0, 0.0, 1.7])
    edge = abs(plan.sight_m(lane)[0 if side < 0 else 1])
    y = side * (edge + np.arange(40.0, -41.0, -1.0) / 10.0)
    corner = plan.corner_ahead_m, side * (plan.corner_left_m if side > 0 else plan.corner_right_m)
    straight, total = np.hypot(np.hypot(lane, y), 1.4), np.zeros(len(y))
    bent = np.hypot(np.hypot(*corner) + np.hypot(lane - corner[0], y - corner[1]), 1.4)
    for way in mirrors.ways_of(plan, silent_at(lane, y), centre):
        length = way.length_m(centre)
        if np.allclose(length, straight) or np.allclose(length, bent):
            total += way.gain[:, 5] / length
    level_db = 20.0 * np.log10(total * straight)
    assert np.abs(np.diff(level_db)).max() < 3.0  # in 0.1 m; a hard edge would lose all of it
    assert level_db[40] == pytest.approx(-6.0, abs=1.0)
    assert level_db[0] < -9.0 and abs(level_db[-1]) < 1.0


ROOM_M, HEIGHT_M, EAR_M, KEPT = (30.0, 20.0), 6.0, 1.6, 0.7


def walled_yard(scattered: float = 0.0) -> Houses:
    """Return a yard of four walls under the open sky with the array in the middle."""
    x, y = 0.5 * ROOM_M[0], 0.5 * ROOM_M[1]
    corners = np.array([(-x, -y), (x, -y), (x, y), (-x, y)])
    ends = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    return Houses(ends, np.full(4, HEIGHT_M), np.full((4, 8), KEPT), np.full(4, scattered))


@pytest.mark.long
def test_specular_rays_equal_image_sources() -> None:
    """Energy and directions of all echoes against images of pyroomacoustics in the same yard."""
    pra = pytest.importorskip("pyroomacoustics")
    found = rays.trace_rays(walled_yard(), EAR_M, np.random.default_rng(1), rays=400_000)
    places = np.array([(-8.0, -3.0), (5.0, 7.0), (11.0, -6.0)])
    energy = _at(found.energy, *places.T)[:, :, 1]
    wall, sky, road = pra.Material(1.0 - KEPT), pra.Material(1.0), pra.Material(0.0)
    names = ("east", "west", "north", "south")
    for place, directions in zip(places, energy, strict=True):
        materials = dict.fromkeys(names, wall) | {"ceiling": sky, "floor": road}
        room = pra.ShoeBox([*ROOM_M, HEIGHT_M], fs=16000, materials=materials, max_order=30)
        room.add_source([*(place + 0.5 * np.array(ROOM_M)), 0.5])
        room.add_microphone([0.5 * ROOM_M[0], 0.5 * ROOM_M[1], EAR_M])
        room.image_source_model()
        images = room.sources[0].images.T - room.mic_array.R[:, 0]
        # Amplitudes of the walls; half of the energy, because the road is part of the source levels.
        gain = 0.5 * room.sources[0].damping[0] ** 2 / (images**2).sum(axis=1)
        late = np.hypot(*(images[:, :2] - place).T) > 1e-6
        expected = gain[late].sum()
        assert 10.0 * np.log10(directions.sum() / expected) == pytest.approx(0.0, abs=1.0)
        wave = np.exp(1j * np.arctan2(images[late, 1], images[late, 0]))
        seen = (gain[late] * wave).sum() / expected
        traced = (directions * np.exp(1j * azimuths_rad())).sum() / directions.sum()
        assert abs(traced - seen) < 0.1


def test_rough_walls_scatter_without_loss() -> None:
    """Scattering spreads energy over directions and keeps its sum."""
    smooth, rough = (rays.trace_rays(walled_yard(s), EAR_M, np.random.default_rng(2)) for s in (0.0, 1.0))
    place = np.array([10.0]), np.array([6.0])
    shares = [_at(one.energy, *place)[0, :, 3] for one in (smooth, rough)]
    entropy = [-(p / p.sum() * np.log(p / p.sum() + 1e-12)).sum() for p in shares]
    assert entropy[1] > entropy[0]
    assert 10.0 * np.log10(shares[1].sum() / shares[0].sum()) == pytest.approx(0.0, abs=2.5)


@pytest.mark.long
@pytest.mark.parametrize("name", ["TA7", "TB7", "TB8"])
def test_drawn_streets_have_shadows_and_openings(name: str) -> None:
    """Sound of an arm falls with distance and enters by the mouth; open shares sum to one."""
    plan = drawn_site(name)
    here = reached(plan, EAR_M)
    assert here.open.sum() == pytest.approx(1.0)
    y = np.array([12.0, 30.0, 60.0])
    energy = _at(here.energy, np.full(3, plan.lanes_m[0]), y)[:, :, 3]
    assert (np.diff(energy.sum(axis=1)) < 0.0).all()
    ahead = np.abs(azimuths_rad()) < 0.5 * np.pi
    assert energy[-1, ahead].sum() > 0.8 * energy[-1].sum()
