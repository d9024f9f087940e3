"""Single clips: signatures of vehicles against background, and kinds of road users."""

import csv
import json
import re
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import ttest_ind
from worldstate_lab.cli.clips import ClipNumbers, judged, read_clips
from worldstate_lab.cli.main import main
from worldstate_lab.signatures.clip_signatures import (
    ClipSignatures,
    discriminative_range_hz,
    fisher_profile,
    level_invariant_shape,
    signature,
    signature_edges_hz,
)
from worldstate_lab.signatures.signature_study import area, held_out, scores_of, transferred
from worldstate_lab.signatures.traffic_clips import (
    BACKGROUND,
    CLIP_S,
    KINDS,
    ClipLabels,
    idmt_traffic,
    read_clip,
)

from worldstate.abduction.road_users import RoadUserModel
from worldstate.adapters.files.model_file import read_model
from worldstate.ground.errors import InputFileError, InvalidArgumentError

RATE_HZ = 24_000
REAL = Path(__file__).parents[3] / "shared" / "real-sounds"
CAR = "2019-10-22-08-40_Fraunhofer-IDMT_30Kmh_1272258_M_D_CR"
EMPTY = "2019-11-19-13-10_Langewiesener-Strasse_unknownKmh_10077440"
IDMT_NAMES = [f"{CAR}_ME_CH12", f"{CAR}_SE_CH34", f"{EMPTY}_SE_CH34-BG", f"{EMPTY}_ME_CH12-BG"]


def write_sound(path, seconds=CLIP_S, rate_hz=8000):
    """Write noise that is louder if a vehicle passes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(crc32(path.name.encode()))
    most = 0.1 if "BG" in path.parent.name + path.name else 0.3
    soundfile.write(path, rng.uniform(-most, most, (round(seconds * rate_hz), 2)), rate_hz)


def write_idmt(root, names=IDMT_NAMES, test=IDMT_NAMES[2:], rate_hz=8000):
    (root / "annotation").mkdir(parents=True)
    lists = {"idmt_traffic_all": names, "eusipco_2021_test": test}
    lists["eusipco_2021_train"] = [name for name in names if name not in test]
    for name, lines in lists.items():
        (root / "annotation" / f"{name}.txt").write_text("".join(f"{line}.wav\n" for line in lines))
    for name in names:
        write_sound(root / "audio" / f"{name}.wav", rate_hz=rate_hz)
    return root


def write_melaudis(root, day="2024-02-09", seconds=61.0, rate_hz=8000):
    for token in KINDS:
        name = f"{day}_13-62-1.8-Fitzroy1_FF_1V-{token}_L1_2Lanes_LR_stereo.wav"
        write_sound(root / "MELAUDIS_Vehicles" / "Final_Veh" / "Fit1" / name, rate_hz=rate_hz)
    write_sound(root / "MELAUDIS_BG" / f"night-{day}.wav", seconds, rate_hz)
    write_sound(root / "MELAUDIS_BG" / f"{day}_15-1-2.0-Fitzroy1_2L.wav", 1.4, rate_hz)
    return root


def test_idmt_clips_have_the_labels_of_their_names(tmp_path):
    clips = idmt_traffic(write_idmt(tmp_path))
    labels = [clip.labels for clip in clips]
    assert [one.kind for one in labels] == ["car", "car", BACKGROUND, BACKGROUND]
    assert [one.microphone for one in labels] == ["mems", "studio", "studio", "mems"]
    assert [one.split for one in labels] == ["train", "train", "test", "test"]
    assert [one.site for one in labels[::2]] == ["Fraunhofer-IDMT", "Langewiesener-Strasse"]
    # Both microphones recorded one passage: a fold that separated them would test on training data.
    assert labels[0].recording == labels[1].recording != labels[2].recording == labels[3].recording
    samples, rate_hz = read_clip(clips[0])
    assert (samples.shape, rate_hz) == ((16_000, 2), 8000.0)


@pytest.mark.parametrize("lost", ["annotation/eusipco_2021_test.txt", f"audio/{IDMT_NAMES[1]}.wav"])
def test_a_partial_folder_is_rejected_with_the_missing_files(tmp_path, lost):
    (write_idmt(tmp_path / "corpus") / lost).rename(tmp_path / "elsewhere")
    with pytest.raises(InputFileError, match=f"missing: {re.escape(lost)}"):
        idmt_traffic(tmp_path / "corpus")


def test_the_profile_is_welchs_t_squared_over_n_and_finds_the_band_of_vehicle_sound():
    rng = np.random.default_rng(1)
    edges = np.geomspace(50.0, 8000.0, 17)
    heard = (edges[:-1] > 290) & (edges[1:] < 1900)
    background = rng.normal(0.0, 1.0, (400, 16)) + rng.normal(0, 3, (400, 1))
    vehicle = rng.normal(0.0, 1.0, (400, 16)) + rng.normal(0, 3, (400, 1)) + 2.0 * heard
    with_level = fisher_profile(vehicle, background)
    t = ttest_ind(vehicle, background, equal_var=False).statistic
    np.testing.assert_allclose(with_level, t**2 / 400)
    shapes = level_invariant_shape(vehicle), level_invariant_shape(background)
    np.testing.assert_allclose(np.diff(shapes[0], axis=1), np.diff(vehicle, axis=1), atol=1e-9)
    profile = fisher_profile(*shapes)
    assert profile[heard].min() > 3 * with_level[heard].max()
    assert discriminative_range_hz(profile, edges) == (edges[:-1][heard][0], edges[1:][heard][-1])


@settings(max_examples=10, deadline=None)
@given(st.floats(-40.0, 20.0), st.sampled_from((44_100.0, 32_000.0, 24_000.0)))
def test_a_tone_is_in_its_band_with_its_level_at_any_sample_rate(level_db, rate_hz):
    amplitude, band = 0.1 * 10.0 ** (level_db / 20.0), 9
    edges = signature_edges_hz()
    tone = np.sin(2.0 * np.pi * np.mean(edges[band : band + 2]) * np.arange(2 * rate_hz) / rate_hz)
    found = signature(np.float32(amplitude * tone)[:, None], rate_hz)
    assert found.argmax() == band
    assert found[band] == pytest.approx(np.log(amplitude**2 / 2.0), abs=0.05)


def drawn(rng, recordings, clips, *, fingerprint=0.0, lift=0.0):
    """Draw a corpus of clips: each recording has one class and a mark of its own; vehicles are `lift`
    louder."""
    rows = []
    for number in range(recordings):
        kind = ("car", BACKGROUND)[number % 2]
        mark = fingerprint * rng.standard_normal(16) + lift * (kind == "car")
        labels = ClipLabels(kind, "studio", str(number), "here")
        rows += [(labels, mark + rng.standard_normal(16)) for _ in range(clips)]
    return ClipSignatures.of("drawn", rows)


def test_a_recording_is_never_scored_by_a_model_trained_on_it():
    learned, kept = [], []
    for rng in np.random.default_rng(0).spawn(6):
        table = drawn(rng, recordings=14, clips=4, fingerprint=5.0)
        learned.append(area(scores_of(table, transferred(table, table, "level"), table.motor)))
        scored, score, how = held_out(table, "level", rng)
        kept.append(area(scores_of(scored, score, scored.motor)))
    assert np.mean(learned) > 0.97, "the marks of so few recordings can be learned by heart"
    assert 0.25 < np.mean(kept) < 0.7
    assert how == "5 folds by recording"


@pytest.mark.long
def test_the_command_fills_every_row_of_two_corpora(tmp_path, capsys):
    names = [
        f"2019-11-12-15-3{number}_Site{number // 2}_50Kmh_{10 * number + i}{what}_{microphone}{end}"
        for number in range(4)
        for i, (what, end) in enumerate([(f"_M_D_{one}L", "") for one in "CTT"] + [("", "-BG")] * 3)
        for microphone in ("SE_CH34", "ME_CH12")
    ]
    idmt = write_idmt(tmp_path / "idmt", names, [name for name in names if name[15] in "13"], RATE_HZ)
    broken = next((idmt / "audio").glob("*_CL_SE_*"))
    broken.write_bytes(broken.read_bytes()[: broken.stat().st_size // 2])
    for day in ("2024-01-10", "2024-01-11"):
        city = write_melaudis(tmp_path / "city", day, 6.0, RATE_HZ)
    words = ["--idmt", str(idmt), "--melaudis", str(city), "--out", str(tmp_path / "out"), "--json"]
    assert main(["corpora", *words]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report == json.loads((tmp_path / "out" / "signatures.json").read_text())
    rows = {(row["name"], row["corpus"], row["figure"]): row for row in report["rows"]}
    assert all(row["value"] is not None for row in rows.values())
    studio = rows["vehicle by level, studio microphones", "IDMT-Traffic", "AUROC"]
    assert studio["paper"] == [0.999, 0.999]
    assert "official split; worst site" in studio["note"]
    assert studio["low"] <= studio["value"] <= studio["high"]
    assert studio["value"] > 0.9
    # Two recordings for the test, each with a car, two trucks and three clips of background.
    assert rows["vehicle by level, mems microphones", "IDMT-Traffic", "AUROC"]["n_clips"] == 12
    assert [problem for problem in report["left_out"] if broken.name in problem] == report["left_out"] != []
    assert main(["corpora"]) == 2
    assert "expected --idmt, --melaudis or both" in capsys.readouterr().err


def test_files_of_several_rates_and_lengths_are_processed(tmp_path, capsys):
    rng, rows = np.random.default_rng(1), []
    for number, (rate, seconds, channels) in enumerate([(8000, 3.0, 1), (22050, 4.0, 2), (48000, 1.0, 1)]):
        sound = 0.1 * rng.standard_normal((round(rate * seconds), channels))
        soundfile.write(tmp_path / f"{number}.wav", sound, rate)
        rows.append((f"{number}.wav", "noise", f"r{number}", "car" if number == 1 else ""))
    path = tmp_path / "clips.csv"
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([("file", "kind", "recording", "road_user"), *rows])
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
    np.savez(tmp_path / "few.npz", character=np.zeros((3, 7)), clip=np.zeros(3, int))
    assert main(["clips", str(path), "--numbers", str(tmp_path / "few.npz")]) == 2
    assert "49 numbers" in capsys.readouterr().err


def test_probabilities_are_corrected_to_the_shares_of_the_table():
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
def test_real_vehicles_are_familiar_and_trams_are_not_trucks(tmp_path):
    rows = list(csv.DictReader((REAL / "clips.csv").open()))
    known = {"car", "tram"}
    said = [(r["sound"], r["kind"], r["recording"], r["kind"] if r["kind"] in known else "") for r in rows]
    path = tmp_path / "clips.csv"
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([("file", "kind", "recording", "road_user"), *said])
    clips = read_clips(path, REAL / "numbers.npz")
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
