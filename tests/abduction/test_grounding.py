"""The grounded likelihood in the running chain: switched, off by default, each tie seen at work."""

import math
from dataclasses import replace

import numpy as np
import pytest

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.abduction.grounding.grounded_likelihood import (
    LINE_SPACING,
    GroundedObservation,
    GroundedSettings,
    Observable,
    car,
)
from worldstate.adapters.acoustic import AcousticAdapter, Grounding, observe
from worldstate.adapters.listener import measure_steps, run
from worldstate.adapters.source import ListenSettings, open_source
from worldstate.frontend.approach.looming import Looming
from worldstate.frontend.approach.tone import ToneReading
from worldstate.frontend.array.microphone_array import roof_array_56
from worldstate.ground.values import NotUsable

SCORES = SignatureEvidence(("left", "right"), (0.7, -0.4), 0.1, -0.2)
SILENT = NotUsable("nothing heard")


class Flat:
    def evidence(self, feature):
        return SCORES


@pytest.fixture(scope="module")
def frame(approach):
    """One frame with a bearing, a looming rate and an engine line, whatever the recording has there."""
    frame, _ = next(iter(measure_steps(open_source(approach.folder))))
    looming = Looming(inverse_tta_hz=0.4, std_hz=0.05, log_slope_hz=0.8)
    tone = ToneReading(57.0, 0.3, 0.5)
    return replace(frame, bearing_rad=0.2, bearing_std_rad=0.05, prominence=2.0, looming=looming, tone=tone)


def interpreted(frame, grounding=None):
    return AcousticAdapter(roof_array_56(), 48_000.0, Flat(), grounding=grounding).interpret(frame)


@pytest.mark.long
def test_off_by_default(frame, approach):
    assert interpreted(frame).signature is SCORES
    assert open_source(approach.folder).settings.grounding is None


def test_nothing_measured_leaves_the_scores(frame):
    blank = replace(frame, bearing_rad=math.nan, looming=SILENT, tone=SILENT)
    heard = interpreted(blank, Grounding()).signature
    np.testing.assert_allclose(heard.log_likelihoods, SCORES.log_likelihoods, atol=1e-9)


def test_each_measurement_carries_its_own_spread(frame):
    measurement = interpreted(frame)
    seen = observe(frame, measurement.bearing, measurement.approach)
    assert (seen.bearing_rad.value, seen.bearing_rad.std) == pytest.approx((0.2, 0.05))
    assert (seen.inverse_tta_hz.value, seen.inverse_tta_hz.std) == (0.4, 0.05)
    assert (seen.signature[LINE_SPACING].value, seen.signature[LINE_SPACING].std) == (57.0, 0.3)
    none = observe(replace(frame, tone=SILENT), SILENT, SILENT)
    assert not none.signature
    assert none.bearing_rad is SILENT
    assert none.inverse_tta_hz is SILENT


def test_a_source_that_recedes_is_less_of_a_vehicle_coming(frame):
    quiet = replace(frame, tone=SILENT, bearing_rad=math.nan)
    closing, receding = (
        interpreted(
            replace(quiet, looming=replace(quiet.looming, inverse_tta_hz=rate)), Grounding()
        ).signature
        for rate in (0.4, -0.4)
    )
    assert closing.hidden[0] - closing.none > receding.hidden[0] - receding.none


def test_a_bearing_far_to_the_side_speaks_against_plain_view(frame):
    lone = replace(frame, tone=SILENT, looming=SILENT)
    ahead, aside = (
        interpreted(replace(lone, bearing_rad=azimuth), Grounding()).signature for azimuth in (0.0, 1.2)
    )
    assert ahead.visible - ahead.hidden[0] > aside.visible - aside.hidden[0]


def test_a_coupling_is_switched_off_by_its_name(frame):
    lone = replace(frame, bearing_rad=math.nan, looming=SILENT)
    without = Grounding((car(),), GroundedSettings(without=frozenset({LINE_SPACING})))
    heard, deaf = (interpreted(lone, grounding).signature for grounding in (Grounding((car(),)), without))
    assert heard.hidden[0] != SCORES.hidden[0]
    np.testing.assert_allclose(deaf.log_likelihoods, SCORES.log_likelihoods, atol=1e-9)


def test_the_engine_line_tells_the_speed():
    slow, fast = (
        Grounding((car(),)).answer(SCORES, GroundedObservation(signature={LINE_SPACING: Observable(hz, 0.5)}))
        for hz in (28.0, 110.0)
    )
    assert slow.best.radial_speed_m_s < fast.best.radial_speed_m_s


@pytest.mark.long
def test_the_whole_chain_runs_grounded(approach):
    source = open_source(approach.folder, settings=ListenSettings(grounding=Grounding()))
    grounded = [m.signature for _, m in measure_steps(source)]
    plain = [m.signature for _, m in measure_steps(replace(source, settings=ListenSettings()))]
    assert grounded != plain
    assert np.isfinite([s.log_likelihoods for s in grounded]).all()
    assert [s.none for s in grounded] == [s.none for s in plain]


@pytest.mark.long
def test_grounding_changes_the_likelihood_ratios_of_a_run(approach):
    asked = ListenSettings(), ListenSettings(grounding=Grounding())
    plain, grounded = (run(approach.folder, settings=one) for one in asked)
    assert [one.cues[0].log_lambda for one in plain] != [one.cues[0].log_lambda for one in grounded]
