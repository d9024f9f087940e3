"""`worldstate model make` from an array file to a readable model and its exam."""

import gzip
import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile

from worldstate.adapters.files.model_file import read_model, save_model
from worldstate.cli.main import main


@pytest.fixture
def command(tmp_path):
    """Return the words of a quick model of four microphones."""
    (tmp_path / "mics.csv").write_text("x,y,z\n0,0.2,0\n0,0.05,0\n0.05,-0.1,0\n0,-0.25,0\n")
    made = ["--array", str(tmp_path / "mics.csv"), "--out", str(tmp_path / "model.json"), "--quick"]
    return ["model", "make", *made]


@pytest.mark.slow
def test_commissioning_of_four_microphones_resumes(command, tmp_path, capsys, refused):
    out, figure, report = tmp_path / "model.json", tmp_path / "exam.png", tmp_path / "exam.json"
    assert main([*command, "--figure", str(figure), "--report", str(report), "--mounting-errors"]) == 0
    assert "unfit for use" in capsys.readouterr().out
    model = read_model(out)
    assert main(["model", "show", str(out)]) == 0
    card = capsys.readouterr().out
    assert "source 1        simulated streets: coefficients; licence: Apache-2.0" in card
    assert "simulated streets: exam" in card
    told = json.loads(report.read_text())
    # Two renderings of the exam: the report and the card of the model.
    alone = sum(value for name, value in told.items() if name.startswith("approaches_"))
    assert sum(one.approaches for one in model.provenance.kinds) == alone
    assert model.provenance.exam["detected"] == told["detected"]
    assert model.provenance.real == tuple(one for one in read_model().provenance.real if not one.own) != ()
    assert card.count("no real recording of such an array and motion; ") == len(model.provenance.real)
    assert told["approaches"] >= 1 and told["hazard_free_hours"] > 0.03 and figure.stat().st_size > 10_000
    assert told["mounting"]["as mounted"]["detected"] == told["detected"]
    heard = {path: path.stat().st_mtime_ns for path in (tmp_path / "model.streams").iterdir()}
    before = out.read_bytes()
    assert main(command) == 0
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "model.streams").iterdir()} == heard
    assert out.read_bytes() == before
    boards = [*command[:2], "--array", "respeaker-4", *command[2:], "--out", str(tmp_path / "boards")]
    assert main([*boards, "--no-exam", "--streams", str(tmp_path / "model.streams")]) == 0
    made = {path.name: path for path in (tmp_path / "boards").iterdir()}
    assert set(made) == {"respeaker-4.json.gz", "mics.json.gz"}
    # The same model except for the card of the omitted exam.
    save_model(out, replace(model, provenance=replace(model.provenance, exam={}, kinds=())))
    assert gzip.decompress(made["mics.json.gz"].read_bytes()) == out.read_bytes() != before
    assert read_model(made["respeaker-4.json.gz"]).domain.array == "respeaker-4"
    quiet = tmp_path / "night.wav"
    noise = np.random.default_rng(1).standard_normal((6000 * 25, 4)) * 0.01
    soundfile.write(quiet, noise, 6000, subtype="FLOAT")
    assert "expected 0.10 hours" in refused([*command, "--no-exam", "--quiet", str(quiet)])
    assert main([*command, "--no-exam", "--quiet", str(quiet), "--onsets", "600"]) == 0
    told = read_model(out).sequence
    assert told.alarm.onsets_per_hour == 600.0
    # With so little sound no alarm may be reached: the hours are those of the curve.
    assert told.curve.hours == pytest.approx(24.1 / 3600.0) != model.sequence.curve.hours


def clips_of(folder: Path, road_user: str) -> list[str]:
    """Write a clip and its table; return the options for learning from it."""
    rng = np.random.default_rng(2)
    soundfile.write(folder / "clip.wav", 0.1 * rng.standard_normal(3 * 16_000), 16_000)
    (folder / "clips.csv").write_text(f"file,kind,recording,road_user\nclip.wav,pump,r,{road_user}\n")
    return ["--sounds", str(folder), "--kinds", str(folder / "clips.csv")]


def test_wrong_training_data_raises_an_error_before_rendering(tmp_path, refused):
    command = ["model", "make", "--quick", "--out", str(tmp_path / "model.json")]
    short = np.random.default_rng(1).uniform(-0.1, 0.1, (12_000, 56))
    soundfile.write(tmp_path / "night.wav", short, 6000)
    for options, told in (
        (["--quiet", str(tmp_path / "missing.wav")], "missing.wav"),
        (["--quiet", str(tmp_path / "night.wav")], "quiet: expected 0.10 hours"),
        (["--kinds", "clips.csv"], "--sounds, --kinds: expected both"),
        (clips_of(tmp_path, "ufo"), "clips.csv: line 2: road_user"),
    ):
        assert told in refused([*command, *options])
    assert not (tmp_path / "model.streams").exists()


@pytest.mark.slow
def test_a_model_card_lists_recorded_clips(command, tmp_path, capsys):
    assert main([*command, "--no-exam", *clips_of(tmp_path, "")]) == 0
    model = read_model(tmp_path / "model.json")
    assert "pump" in model.guard.foreign
    assert model.road_users is not None and not model.provenance.fit_for_use
    digest = hashlib.sha256((tmp_path / "clips.csv").read_bytes()).hexdigest()
    for told in (model.provenance.classifier, capsys.readouterr().out):
        assert "pump 1" in told and digest in told and "not the project's own" in told
