"""Errors that the tools, bounds, metrics and the smoother raise for bad input: one row per error."""

from collections.abc import Callable

import numpy as np
import pytest
from hop_tables import blank_stream

from worldstate.abduction.cueing.risk_map import brier_score, expected_calibration_error, fit_isotonic
from worldstate.abduction.cueing.thresholds import neyman_pearson_threshold
from worldstate.adapters.files.model_file import read_model
from worldstate.frontend.bounds.cramer_rao import (
    bearing_crb_rad2,
    broadside_rad,
    endfire_information,
    radial_speed_crb_m2_s2,
    tone_crb_hz2,
)
from worldstate.ground.errors import InvalidArgumentError
from worldstate.measurement import Approach, Bearing
from worldstate.operations.calibration.cueing_calibration import calibrate_cueing, correlation_time_hops
from worldstate.operations.recordings.hop_table import hop_stream
from worldstate.operations.viewing.log_page import page_data
from worldstate.smoothing import FixedLagSmoother
from worldstate.smoothing.learned_street import LearnedStreet, forgotten

POLE = [[0, 0, 0], [0, 0, 1.0]]
PRIOR = (0.3, 0.3, 0.2, 0.2)


def _smooth(*updates: dict) -> None:
    smoother = FixedLagSmoother()
    for hop, measured in enumerate(updates):
        smoother.update(hop * 10**8, measured)
    smoother.track("unknown")


REFUSALS: dict[str, tuple[Callable[[], object], str]] = {
    "bearing of one microphone": (lambda: bearing_crb_rad2(POLE[:1], 0.0, 1e3, 1.0, 1), "2 microphones"),
    "bearing bound with a negative SNR": (lambda: bearing_crb_rad2(np.eye(3), 0.0, 1e3, -1.0, 1), "snr"),
    "bearing bound without an azimuth": (lambda: bearing_crb_rad2(np.eye(3), np.nan, 1e3, 1.0, 1), "azimuth"),
    "tone bound without a signal": (lambda: tone_crb_hz2(0.0, 100, 1e3), "snr"),
    "tone bound of one sample": (lambda: tone_crb_hz2(1.0, 1, 1e3), "samples"),
    "speed bound at 0 Hz": (lambda: radial_speed_crb_m2_s2(1.0, 0.0), "frequency"),
    "broadside of a vertical line": (lambda: broadside_rad(POLE), "horizontal extent"),
    "information of a vertical line": (lambda: endfire_information(POLE, 0.0), "horizontal extent"),
    "risk above one": (lambda: expected_calibration_error([0.5, 1.2], [True, False]), "risk"),
    "no risks": (lambda: brier_score([], []), "risk"),
    "risk map without a hazard-free sample": (lambda: fit_isotonic([0.1, 0.2], [True, True]), "hazard"),
    "threshold of no windows": (lambda: neyman_pearson_threshold([], 0.1), "window"),
    "correlation time of no windows": (lambda: correlation_time_hops([]), "window"),
    "stream without hops": (lambda: hop_stream([], name="a"), "hop"),
    "calibration on hazards only": (
        lambda: calibrate_cueing([blank_stream("a", 99).replace(label="left", t0_s=5.0)], PRIOR,
                                 read_model().policies), "without a hazard"),
    "forgetting of a negative time": (lambda: forgotten(LearnedStreet("Elm Street"), -1.0), "-1"),
    "page of no states": (lambda: page_data([]), "at least one snapshot"),
    "smoothing from an approach": (lambda: _smooth({"car": [Approach(0.1, 0.1)]}), "bearing or position"),
    "track of an unknown entity": (lambda: _smooth({"car": [Bearing(0.1, 0.1)]}), "'unknown'"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSALS)
def test_refuses(case: str) -> None:
    call, words = REFUSALS[case]
    with pytest.raises(InvalidArgumentError, match=words):
        call()
