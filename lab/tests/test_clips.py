"""Single clips: files of any rate, numbers of an archive, calibration against closed forms, real sounds."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import soundfile
from worldstate_lab.cli.clips import ClipNumbers, judged, read_clips
from worldstate_lab.cli.main import main

from worldstate.abduction.road_users import RoadUserModel
from worldstate.adapters.files.model_file import read_model
from worldstate.ground.errors import InvalidArgumentError

REAL = Path(__file__).parents[3] / "shared" / "real-sounds"


def table(folder: Path, rows: list[tuple[str, str, str, str]]) -> Path:
    path = folder / "clips.csv"
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([("file", "kind", "recording", "road_user"), *rows])
    return path


def test_files_of_several_rates_and_lengths_are_processed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng, rows = np.random.default_rng(1), []
    for number, (rate, seconds, channels) in enumerate([(8000, 3.0, 1), (22050, 4.0, 2), (48000, 1.0, 1)]):
        sound = 0.1 * rng.standard_normal((round(rate * seconds), channels))
        soundfile.write(tmp_path / f"{number}.wav", sound, rate)
        rows.append((f"{number}.wav", "noise", f"r{number}", "car" if number == 1 else ""))
    path = table(tmp_path, rows)
    clips = read_clips(path, None)
    # The shortest is extended at its start by its mirror image, so that every hop has numbers.
    assert np.bincount(clips.clip).tolist() == [10, 20, 11]
    np.savez(tmp_path / "heard.npz", character=clips.measures, clip=clips.clip)
    assert main(["clips", str(path), "--json"]) == 0
    by_files = json.loads(capsys.readouterr().out)
    assert main(["clips", str(path), "--numbers", str(tmp_path / "heard.npz"), "--json"]) == 0
    by_numbers = json.loads(capsys.readouterr().out)
    assert by_numbers["kinds"] == by_files["kinds"]
    told = by_files["kinds"]["noise"]
    assert told["recordings"] == 3
    assert told["familiar"] + told["foreign"] + told["signal"] == pytest.approx(1.0)
    assert sum(told["road_users"].values()) == pytest.approx(1.0)
    assert by_files["kinds_log_loss_prior"] == 0.0


def test_a_file_of_invalid_numbers_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savez(tmp_path / "few.npz", character=np.zeros((3, 7)), clip=np.zeros(3, int))
    path = table(tmp_path, [("a.wav", "car", "r", "")])
    assert main(["clips", str(path), "--numbers", str(tmp_path / "few.npz")]) == 2
    assert "49 numbers" in capsys.readouterr().err


def test_probabilities_are_corrected_to_the_shares_of_the_table() -> None:
    """For two inseparable kinds the log-loss is that of the table's own shares, in closed form."""
    shipped = read_model()
    assert shipped.guard is not None
    inputs = 49
    model = RoadUserModel(
        tuple(map(str, range(inputs))),
        *(("car", "tram", "unknown"), np.zeros((3, inputs)), np.log([0.9, 0.05, 0.05])),
        np.array([0.9, 0.05, 0.05]),
    )
    users = np.array(["car", "tram", "tram", "tram"])
    names = np.array(["a", "b", "c", "d"])
    clips = ClipNumbers(np.zeros((40, inputs)), np.repeat(np.arange(4), 10), users, names, users)
    found = judged(clips, shipped.guard, model)
    expected = -(0.25 * np.log(0.25) + 0.75 * np.log(0.75))
    assert found["kinds_log_loss"] == pytest.approx(expected)
    assert found["kinds_log_loss_prior"] == pytest.approx(expected)
    assert found["said_90"]["share"] == 0.0
    strange = ClipNumbers(clips.measures, clips.clip, users, names, np.array(["ufo"] * 4))
    with pytest.raises(InvalidArgumentError, match="ufo"):
        judged(strange, shipped.guard, model)


@pytest.mark.skipif(not REAL.exists(), reason="real sounds are beside the repository only")
def test_real_vehicles_are_familiar_and_trams_are_not_trucks(tmp_path: Path) -> None:
    rows = list(csv.DictReader((REAL / "clips.csv").open()))
    known = {"car", "tram"}
    said = [(r["sound"], r["kind"], r["recording"], r["kind"] if r["kind"] in known else "") for r in rows]
    clips = read_clips(table(tmp_path, said), REAL / "numbers.npz")
    model = read_model()
    assert model.guard is not None and model.road_users is not None
    found = judged(clips, model.guard, model.road_users)
    kinds = found["kinds"]
    assert max(kinds[name]["foreign"] for name in known) <= 0.05
    assert kinds["engine_idling"]["foreign"] <= 0.2
    for name in ("dog_bark", "children_playing", "street_music", "gun_shot"):
        assert kinds[name]["familiar"] <= 0.25
    assert kinds["siren"]["signal"] >= 0.6
    assert found["kinds_log_loss"] <= 0.8 * found["kinds_log_loss_prior"]
    assert found["said_90"]["right"] >= 0.85
