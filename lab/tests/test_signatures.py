"""The signature study: separability by a linear signature, on other recordings and on the other corpus."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_traffic_corpora import write_idmt, write_sound
from worldstate_lab.cli.main import main
from worldstate_lab.signatures.clip_signatures import (
    ClipSignatures,
    hear_clips,
    signature,
    signature_edges_hz,
)
from worldstate_lab.signatures.signature_study import (
    area,
    balanced_accuracy,
    held_out,
    interval,
    scores_of,
    signature_study,
    transferred,
)
from worldstate_lab.signatures.traffic_clips import BACKGROUND, KINDS, ClipLabels, melaudis

RATE_HZ = 24_000


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Return four recordings of IDMT-Traffic, two of them for tests, and two days of MELAUDIS."""
    idmt, city = (tmp_path_factory.mktemp(name) for name in ("idmt", "melaudis"))
    names = [
        f"2019-11-12-15-3{number}_Site{number // 2}_50Kmh_{10 * number + i}{what}_{microphone}{end}"
        for number in range(4)
        for i, (what, end) in enumerate([(f"_M_D_{one}L", "") for one in "CTT"] + [("", "-BG")] * 3)
        for microphone in ("SE_CH34", "ME_CH12")
    ]
    write_idmt(idmt, names, [name for name in names if name[15] in "13"], RATE_HZ)
    for day in (10, 11):
        for i, token in enumerate((*KINDS, *["BG"] * 3)):
            place = city / ("MELAUDIS_BG" if token == "BG" else "MELAUDIS_Vehicles")
            write_sound(
                place / f"2024-01-{day}_13-{i}-0.0-Fitzroy1_FF_1V-{token}_LR_stereo.wav", rate_hz=RATE_HZ
            )
    return idmt, city


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


@settings(max_examples=10, deadline=None)
@given(st.floats(-40.0, 20.0), st.sampled_from((44_100.0, 32_000.0, 24_000.0)))
def test_a_tone_is_in_its_band_with_its_level_at_any_sample_rate(level_db, rate_hz):
    amplitude, band = 0.1 * 10.0 ** (level_db / 20.0), 9
    edges = signature_edges_hz()
    tone = np.sin(2.0 * np.pi * np.mean(edges[band : band + 2]) * np.arange(2 * rate_hz) / rate_hz)
    found = signature(np.float32(amplitude * tone)[:, None], rate_hz)
    assert found.argmax() == band
    assert found[band] == pytest.approx(np.log(amplitude**2 / 2.0), abs=0.05)


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


def test_another_gain_shifts_the_threshold_but_not_the_area():
    rng = np.random.default_rng(2)
    home, away = (drawn(rng, recordings=10, clips=20, lift=3.0) for _ in range(2))
    louder = replace(away, energy=away.energy + 9.0)
    found = (transferred(home, louder, by) for by in ("level", "shape"))
    by_level, by_shape = (scores_of(louder, score, louder.motor) for score in found)
    assert area(by_level) > 0.99
    assert balanced_accuracy(by_level) == 0.5, "everything is called a vehicle"
    unmoved = scores_of(away, transferred(home, away, "shape"), away.motor)
    np.testing.assert_allclose(by_shape.score, unmoved.score, atol=1e-9)


def test_clips_repeated_within_their_recordings_do_not_narrow_the_interval():
    table = drawn(np.random.default_rng(3), recordings=12, clips=5, fingerprint=1.0, lift=0.3)
    once = scores_of(table, table.energy.mean(axis=1), table.motor)
    often = once.select(np.repeat(np.arange(len(once.score)), 7))
    low, high = interval(area, once, np.random.default_rng(4))
    assert interval(area, often, np.random.default_rng(4)) == pytest.approx((low, high))
    assert low < area(once) < high


@pytest.mark.long
def test_the_command_fills_the_rows_of_the_folders_that_are_given(folders, tmp_path, capsys):
    idmt, city = folders
    broken = next((idmt / "audio").glob("*_CL_SE_*"))
    broken.write_bytes(broken.read_bytes()[: broken.stat().st_size // 2])
    words = ["corpora", "--idmt", idmt, "--melaudis", city, "--out", tmp_path, "--json"]
    assert main([*map(str, words)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report == json.loads((tmp_path / "signatures.json").read_text())
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


def test_rows_of_a_missing_corpus_contain_the_command_that_computes_them(folders):
    table = hear_clips("city", melaudis(folders[1]))
    rows = signature_study(None, table, np.random.default_rng(0)).rows
    notes = {row.note for row in rows if row.value is None}
    assert "worldstate-lab corpora --idmt DIR" in notes
    assert "worldstate-lab corpora --idmt DIR --melaudis DIR" in notes
    assert all(row.value is not None for row in rows if row.name == "tram by level, phone microphones")


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--idmt", "."], "missing: annotation/idmt_traffic_all.txt"),
        ([], "expected --idmt, --melaudis or both"),
    ],
)
def test_without_a_corpus_the_command_is_rejected(words, problem, capsys):
    assert main(["corpora", *words]) == 2
    assert problem in capsys.readouterr().err
