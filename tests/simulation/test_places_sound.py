"""Sound of a source in the open and in the own street against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, assume, given, settings
from hypothesis import strategies as st
from simulated_sound import (
    ONE,
    OPEN,
    C,
    apart_deg,
    at,
    carried,
    error_db,
    noise,
    source_in,
    srp_spectrum,
    street_of,
    tone,
)

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.occluders import OccludingBody
from worldstate.simulation.scene.vehicle import EgoMotion, along
from worldstate.simulation.sound.delay import KNOT_SAMPLES

FS, HEIGHT_M = 12_000.0, 1.7
MERGE = replace(OPEN, occluders=(OccludingBody(((-60.0, 2.6), (7.0, 2.6))),))
# Corners before set-back walls; nothing opposite.
STREET = Site("Street1", 2.8, 2.5, 4.5, None, 3.1, 2.9, 6.0, side_reflection=0.8, side_order=3)
WHEEL = MicrophoneArray([[0.2 * np.cos(a), 0.2 * np.sin(a), 0.0] for a in np.arange(6) * np.pi / 3])


def band_noise(time: np.ndarray) -> np.ndarray:
    """Return white noise up to 2 kHz of unit variance."""
    spectrum = np.fft.rfft(noise(time))
    spectrum[np.fft.rfftfreq(len(time), 1 / FS) > 2000.0] = 0.0
    found = np.fft.irfft(spectrum, len(time))
    return found / found.std()


def tones(time: np.ndarray) -> np.ndarray:
    """Return 100 tones up to 5 kHz with constant level and no common phase."""
    rng = np.random.default_rng(2)
    shifts = rng.random((100, 2)) + np.arange(1, 101)[:, None] * [1, 0]
    return sum(np.cos(2 * np.pi * (50.0 * number * time + phase)) for number, phase in shifts)


def heard(plan: Site, way, seconds: float, positions=ONE, height_m=HEIGHT_M, sound=band_noise) -> np.ndarray:
    """Return the sound of a source on the route `way(t)`; it begins 0.4 s earlier, 130 m away."""
    street = street_of(plan, positions, seconds, FS)
    return carried(street, source_in(street, sound, way, 0.4, height_m))


def arrivals(lengths, gains, samples: int) -> np.ndarray:
    """Return the sum of copies of the noise with the delay and gain of each path, by phases."""
    head, lengths = int(np.ceil(0.4 * FS / KNOT_SAMPLES)) * KNOT_SAMPLES, np.asarray(lengths)
    spectrum, f = np.fft.rfft(band_noise(np.zeros(head + samples))), np.fft.rfftfreq(head + samples, 1 / FS)
    response = (gains / lengths) @ np.exp(-2j * np.pi * f * lengths[:, None] / C)
    return np.fft.irfft(spectrum * response, head + samples)[-samples:]


@settings(max_examples=12, deadline=None)
@given(st.floats(-100.0, 100.0), st.floats(-60.0, 60.0), st.floats(0.05, 5.0))
def test_open_space_has_gain_1_over_r_and_delay_r_over_c(x, y, height):
    distance = np.sqrt(x**2 + y**2 + (HEIGHT_M - height) ** 2)
    assume(distance >= 1.0)
    (found,) = heard(OPEN, at(x, y), 0.15, height_m=height)
    assert error_db(found, arrivals([distance], [1.0], len(found))) < -40.0


def corridor(y: float, left: float, right: float, order: int) -> list[tuple[float, int]]:
    """Return images of a source in two parallel walls by repeated reflection, and their orders."""
    found = [(y, 0)]
    for first in (True, False):
        place, at_left = y, first
        for number in range(1, order + 1):
            place = 2 * left - place if at_left else -2 * right - place
            at_left = not at_left
            found.append((place, number))
    return found


@pytest.mark.parametrize(("x", "y"), [(-12.0, 1.0), (3.0, -2.8), (-6.0, 3.0), (0.5, 2.0), (-25.0, -1.3)])
def test_the_own_street_has_images_in_both_side_walls(x, y):
    (found,) = heard(STREET, at(x, y), 0.15)
    images, orders = np.array(corridor(y, 3.1, 2.9, 3)).T
    assert error_db(found, arrivals(np.hypot(x, images), 0.8**orders, len(found))) < -30.0


@pytest.mark.parametrize("x", [-6.45, -30.0, 2.0])
def test_the_opposite_wall_reflects_the_own_street(x):
    """One more image at twice the distance to the wall; the near facade has no image."""
    plan = Site(
        "Wall1", 2.8, 2.8, 4.45, 9.9, 2.8, 2.8, 5.45, facade_reflection=0.6, side_order=0, facade_order=2
    )
    (found,) = heard(plan, at(x, 0.0), 0.15)
    assert error_db(found, arrivals([abs(x), 2 * 9.9 - x], [1.0, 0.6], len(found))) < -30.0


def test_a_wall_in_the_open_adds_its_image_at_the_right_delay():
    (found,) = heard(MERGE, at(-8.0, -1.5), 0.15)
    lengths = np.hypot(8.0, [1.5, 2 * 2.6 + 1.5])
    assert error_db(found, arrivals(lengths, [1.0, MERGE.side_reflection], len(found))) < -40.0


@pytest.mark.parametrize(("x", "share"), [(-8.0, 0.0), (3.0, 0.0), (45.0, 1.0)])
def test_a_wall_blocks_the_direct_path_up_to_its_end(x, share):
    """Compare the whitened energy at the time of the direct path with all energy."""
    (found,) = heard(MERGE, at(x, 5.6), 0.15)
    straight = arrivals([np.hypot(x, 5.6)], [1.0], len(found))
    assert found @ straight / (straight @ straight) == pytest.approx(share, abs=0.03)


def test_a_driving_ego_passes_a_source_in_its_street():
    """A tone on the changing length of each image, with its Doppler shift."""
    ego, f, y = EgoMotion(8.0, 10.0), 500.0, -1.6
    x = float(ego.x_m(np.array([0.5]))[0])
    street = street_of(STREET, ONE, 1.0, FS, ego)
    (found,) = carried(street, source_in(street, tone(f), at(x, y), 0.4, HEIGHT_M))
    heard_s = np.arange(len(found)) / FS
    expected = np.zeros(len(found))
    for image, order in corridor(y, 3.1, 2.9, 3):
        way = np.hypot(x - ego.x_m(heard_s), image)
        expected += 0.8**order * tone(f)(heard_s - way / C) / way
    assert error_db(found, expected) < -30.0


@pytest.mark.parametrize("azimuth_deg", np.arange(-180.0, 180.0, 45.0))
@pytest.mark.parametrize("plan", [OPEN, STREET], ids=["open", "street"])
def test_the_loudest_direction_is_that_of_the_source(plan, azimuth_deg):
    distance, azimuths_deg = 12.0 if plan.is_open else 2.2, np.arange(-180.0, 180.0, 2.0)
    x, y = distance * np.cos(np.radians(azimuth_deg)), distance * np.sin(np.radians(azimuth_deg))
    sound = heard(plan, at(x, y), 0.2, WHEEL.centred_m + ONE)
    found_deg = azimuths_deg[srp_spectrum(sound, WHEEL, FS, azimuths_deg, (375.0, 1875.0)).argmax()]
    assert apart_deg(found_deg, azimuth_deg) <= (3.0 if plan.is_open else 8.0)


def level_steps_db(plan: Site, points, speed: float, seconds: float) -> np.ndarray:
    """Return changes of level per tenth of a second along a route."""
    way = along(points)
    (found,) = heard(plan, lambda time: way.at(speed * time), seconds, sound=tones)
    tenths = len(found) // int(0.1 * FS)
    power = (found[: tenths * int(0.1 * FS)].reshape(tenths, -1) ** 2).mean(axis=1)
    return np.diff(10 * np.log10(power))


DRAWN_ONLY = (Phase.explicit, Phase.reuse, Phase.generate)  # each takes half a second: not shrunk


@settings(max_examples=4, deadline=None, phases=DRAWN_ONLY)
@given(st.floats(1.2, 1.8), st.floats(3.0, 4.5), st.sampled_from([1.0, -1.0]), st.sampled_from([1.0, -1.0]))
def test_the_level_is_continuous_on_a_route_into_an_arm(beside, beyond, side, arm):
    """At 1.5 m/s steps are small until the steep edge of the corner's shadow."""
    # Draws have 0.8 to 1.1 dB at most and rarely 1.54, which half as long steps remove, in contrast to a
    # click.
    across, lane = side * beside, STREET.corner_ahead_m + beyond
    turn = (lane - 0.4, across + arm * 0.2), (lane, arm * 3.2)
    points = ((-4.0, across), (3.0, across), *turn, (lane, arm * 9.0))
    steps = np.abs(level_steps_db(STREET, points, 1.5, 10.0))
    lit = np.abs(along(points).at(0.15 * (np.arange(len(steps)) + 2.0))[1]) < 3.3
    assert steps[lit].max() < 1.8
    assert steps.max() < 2.5


@settings(max_examples=4, deadline=None, phases=DRAWN_ONLY)
@given(st.floats(3.6, 9.0), st.booleans())
def test_the_level_is_continuous_past_a_wall_in_the_open(off, hidden):
    """The route is behind the wall and past its end, or before it with its image."""
    y = 2.6 + off if hidden else 1.0 - off
    assert np.abs(level_steps_db(MERGE, ((-9.0, y), (18.0, y)), 4.0, 6.0)).max() < 1.5
