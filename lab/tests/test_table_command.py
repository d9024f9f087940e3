"""`worldstate-lab table` from end to end on four simulated recordings."""

import argparse
import json
import os
import shutil
import time

import numpy as np
import pytest
import soundfile
from worldstate_lab.cli import table
from worldstate_lab.cli.main import main

from worldstate.adapters.files.model_file import read_model, save_model
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.simulation.dataset.dataset import DatasetSettings, write_dataset

TABLE_ONE = (
    *("Vision-only", "Radar field-of-view model", "OC-SORT recovery (stock)", "OC-SORT recovery (coasting)"),
    *("published", "published, sustained", "proposed .01", "proposed .02", "proposed .05"),
    *(
        "proposed .02 + looming",
        "with absence .02",
        "shipped model",
        "+ site adaptation",
        "world-state advisory",
    ),
)


def test_every_row_of_the_table_is_there(smoke):
    _, report = smoke
    assert set(TABLE_ONE) <= set(report["protocols"]["static"])
    assert set(report["protocols"]) == {"static", "junctions_fixed", "junctions_retrained"}
    assert "dynamic" in report["lacking"] and "moving ego" in report["lacking"]["dynamic"]
    assert "SIMULATED" in report["data"]
    # Two recordings of either kind are too few, and the report states this.
    assert len(report["cautions"]["static"]) == 2


def test_line_of_sight_methods_have_no_alarm_before_t0(smoke):
    rows = smoke[1]["protocols"]["static"]
    for name in TABLE_ONE[:3]:
        assert rows[name]["detection"] == 0.0


@pytest.mark.slow
def test_a_second_run_uses_the_cache_and_gives_the_same(smoke):
    out, report = smoke
    kept = {path: path.stat().st_mtime_ns for path in (out / "cache").rglob("*.npz")}
    assert main(["table", "--smoke", "--jobs", "2", "--out", str(out)]) == 0
    again = json.loads((out / "evaluation.json").read_text())
    assert {path: path.stat().st_mtime_ns for path in (out / "cache").rglob("*.npz")} == kept
    assert again["protocols"] == report["protocols"]
    counts = {"recordings": 4, "approaches": 2, "hazard_free": 2}
    for name in again["protocols"]:
        assert counts.items() <= again["stands_on"][name].items()
    text = (out / "report.md").read_text(encoding="utf-8")
    assert text.count("4 recordings: 2 approaches and 2 hazard-free") > 5


def test_partial_data_are_rejected_with_a_list(smoke, tmp_path, capsys):
    out, _ = smoke
    broken = tmp_path / "broken"
    shutil.copytree(out / "smoke", broken, ignore=shutil.ignore_patterns("out_multi.wav"))
    started = time.monotonic()
    assert main(["table", str(broken), "--out", str(tmp_path / "no")]) == 2
    said = capsys.readouterr().err
    assert said.count("out_multi.wav") == 4 and "4 required items are missing" in said
    assert main(["table", str(tmp_path), "--out", str(tmp_path / "no")]) == 2
    assert "DataLog.csv" in capsys.readouterr().err
    assert time.monotonic() - started < 10.0
    assert not (tmp_path / "no" / "cache").exists()


@pytest.mark.slow
def test_streets_whose_simulation_was_interrupted_are_completed(smoke, tmp_path):
    out, report = smoke
    again = tmp_path / "again"
    shutil.copytree(out / "smoke", again / "smoke")
    shutil.copytree(out / "cache", again / "cache")
    log = again / "smoke" / "DataLog.csv"
    log.write_text("".join(log.read_text().splitlines(keepends=True)[:-1]))
    assert main(["table", "--smoke", "--out", str(again)]) == 0
    found = json.loads((again / "evaluation.json").read_text())
    assert found["recordings"] == report["recordings"]
    assert found["protocols"] == report["protocols"]


@pytest.mark.slow
def test_a_broken_recording_that_leaves_too_few_is_listed(smoke, tmp_path, capsys):
    """Three recordings remain, and no protocol can be run with one approach."""
    out, _ = smoke
    shutil.copytree(out / "smoke", tmp_path / "smoke", copy_function=os.link)
    shutil.copytree(out / "cache", tmp_path / "cache")
    sound = next((tmp_path / "smoke").glob("S*/left/*/out_multi.wav"))
    whole = sound.read_bytes()
    sound.unlink()
    sound.write_bytes(whole[: len(whole) // 2])
    assert main(["table", "--smoke", "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "2 approaches with a T0, found 1" in said
    assert f"not processed: {sound.parent.name}: " in said and "cut short" in said
    assert not (tmp_path / "report.md").exists()


@pytest.mark.slow
def test_recordings_of_another_array_two_of_them_broken(tmp_path, capsys):
    """The other methods are scored, but not the shipped model, which was made for another array."""
    root, out = tmp_path / "data", tmp_path / "out"
    eight = MicrophoneArray(ovad_array().positions_m[::7], "eight microphones")
    write_dataset(root, DatasetSettings(n_static=6, duration_s=8.0), array=eight)
    cut, two = (next(root.glob(f"SB1/{side}/*/out_multi.wav")) for side in ("left", "none"))
    cut.write_bytes(cut.read_bytes()[:5_000_000])
    soundfile.write(two, np.zeros((48_000, 2)), 47_998, subtype="PCM_24")
    assert main(["table", str(root), "--out", str(out)]) == 0
    found = json.loads((out / "evaluation.json").read_text())
    assert set(found["failed"]) == {cut.parent.name, two.parent.name}
    assert found["recordings"] == found["stands_on"]["static"]["recordings"] == 4
    ours = {"shipped model", "+ site adaptation", "world-state advisory", "shipped scores .02"}
    assert ours <= set(found["refused"]["static"])
    assert not ours & set(found["protocols"]["static"])
    assert "8 microphones, expected 56" in found["refused"]["static"]["shipped model"]
    assert found["protocols"]["static"]["published"]["hazard_free_hours"] > 0.003
    text = (out / "report.md").read_text(encoding="utf-8")
    assert "shipped model | not scored: the model was not made for this sound" in text
    assert "not scored: " in capsys.readouterr().out
    # A model given explicitly is rejected at once.
    save_model(tmp_path / "model.json", read_model())
    model = ["--model", str(tmp_path / "model.json")]
    assert main(["table", str(root), "--out", str(tmp_path / "no"), *model]) == 2
    said = capsys.readouterr().err
    assert "not the array of the model" in said and "--uncalibrated" not in said


def test_finished_streets_of_another_seed_are_simulated_again(tmp_path, monkeypatch):
    for name, value in {"SMOKE_STATIC": 1, "SMOKE_S": 0.5, "SMOKE_VIDEO_PX": 64}.items():
        monkeypatch.setattr(table, name, value)

    def simulated(seed):
        root = table._simulated(argparse.Namespace(out=tmp_path, smoke=True, seed=seed, jobs=1))
        (truth,) = root.rglob("truth.json")
        return json.loads(truth.read_text())["settings"], truth.stat().st_mtime_ns

    first = simulated(1)
    assert simulated(1) == first, "what is there is kept"
    other = simulated(2)
    assert other[0] != first[0]
    assert simulated(2) == other
