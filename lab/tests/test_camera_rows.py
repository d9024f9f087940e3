"""Ablations on an artificial folder in the layout of the real corners."""

import json

import numpy as np
import pytest
from made_up_corner import write_corner
from worldstate_lab.cli.main import main
from worldstate_lab.sequences.camera_rows import product_row

from worldstate.operations.recordings.hop_table import HopTable


def hops(name, label, t0_s, *, advised, present, seen):
    """Return 20 hops from 1.0 s on with a constant state."""
    time_s = 1.0 + 0.1 * np.arange(20)
    columns = {
        "time_s": time_s,
        "advised": np.repeat([[advised, False]], 20, axis=0),
        "hypotheses": np.repeat([[present, 0.0, 1.0 - present]], 20, axis=0),
        "seen": np.full(20, seen),
        "there": time_s > 2.0,
    }
    return HopTable(columns, name, label, t0_s, {"site": "SA1"})


@pytest.mark.parametrize(("quiet", "present", "aware"), [(0.1, 0.9, 1.0), (0.5, 0.5, 0.0)])
def test_a_presence_above_that_of_quiet_streets_counts_as_awareness(quiet, present, aware):
    streams = [hops(f"f{i}", "none", np.nan, advised=False, present=quiet, seen=False) for i in range(5)]
    streams += [hops(f"a{i}", "left", 2.0, advised=i < 3, present=present, seen=False) for i in range(5)]
    row = product_row(streams, np.random.default_rng(0))
    assert (row["warned"], row["approaches"], row["onsets"]) == (3, 5, 0)
    assert (row["aware"], row["vision_only"], row["hazard_free_aware_SA1"]) == (aware, 0.0, 0.0)


@pytest.mark.long
def test_the_command_prints_the_figures_of_each_camera(tmp_path, capsys):
    folder = write_corner(tmp_path / "corner", np.random.default_rng(0), approaches=4, hazard_free=4)
    assert main(["ablations", str(folder), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["states"]["boxes"]
    assert {"full", "signature_only", "vision_trusted", "eq_5"} <= set(rows["statistic"])
    assert {"product", "product, no camera", "product, vision trusted"} <= set(rows["product"])
    assert rows["product"]["product, no camera"]["vision_only"] == 0.0
