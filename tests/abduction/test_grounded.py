"""Eq. (5): its integral against adaptive quadrature, its couplings, and its part in the running chain."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import norm

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.abduction.grounding.grounded_likelihood import (
    BACKGROUNDS,
    Descriptor,
    GroundedObservation,
    GroundedSettings,
    Grounding,
    Observable,
    car,
    engine_line,
    ground,
    motorcycle,
    tyre_noise_shape,
)
from worldstate.adapters.listener import measure_steps
from worldstate.adapters.source import ListenSettings, open_source

SCORES = SignatureEvidence(("left", "right"), (0.7, -0.4), 0.1, -0.2)
NAMES = ("line_spacing_hz", "tyre_shape_db", "doppler_ratio")


def seen(**signature):
    return GroundedObservation(signature={name: Observable(*value) for name, value in signature.items()})


def test_without_measurements_the_evidence_is_unchanged():
    answer = ground(SCORES, GroundedObservation(), [car(), motorcycle()])
    np.testing.assert_allclose(answer.evidence.log_likelihoods, SCORES.log_likelihoods, atol=1e-9)
    assert answer.class_posterior == pytest.approx({"motor_vehicle": 0.9, "motorcycle": 0.1})
    assert answer.best.direction == "left"


@pytest.mark.parametrize("spacing_hz", [40.0, 70.0, 120.0])
def test_the_integral_over_speed_is_that_of_adaptive_quadrature(spacing_hz):
    coupling = engine_line()
    vehicle = Descriptor("car", ("car",), 1.0, 8.0, 3.0, (coupling,))

    def integrand(v):
        density = norm.pdf(spacing_hz, coupling.expected([v])[:, 0], math.hypot(coupling.std, 2.0)).mean()
        return density * norm.pdf(v, 8.0, 3.0)

    mass = norm.cdf(30.0, 8.0, 3.0) - norm.cdf(-5.0, 8.0, 3.0)
    oracle = quad(integrand, -5.0, 30.0, limit=400, points=[0.0, 2.0, 5.0, 10.0])[0] / mass
    background = BACKGROUNDS["line_spacing_hz"]
    relative = math.log(oracle) - norm.logpdf(spacing_hz, background.value, background.std)
    answer = ground(SCORES, seen(line_spacing_hz=(spacing_hz, 2.0)), [vehicle])
    assert answer.evidence.hidden[0] - SCORES.hidden[0] == pytest.approx(relative, abs=0.01)
    assert answer.evidence.visible - SCORES.visible == pytest.approx(relative, abs=0.01)
    assert answer.evidence.none == SCORES.none


def test_an_approach_raises_the_likelihood_and_doppler_replaces_looming():
    closing = GroundedObservation(inverse_tta_hz=Observable(0.4, 0.1))
    leaving = GroundedObservation(inverse_tta_hz=Observable(-0.4, 0.1))
    there, away = (ground(SCORES, one, [car()]) for one in (closing, leaving))
    assert there.evidence.hidden[0] > SCORES.hidden[0] > away.evidence.hidden[0]
    doppler = Observable(6.0, 0.5)
    both = GroundedObservation(radial_speed_m_s=doppler, inverse_tta_hz=Observable(-0.4, 0.1))
    alone = GroundedObservation(radial_speed_m_s=doppler)
    assert ground(SCORES, both, [car()]) == ground(SCORES, alone, [car()])


@pytest.mark.parametrize("name", NAMES)
def test_each_coupling_can_be_switched_off_and_matters_when_on(name):
    observation = seen(line_spacing_hz=(150.0, 1.0), tyre_shape_db=(12.0, 1.0), doppler_ratio=(1.12, 0.002))
    off = ground(SCORES, observation, [car()], GroundedSettings(without=frozenset({name})))
    rest = {key: value for key, value in observation.signature.items() if key != name}
    unmeasured = ground(SCORES, GroundedObservation(signature=rest), [car()])
    on = ground(SCORES, observation, [car()])
    assert off == unmeasured
    assert abs(on.evidence.hidden[0] - off.evidence.hidden[0]) > 0.1


@given(st.floats(-1.4, 1.4), st.floats(0.02, 0.5))
def test_a_bearing_changes_the_visible_likelihood_only(azimuth, std):
    observation = GroundedObservation(bearing_rad=Observable(azimuth, std))
    answer = ground(SCORES, observation, [car()])
    assert answer.evidence.hidden == pytest.approx(SCORES.hidden, abs=1e-9)
    assert abs(answer.best.azimuth_rad - azimuth) < np.radians(1.0)
    ahead = ground(SCORES, GroundedObservation(bearing_rad=Observable(0.0, std)), [car()])
    assert ahead.evidence.visible >= answer.evidence.visible - 1e-9


@given(st.floats(-1.2, 1.2), st.floats(0.05, 0.3))
def test_mirrored_measurements_mirror_the_answer(azimuth, std):
    swapped = SignatureEvidence(("left", "right"), SCORES.hidden[::-1], SCORES.visible, SCORES.none)
    there, back = (
        ground(scores, GroundedObservation(bearing_rad=Observable(sign * azimuth, std)), [car()])
        for scores, sign in ((SCORES, 1.0), (swapped, -1.0))
    )
    assert there.evidence.hidden == pytest.approx(back.evidence.hidden[::-1], abs=1e-9)
    assert {there.best.direction, back.best.direction} == {"left", "right"}


def test_the_likeliest_class_gives_the_labels_for_the_camera():
    slow = Descriptor("bicycle", ("bicycle",), 1.0, 4.0, 1.0)
    fast = Descriptor("car", ("car", "truck"), 1.0, 14.0, 2.0)
    answer = ground(SCORES, GroundedObservation(radial_speed_m_s=Observable(14.0, 1.0)), [slow, fast])
    assert answer.best.labels == ("car", "truck")
    assert answer.class_posterior["car"] > 0.99
    assert sum(answer.class_posterior.values()) == pytest.approx(1.0)


@pytest.mark.parametrize("speed", [3.0, 7.1, 12.9])
def test_a_spread_finer_than_the_grid_still_finds_its_speed(speed):
    answer = ground(SCORES, GroundedObservation(radial_speed_m_s=Observable(speed, 0.0)), [car()])
    assert abs(answer.best.radial_speed_m_s - speed) <= 0.125 + 1e-9
    assert np.isfinite(answer.evidence.log_likelihoods).all()


def test_tyre_noise_is_that_of_the_directive_and_constant_below_its_speeds():
    """Category 1 of Directive 2015/996 at 70 km/h, 125 Hz and 1 kHz: A_R and A_P, power-summed."""
    low, high = (10.0 * math.log10(10.0**a + 10.0**b) for a, b in ((8.57, 8.92), (9.73, 8.42)))
    assert tyre_noise_shape().expected([70.0 / 3.6])[0, 0] == pytest.approx(high - low, abs=0.02)
    slow, slower = tyre_noise_shape().expected([20.0 / 3.6 - 0.5, 1.0])[0]
    assert slow == pytest.approx(slower, abs=0.1)


@pytest.mark.long
def test_the_whole_chain_runs_grounded(approach):
    source = open_source(approach.folder, settings=ListenSettings(grounding=Grounding()))
    grounded = [m.signature for _, m in measure_steps(source)]
    plain = [m.signature for _, m in measure_steps(replace(source, settings=ListenSettings()))]
    assert grounded != plain
    assert np.isfinite([s.log_likelihoods for s in grounded]).all()
    assert [s.none for s in grounded] == [s.none for s in plain]
