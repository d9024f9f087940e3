"""`worldstate evaluate` from end to end on four simulated recordings."""

import json
import time

import pytest

from worldstate.cli.main import main

TABLE_ONE = (
    "Vision-only",
    "Radar field-of-view model",
    "OC-SORT recovery (stock)",
    "OC-SORT recovery (coasting)",
    "published",
    "published, sustained",
    "proposed .01",
    "proposed .02",
    "proposed .05",
    "proposed .02 + looming",
    "with absence .02",
    "shipped model",
    "+ site adaptation",
    "world-state advisory",
)


def test_every_row_of_the_table_is_there(smoke):
    _, report = smoke
    assert set(TABLE_ONE) <= set(report["protocols"]["static"])
    assert set(report["protocols"]) == {"static", "junctions_fixed", "junctions_retrained"}
    assert "dynamic" in report["lacking"] and "moving ego" in report["lacking"]["dynamic"]
    assert "simulated" in report["data"]
    # Two recordings of either kind say nothing, and the report says that.
    assert len(report["cautions"]["static"]) == 2


def test_line_of_sight_says_nothing_before_sight(smoke):
    rows = smoke[1]["protocols"]["static"]
    for name in TABLE_ONE[:3]:
        assert rows[name]["detection"] == 0.0


def test_a_second_run_hears_nothing_again_and_says_the_same(smoke, capsys):
    out, report = smoke
    kept = {path: path.stat().st_mtime_ns for path in (out / "cache").rglob("*.npz")}
    assert main(["evaluate", "--smoke", "--out", str(out), "--against", str(out)]) == 0
    again = json.loads((out / "evaluation.json").read_text())
    assert {path: path.stat().st_mtime_ns for path in (out / "cache").rglob("*.npz")} == kept
    assert again["protocols"] == report["protocols"]
    differences = [one["differences"]["detection"] for one in again["against"]]
    assert differences and all(value == [0.0, 0.0, 0.0] for value in differences)
    assert "less the other evaluation" in capsys.readouterr().out


@pytest.mark.slow
def test_a_stream_of_the_same_quiet_recordings_can_be_added(smoke, tmp_path):
    import numpy as np
    import soundfile

    out, report = smoke
    quiet = sorted((out / "smoke").glob("S*/none/*/out_multi.wav"))
    parts = [soundfile.read(path, dtype="int32")[0] for path in quiet]
    soundfile.write(tmp_path / "quiet.wav", np.concatenate(parts), 47_998, subtype="PCM_24")
    (tmp_path / "array.xml").write_bytes((out / "smoke" / "array.xml").read_bytes())
    more = ["--hazard-free", str(tmp_path / "quiet.wav"), "--out", str(tmp_path / "out")]
    features = next((out / "cache").glob("windows-*.csv"))
    assert main(["evaluate", str(out / "smoke"), "--features", str(features), *more]) == 0
    found = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    before = report["protocols"]["static"]["published"]["hazard_free_hours"]
    # The stream has no edges: it is scored from its first second to its last.
    assert found["protocols"]["static"]["published"]["hazard_free_hours"] > 1.9 * before


def test_partial_data_are_refused_with_what_is_missing(smoke, tmp_path, capsys):
    import shutil

    out, _ = smoke
    broken = tmp_path / "broken"
    shutil.copytree(out / "smoke", broken, ignore=shutil.ignore_patterns("out_multi.wav"))
    started = time.monotonic()
    assert main(["evaluate", str(broken), "--out", str(tmp_path / "no")]) == 2
    said = capsys.readouterr().err
    assert said.count("out_multi.wav") == 4 and "4 things are missing" in said
    assert main(["evaluate", str(tmp_path), "--out", str(tmp_path / "no")]) == 2
    assert "DataLog.csv" in capsys.readouterr().err
    assert time.monotonic() - started < 10.0
    assert not (tmp_path / "no" / "cache").exists()


@pytest.mark.slow
def test_streets_whose_simulation_was_interrupted_are_completed(smoke, tmp_path):
    import shutil

    out, report = smoke
    again = tmp_path / "again"
    shutil.copytree(out / "smoke", again / "smoke")
    shutil.copytree(out / "cache", again / "cache")
    log = again / "smoke" / "DataLog.csv"
    log.write_text("".join(log.read_text().splitlines(keepends=True)[:-1]))
    assert main(["evaluate", "--smoke", "--out", str(again)]) == 0
    found = json.loads((again / "evaluation.json").read_text())
    assert found["recordings"] == report["recordings"]
    assert found["protocols"] == report["protocols"]
