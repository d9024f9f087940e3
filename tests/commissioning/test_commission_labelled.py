"""Labelled windows in commissioning: their array and its record in the model."""

from dataclasses import replace

import numpy as np
import pytest

from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.adapters.files.acoustic_domain import domain_of
from worldstate.commissioning import commission
from worldstate.commissioning.commission import windows_of_array
from worldstate.commissioning.heard_stream import CommissionSettings, quick_settings
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.errors import OutOfDomainError

ARRAY = MicrophoneArray([[0.0, 0.2, 0.0], [0.0, 0.0, 0.0], [0.1, -0.3, 0.0]], "three")
HERE = domain_of(ARRAY, [6000.0], ["SA101"])


def table_of(*sites: str) -> FeatureTable:
    names, labels = np.array(sites), np.array(["left", "none", "front"])
    return FeatureTable(np.ones((3, 60)), labels, names, names, names, (None,) * 3)


def test_tables_of_another_array_raise_an_error() -> None:
    table = table_of("SA1", "SB1", "SB2")
    kept = windows_of_array(table, CommissionSettings(leave_out=("SB1",)), HERE)
    assert kept.environments.tolist() == ["SA1", "SB2"]
    # Without it a commissioned model would have no budget and no times.
    assert kept.domain is HERE
    elsewhere = domain_of(MicrophoneArray(ARRAY.positions_m * [1.0, 1.1, 1.0]), [6000.0], ["SA1"])
    with pytest.raises(OutOfDomainError, match="not the array"):
        windows_of_array(replace(table, domain=elsewhere), CommissionSettings(), HERE)


class LearnedError(Exception):
    pass


def test_real_windows_are_fitted_once_for_all_folds(tmp_path, monkeypatch) -> None:
    table, fitted = table_of("DA1", "DB1", "DB2"), []

    def learn(streams, fit, *rest):
        assert fit(streams[:1]) is fit(streams)
        raise LearnedError

    monkeypatch.setattr(commission, "heard_streams", lambda plan, *rest: plan)
    for name in ("open_field_features", "open_field_windows"):
        monkeypatch.setattr(commission, name, lambda *given: [1, 2])
    monkeypatch.setattr(commission, "window_model", lambda *given: fitted.append(given) or object())
    monkeypatch.setattr(commission, "learn_sequence", learn)
    moving = quick_settings(CommissionSettings(moving_ego=True))
    with pytest.raises(LearnedError):
        commission.commission(ARRAY, moving, tmp_path, table=table)
    ((windows, beside),) = fitted
    assert windows.environments.tolist() == table.environments.tolist()
    assert beside is None
