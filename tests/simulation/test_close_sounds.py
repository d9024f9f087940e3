"""Sounds at a few metres: levels of passes and idling engines, full scale."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.commissioning.heard_stream import junction_named
from worldstate.simulation.scene.kinds import KINDS
from worldstate.simulation.scene.vehicle import Trajectory, crank_turns_hz, exhaust_pulses
from worldstate.simulation.stream.close_sounds import close_sound, close_vehicle, idling_vehicle, recorded
from worldstate.simulation.stream.settings import StreamSettings

RATE_HZ, SECONDS = 6000.0, 5.0
STREET = StreamSettings(junction_named("SA1"), 1.0)


def levels_db(sound: np.ndarray) -> np.ndarray:
    half = round(0.5 * RATE_HZ)
    return np.asarray(
        10.0 * np.log10(np.square(sound[: len(sound) // half * half]).reshape(-1, half).mean(axis=1))
    )


@pytest.mark.long
@pytest.mark.parametrize("kind", ["light", "heavy", "tram"])
def test_a_passing_vehicle_swells_and_an_idling_one_does_not(kind: str) -> None:
    drawn = [
        (
            np.ptp(levels_db(close_vehicle(KINDS[kind], STREET.preset, STREET.site, SECONDS, RATE_HZ, one))),
            np.ptp(levels_db(idling_vehicle(KINDS[kind], STREET.preset, STREET.site, SECONDS, RATE_HZ, one))),
        )
        for one in np.random.default_rng(1).spawn(6)
    ]
    passes, idles = np.median(drawn, axis=0)
    # A tram is 30 m long, so it is beside the recorder for two seconds.
    assert passes > idles + (1.0 if kind == "tram" else 4.0)


def test_the_same_draws_make_the_same_sound() -> None:
    first, again = (
        close_vehicle(KINDS["light"], STREET.preset, STREET.site, SECONDS, RATE_HZ, np.random.default_rng(3))
        for _ in range(2)
    )
    np.testing.assert_array_equal(first, again)
    assert first.shape == (SECONDS * RATE_HZ,)


@given(st.integers(0, 10_000), st.floats(3.0, 16.0))
@settings(max_examples=15, deadline=None)
def test_a_motorcycle_fires_at_multiples_of_half_its_turns(seed: int, speed_mps: float) -> None:
    time = np.arange(0.0, 4.0, 1.0 / RATE_HZ)
    knots = np.arange(0.0, 4.1, 0.1)
    still = np.zeros_like(knots)
    path = Trajectory(knots, still, np.full_like(knots, speed_mps), 0.0, 1, KINDS["motorcycle"])
    turns, pulses = (
        draw(path, time, np.random.default_rng(seed)) for draw in (crank_turns_hz, exhaust_pulses)
    )
    assert pulses.std() == pytest.approx(1.0, abs=0.15) and 17.0 < turns.min() <= turns.max() < 300.0
    # As a function of the crank angle a line has constant frequency.
    angle = np.pi * np.cumsum(turns) / RATE_HZ
    at, between = (
        sum(abs((pulses * np.exp(-1j * (order + shift) * angle)).mean()) ** 2 for order in range(1, 9))
        for shift in (0.0, 0.5)
    )
    assert at > 3.0 * between


@given(st.integers(0, 1000), st.sampled_from(["dog", "horns", "sweeps", "shots", "tune"]))
@settings(max_examples=10, deadline=None)
def test_close_sounds_are_finite_and_within_full_scale(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    heard = recorded(close_sound(kind, 3.0, RATE_HZ, rng), RATE_HZ, rng)
    assert np.isfinite(heard).all()
    assert np.abs(heard).max() == pytest.approx(0.5, rel=1e-3)


@pytest.mark.long
def test_kinds_of_vehicles_have_different_spectra() -> None:
    """A tram peaks at 250 Hz, the tyres of a car at 1 kHz, with every recorder."""
    kinds = {name: replace(KINDS[name], ridden_mps=(8.0, 10.0)) for name in ("light", "tram")}
    shares = {}
    for name, kind in kinds.items():
        drawn = [
            np.abs(np.fft.rfft(close_vehicle(kind, STREET.preset, STREET.site, SECONDS, RATE_HZ, one))) ** 2
            for one in np.random.default_rng(5).spawn(8)
        ]
        hz = np.fft.rfftfreq(round(SECONDS * RATE_HZ), 1.0 / RATE_HZ)
        shares[name] = np.median(
            [one[(hz > 180) & (hz < 360)].sum() / one[(hz > 700) & (hz < 1400)].sum() for one in drawn]
        )
    assert shares["tram"] > 10.0 * shares["light"]
