"""Diffraction at a corner and reflections of street walls against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated_sound import QUIET, C, at, carried, source_in, street_of, tone

from worldstate.simulation.scene.driving import entry_y_m
from worldstate.simulation.scene.junction import SITES, Site, drawn_site, site
from worldstate.simulation.scene.octave_bands import OCTAVES_HZ
from worldstate.simulation.scene.vehicle import SOURCE_HEIGHT_M
from worldstate.simulation.sound.diffraction import EXTERIOR_RAD, edge_gain
from worldstate.simulation.sound.paths import through_mouth, trace_paths


@given(letter=st.sampled_from(["SA", "SB", "TA", "TB", "MA", "MB"]), number=st.integers(101, 999_999))
def test_vehicles_of_drawn_arms_appear_at_the_corner(letter: str, number: int) -> None:
    """Entry at the edge of the image would give line of sight seconds before T0."""
    place = drawn_site(f"{letter}{number}")
    for approach, lane, corner in zip(
        ("left", "right"), place.lanes_m, (place.corner_left_m, place.corner_right_m), strict=True
    ):
        heard_from = lane / place.corner_ahead_m * corner  # by the array at the origin
        assert 0.0 <= heard_from - abs(entry_y_m(place, lane, approach)) < 1.5


def rigid_wedge_db(r, angle, r0, angle0):
    """Diffracted pressure of a rigid 270-degree wedge in shadow, dB against the free field r + r0 away.

    The impulse response of M. A. Biot and I. Tolstoy, "Formulation of wave propagation in infinite media by
    normal coordinates", JASA 29 (1957), as H. Medwin put it for a point source, transformed by quadrature.
    """
    eta = np.linspace(0.0, 1.0, 100_001)[1:] ** 2 * 14.0
    nu = np.pi / EXTERIOR_RAD
    time = np.sqrt(2.0 * r * r0 * np.cosh(eta) + r * r + r0 * r0) / C
    turns = [nu * (np.pi + a * angle + b * angle0) for a in (1, -1) for b in (1, -1)]
    beta = sum(np.sin(turn) / (np.cosh(nu * eta) - np.cos(turn)) for turn in turns)
    kernel = -nu / (2.0 * np.pi) * beta / (C * time)
    phases = np.exp(-2j * np.pi * OCTAVES_HZ[:, None] * time)
    return 20.0 * np.log10(np.abs(np.trapezoid(kernel * phases, eta)) * (r + r0))


@pytest.mark.parametrize("shadow_deg", [1.0, 5.0, 20.0, 45.0, 75.0])
@pytest.mark.parametrize(("r", "r0"), [(5.3, 5.4), (8.4, 14.0)])
def test_a_corner_and_its_wall_equal_a_rigid_wedge(r, r0, shadow_deg):
    """The diffracted wave and its mirror image in the wall have equal lengths and add up."""
    angle0 = np.radians(12.0)
    angle = np.pi + angle0 + np.radians(shadow_deg)
    turns = np.array([angle - angle0, 2.0 * EXTERIOR_RAD - angle - angle0])
    gain = edge_gain(turns, np.full(2, r * r0 / (r + r0)), np.zeros(2), OCTAVES_HZ).sum(axis=0)
    np.testing.assert_allclose(20 * np.log10(gain), rigid_wedge_db(r, angle, r0, angle0), atol=1.0)


@pytest.mark.parametrize("y", [4.6, 6.0, 20.0])
def test_a_rendered_corner_equals_a_rigid_wedge(y):
    """One rigid wall up to the corner and a static source up to 60 degrees behind it."""
    site = Site(
        "Wedge", 2.8, 30.0, 4.45, None, 2.8, 30.0, 6.0, 0.98, side_order=1, right_openings_m=((-99.0, 99.0),)
    )
    tones, rate = OCTAVES_HZ.astype(int) + 1, 48_000.0  # whole periods in a second
    levels = replace(QUIET, screen_cap_db=60.0)
    street = street_of(site, [[0.0, 0.0, SOURCE_HEIGHT_M]], 1.2, rate, levels=levels)
    heard = carried(
        street, source_in(street, lambda time: np.sum([tone(f)(time) for f in tones], axis=0), at(6.0, y))
    )
    r0, r = np.hypot(6.0 - 4.45, y - 2.8), np.hypot(4.45, 2.8)
    wanted = rigid_wedge_db(r, EXTERIOR_RAD - np.arctan2(2.8, 4.45), r0, np.arctan2(6.0 - 4.45, y - 2.8))
    spectrum = np.abs(np.fft.rfft(heard[0, 4800 : 4800 + int(rate)])) * 2 / rate
    np.testing.assert_allclose(20 * np.log10(spectrum[tones] * (r + r0)), wanted, atol=1.5)


@given(st.floats(50.0, 4000.0), st.floats(0.5, 20.0))
def test_the_corner_is_continuous_through_the_shadow_boundary(frequency, reduced):
    turn = np.radians(np.linspace(90.0, 260.0, 4001))
    # Equal legs: the detour of a line that passes inside.
    detour = 4.0 * reduced * (1.0 - np.sin(np.minimum(turn, np.pi) / 2.0))
    gain = edge_gain(turn, np.full(turn.shape, reduced), detour, np.array([frequency]))[:, 0]
    assert np.abs(np.diff(gain)).max() < 0.06
    assert np.all(np.diff(gain[turn > np.pi]) < 0.0)  # deeper is quieter
    assert abs(gain[0] - 1.0) < 0.25
    assert gain[np.argmin(np.abs(turn - np.pi))] == pytest.approx(0.5, abs=0.1)


@given(st.floats(3.0, 40.0), st.floats(0.5, 15.0), st.floats(-40.0, 40.0))
def test_paths_are_straight_in_view_and_bent_when_hidden(corner, beyond, y):
    site = Site("SB1", min(corner, 30.0), 2.5, 4.0, None, 3.0, 3.0, 6.0)
    passage = through_mouth(site, (4.0 + beyond, np.array([y])), (0.0, 0.0), 1.0)
    lit = passage.clearance_m[0] > 0.0
    assert (passage.turn_rad[0] < np.pi) == lit
    assert passage.bent_m[0] >= passage.straight_m[0] - 1e-9


@given(st.floats(-3.0, 3.0), st.floats(0.2, 3.0), st.floats(4.5, 30.0))
def test_an_opening_removes_the_reflections_on_it(begin, length, y):
    """A source at (7, y) and a wall at -2.8 m: the reflection point by similar triangles."""
    opening = (begin, begin + length)
    plan = Site("SB1", 12.0, 12.0, 4.0, None, 12.0, 2.8, 6.0, side_order=1)
    whole, holed = (
        trace_paths(one, 7.0, np.array([y]), 1.4, 60.0)
        for one in (plan, replace(plan, right_openings_m=(opening,)))
    )
    aim = min(4.0 / 7.0 * (y + 5.6) - 5.6, 12.0)  # at the mouth
    met = 4.0 * 2.8 / (aim + 5.6)
    share = [float((b.gain / np.maximum(a.gain, 1e-12)).max()) for a, b in zip(whole, holed, strict=True)]
    assert share[0] == share[1] == 1.0
    if opening[0] + 0.5 < met < opening[1] - 0.5:
        assert share[2] == 0.0
    elif not opening[0] - 0.5 < met < opening[1] + 0.5:
        assert share[2] == 1.0


@given(st.floats(1.5, 3.5), st.floats(4.0, 7.0), st.floats(2.0, 8.0), st.floats(0.1, 40.0))
def test_images_of_a_hidden_vehicle_follow_one_another(aside, ahead, lane, y):
    """Between walls at distance w the image of order n has the azimuth atan((2 n w + y) / (D + l)).

    It is visible from atan((2 n - 1) w / D) to atan((2 n + 1) w / D). With hard walls a vehicle from the left
    changes from wide angles on the left (n = 2) to middle ones on the right (n = 1).
    """
    site = Site("SB1", aside, aside, ahead, None, aside, aside, 6.0)
    paths = trace_paths(site, ahead + lane, np.array([y]), 0.0, 60.0)
    for order in range(4):
        path = min(paths, key=lambda one: abs(one.receiver.offset_m + 2.0 * order * aside))
        assert path.receiver.order == order
        tangent = (2.0 * order * aside + y) / (ahead + lane)
        inside = min(tangent - (2 * order - 1) * aside / ahead, (2 * order + 1) * aside / ahead - tangent)
        if abs(inside) * ahead > 0.25:  # not in the transition
            assert path.lit[0] == float(inside > 0.0), order


@pytest.mark.parametrize("name", SITES)
def test_side_walls_do_not_hide_their_corner(name):
    """A wall in the line of sight to its corner would hide the street."""
    plan = site(name)
    for wall, corner, openings in (
        (plan.side_wall_left_m, plan.corner_left_m, plan.left_openings_m),
        (plan.side_wall_right_m, plan.corner_right_m, plan.right_openings_m),
    ):
        x = np.linspace(0.0, plan.corner_ahead_m, 1001)
        stands = np.all([(x < begin) | (x > end) for begin, end in openings], axis=0)
        assert stands.any()
        assert np.all(corner / plan.corner_ahead_m * x[stands] <= wall + 0.01)
