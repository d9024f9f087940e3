"""The second renderer against image sources and the diffraction of a wedge."""

import numpy as np
import pytest

from worldstate.simulation.scene.junction import drawn_site
from worldstate.simulation.sound.rays import (
    Houses,
    _at,
    azimuths_rad,
    corner_gain,
    reached,
    trace,
)

ROOM_M, HEIGHT_M, EAR_M = (30.0, 20.0), 6.0, 1.6
KEPT = 0.7


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
    found = trace(walled_yard(), EAR_M, np.random.default_rng(1), rays=400_000)
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


def test_diffraction_is_6_db_at_the_edge_of_the_shadow() -> None:
    """At high octaves 6 dB at the boundary, more deeper in the shadow and at higher frequencies."""
    ahead, beside = 5.0, 3.0
    x = np.full(3, 9.0)
    y = beside * 9.0 / ahead + np.array([0.0, 3.0, 12.0])
    gain = corner_gain((ahead, beside), x, y) * np.hypot(x, y)[:, None]
    np.testing.assert_allclose(20.0 * np.log10(gain[0, 5:]), -6.02, atol=0.7)
    assert (np.diff(gain, axis=0) < 0.0).all() and (np.diff(gain[1:], axis=1) < 0.0).all()
    np.testing.assert_allclose(corner_gain((ahead, -beside), x, -y), corner_gain((ahead, beside), x, y))


def test_rough_walls_scatter_without_loss() -> None:
    """Scattering spreads energy over directions and keeps its sum."""
    smooth, rough = (trace(walled_yard(s), EAR_M, np.random.default_rng(2)) for s in (0.0, 1.0))
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
