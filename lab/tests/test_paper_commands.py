"""The commands of the paper's bounds and ablations on small inputs with known answers."""

import json

import numpy as np
import pytest
from test_ablations import corpus
from worldstate_lab.cli.main import main

from worldstate.adapters.datasets.feature_table import FeatureTable, write_features
from worldstate.operations.recordings.hop_table import save_tables


def told(capsys, *argv):
    capsys.readouterr()
    assert main([*map(str, argv), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.fixture
def table(tmp_path):
    """Return classes that differ in the level of one half of the azimuths, with overlap."""
    rng = np.random.default_rng(0)
    labels = np.array(["front", "left", "none", "right"] * 30)
    features = rng.lognormal(-2.0, 0.3, (120, 60))
    for label, columns in (("left", slice(0, 15)), ("right", slice(15, 30)), ("front", slice(10, 20))):
        features[labels == label, columns] *= 1.5
    names = np.array([str(i) for i in range(120)])
    sites = np.tile(["SA1", "SB1"], 60)
    write_features(tmp_path / "t.csv", FeatureTable(features, labels, names, sites, names, (None,) * 120))
    return tmp_path / "t.csv"


def test_no_classifier_beats_the_bound_and_the_array_has_no_bearing_at_endfire(table, capsys):
    found = told(capsys, "reach", "--features", table, "--method", "baseline")
    data, array = found["features"], found["array"]
    assert data["fano"] <= data["sharp_fano"] <= data["error"]
    assert 0.0 < data["information_lower"] <= data["information_high"] <= data["entropy_bits"]
    assert array["std_rad"][0] is None
    assert array["with_vision_rad"][0] == pytest.approx(np.radians(1.0))
    assert min(x for x in array["std_rad"] if x is not None) == array["std_rad"][6]
    assert main(["reach", "--features", str(table), "--method", "baseline"]) == 0
    assert f"{data['sharp_fano']:.4g}" in capsys.readouterr().out


def test_ablations_of_streams_are_those_of_the_library(tmp_path, capsys):
    save_tables(tmp_path / "s.npz", corpus(count=24))
    rows = told(capsys, "ablations", tmp_path / "s.npz")["rows"]
    assert rows["raw_risk"]["auroc"] == rows["full"]["auroc"]
    assert rows["raw_risk"]["ece"] > rows["full"]["ece"]
    assert main(["ablations", str(tmp_path / "s.npz")]) == 0
    assert "with_looming" in capsys.readouterr().out
