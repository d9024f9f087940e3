"""Thresholds from other junctions: the command on an artificial folder with two junctions."""

import json

import numpy as np
import pytest
from made_up_corner import write_corner
from test_feature_evaluation import made_up_table, written
from worldstate_lab.cli.main import main


@pytest.fixture(scope="module")
def corner(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corner")
    return write_corner(folder / "corner", np.random.default_rng(0), approaches=4, hazard_free=4)


@pytest.fixture(scope="module")
def given(corner, tmp_path_factory):
    """Return the arguments for the windows and the recordings left out of them."""
    folder = tmp_path_factory.mktemp("windows")
    (folder / "ids.csv").write_text("ID\nnone_1\n0_left\n")
    features = written(folder / "windows.csv", made_up_table(recordings=36, spread=0.3))
    return ["junctions", str(corner), "--features", str(features), "--lists", str(folder / "ids.csv")]


def test_every_junction_is_tested_by_the_others(given, capsys) -> None:
    assert main([*given, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["recordings"] == 8
    fixed, retrained = (found["protocols"][name] for name in ("junctions_fixed", "junctions_retrained"))
    for rows in (fixed, retrained):
        row = rows["ensemble .02"]
        assert set(row["by_junction"]) == set(row["leads"]["1"]["auroc_by_junction"]) == {"SA1", "SB1"}
        assert row["worst"]["warned"][1] == min(one["warned"] for one in row["by_junction"].values())
        assert row["onsets"] == sum(one["onsets"] for one in row["by_junction"].values())
        assert row["interval"][0] <= row["alarms_per_hour"] <= row["interval"][1]
    assert fixed["proposed .02"]["paper"] == {"detection": 0.857, "false_alarms_per_hour": 97.0}
    assert retrained["proposed .02"]["paper"] == {"detection": 0.762, "false_alarms_per_hour": 282.0}
    # A classifier trained without the tested junction gives other results there, the shipped one the same.
    assert fixed["published"]["leads"] != retrained["published"]["leads"]
    assert fixed["shipped scores .02"] == retrained["shipped scores .02"]


def test_one_junction_is_rejected(given, tmp_path, capsys) -> None:
    folder = write_corner(tmp_path / "corner", np.random.default_rng(0), approaches=1, hazard_free=1)
    assert main([given[0], str(folder), *given[2:]]) == 2
    assert "two junctions" in capsys.readouterr().err
