"""The grounded likelihood in the running chain is off by default and changes the evidence if it is on."""

from dataclasses import replace

import numpy as np
import pytest

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.abduction.grounding.grounded_likelihood import LINE_SPACING
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
