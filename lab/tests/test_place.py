"""Position behind the corner: paths against brute force, laws of likelihood and filter, end to end."""

import runpy
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from worldstate_lab.places.place_filter import PlaceBelief, PlaceFilter, added_position
from worldstate_lab.places.spectrum_model import SpectrumModel, StreetWalls, sound_paths

from worldstate.frontend import MicrophoneArray

AZIMUTHS = np.radians(np.linspace(90.0, -90.0, 61))
HZ = np.arange(200.0, 2000.0, 300.0)
ROWS = [[x, y, 0.0] for x in (-0.2, 0.0, 0.2) for y in (-0.3, -0.1, 0.1, 0.3)]


ARRAY = MicrophoneArray(np.array(ROWS))
MODEL = SpectrumModel.of(StreetWalls(4.45, 2.8, 2.8, 7.15, 9.9), ARRAY, AZIMUTHS, HZ, draws=8)
PLACES = PlaceFilter(MODEL)


def plane_waves(*azimuths_deg: float) -> np.ndarray:
    beams = ARRAY.steering(HZ, AZIMUTHS).conj().transpose(0, 2, 1)
    return (np.abs(beams @ ARRAY.steering(HZ, np.radians(azimuths_deg))) ** 2).sum(axis=(0, 2))


@pytest.mark.parametrize(
    ("number", "along_m", "wall"),
    [(1, -1.5, ("side", 2.8)), (2, 5.0, ("side", -2.8)), (17, 1.5, ("facing", 9.9))],
)
def test_a_reflection_is_the_shortest_way_by_its_wall(
    number: int, along_m: float, wall: tuple[str, float]
) -> None:
    # Fermat: sound is reflected at the point of the wall with the shortest path.
    path = sound_paths(MODEL.walls, 7.15, np.array([along_m]), HZ)[number]

    def length(at: np.ndarray) -> float:
        met = (at[0], wall[1]) if wall[0] == "side" else (wall[1], at[0])
        return float(np.hypot(7.15 - met[0], along_m - met[1]) + np.hypot(*met))

    shortest = minimize(length, [1.0], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12})
    met = (shortest.x[0], wall[1]) if wall[0] == "side" else (wall[1], shortest.x[0])
    assert path.length_m[0] == pytest.approx(shortest.fun, abs=1e-8)
    assert path.azimuth_rad[0] == pytest.approx(np.arctan2(met[1], met[0]), abs=1e-4)


def test_sound_of_a_hidden_vehicle_arrives_from_the_near_corner() -> None:
    direct = sound_paths(MODEL.walls, 7.15, np.array([-20.0, -4.6, 4.6, 20.0]), HZ)[0]
    corner = np.arctan2(2.8, 4.45)
    assert direct.azimuth_rad == pytest.approx([-corner, -corner, corner, corner])
    # Maekawa: 5 dB at the edge of the shadow, more for larger detours and higher frequencies.
    assert -10 * np.log10(direct.passed[1]) == pytest.approx(np.full(len(HZ), 4.9), abs=0.4)
    assert (direct.passed[0] < direct.passed[1]).all() and (np.diff(direct.passed[0]) < 0).all()


@given(st.floats(1e-6, 1e6), st.floats(-1e3, 1e3), st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_scale_and_offset_of_a_spectrum_have_no_effect(scale: float, offset: float, seed: int) -> None:
    spectrum = np.random.default_rng(seed).normal(size=len(AZIMUTHS))
    like, nobody = MODEL.log_likelihood(spectrum)
    again, _ = MODEL.log_likelihood(scale * (spectrum + offset))
    assert again == pytest.approx(like, abs=1e-5)
    assert np.isfinite(like).all() and nobody > 0.0


def test_a_vehicle_in_view_is_where_its_bearing_meets_the_lane() -> None:
    for azimuth_deg in (-25.0, -10.0, 15.0):
        like, nobody = MODEL.log_likelihood(plane_waves(azimuth_deg))
        along_m = 7.15 * np.tan(np.radians(azimuth_deg))
        assert MODEL.along_m[like.argmax()] == pytest.approx(along_m, abs=1.5)
        assert like.max() > nobody


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 2.0))
@settings(max_examples=20, deadline=None)
def test_probabilities_sum_to_one(seed: int, dt_s: float) -> None:
    rng, belief = np.random.default_rng(seed), PLACES.unknown
    for _ in range(3):
        belief = PLACES.update(PLACES.predict(belief, round(dt_s, 1)), rng.normal(size=len(AZIMUTHS)))
        assert np.exp(belief.log_present).sum() + np.exp(belief.log_empty) == pytest.approx(1.0, abs=1e-9)


def test_a_prediction_moves_the_mean_by_its_speed() -> None:
    # One vehicle at -5 m with 4 m/s to the left; its speed may change, with equal probability up and down.
    sharp = np.full_like(PLACES.unknown.log_present, -700.0)
    speed = 15 + 6
    sharp[speed, np.abs(MODEL.along_m + 5.0).argmin()] = 0.0
    for steps in (1, 10):
        belief = PlaceBelief(sharp, -700.0)
        for _ in range(steps):
            belief = PLACES.predict(belief, 1.0 / steps)
        assert PLACES.estimate(belief).mean_m == pytest.approx(-1.0, abs=0.05)


def test_the_added_position_completes_the_prior_belief() -> None:
    belief = carried = PLACES.unknown
    for _ in range(10):
        belief = PLACES.update(PLACES.predict(belief, 0.1), plane_waves(-62.0, 32.0))
        carried = PLACES.predict(carried, 0.1)
    now, before = PLACES.estimate(belief), PLACES.estimate(carried)
    assert now.stated and not before.stated
    first = added_position(now, before, MODEL.walls.crossing_m)
    assert first is not None
    assert first.position_m[1] > MODEL.walls.sight_m[1]
    # Both together give the belief again.
    weights = 1.0 / first.covariance[1][1], before.std_m**-2
    whole = (weights[0] * first.position_m[1] + weights[1] * before.mean_m) / sum(weights)
    assert (whole, sum(weights)) == pytest.approx((now.mean_m, now.std_m**-2))
    assert added_position(before, before, MODEL.walls.crossing_m) is None


def test_the_example_gives_an_entity_its_position() -> None:
    example = runpy.run_path(str(Path(__file__).resolve().parents[2] / "docs" / "examples" / "place.py"))
    (car,) = example["behind_the_corner"](25).entities
    assert car.status == "hidden" and car.direction == "left"
    assert car.position_m[1] == pytest.approx(7.0, abs=2.0)
