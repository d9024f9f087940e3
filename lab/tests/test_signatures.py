"""The signature study: separability by a linear signature, on other recordings and on the other corpus."""

import json

import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import butter, sosfilt
from worldstate_lab.cli.main import main
from worldstate_lab.signatures.clip_signatures import ClipSignatures, signature, signature_edges_hz
from worldstate_lab.signatures.signature_study import (
    area,
    balanced_accuracy,
    held_out,
    interval,
    scores_of,
    signature_study,
    transferred,
)
from worldstate_lab.signatures.traffic_clips import BACKGROUND, KINDS, ClipLabels

RATE_HZ = 24_000.0
# Amplitude of passing vehicles beside the background
LOUD = {"car": 4.0, "truck": 6.0, "tram": 3.0, "electric": 2.0, "bicycle": 1.1}
TOWN, CITY = ("car", "truck", "truck"), ("car", "truck", "tram", "electric", "bicycle")
BAND = butter(2, (300.0, 1800.0), "bandpass", fs=RATE_HZ, output="sos")


def recorded(kinds, microphones, number, splits=("",)):
    """Yield the clips of one recording: noise, louder in one band if a vehicle passes."""
    rng = np.random.default_rng(number)
    for kind in (*kinds, *(BACKGROUND,) * 3):
        for microphone in microphones:
            street, vehicle = rng.normal(size=(2, round(2.0 * RATE_HZ)))
            sound = 0.01 * (street + LOUD.get(kind, 0.0) * sosfilt(BAND, vehicle))
            labels = ClipLabels(kind, microphone, str(number), "here", splits[number % len(splits)])
            yield labels, np.float32(sound)[:, None]


@pytest.fixture(scope="module")
def city():
    return [clip for number in range(2) for clip in recorded(CITY, ("phone",), number)]


@pytest.fixture(scope="module")
def folders(city, tmp_path_factory):
    """Return clips in the layouts of IDMT-Traffic and of MELAUDIS."""
    idmt, melaudis = (tmp_path_factory.mktemp(name) for name in ("idmt", "melaudis"))
    lists = {"idmt_traffic_all": [], "eusipco_2021_train": [], "eusipco_2021_test": []}
    for number in range(4):
        clips = recorded(TOWN, ("studio", "mems"), number, ("train", "test"))
        for middle, (labels, samples) in enumerate(clips, 100 * number):
            is_street = labels.kind == BACKGROUND
            what, end = ("", "-BG") if is_street else (f"_M_D_{labels.kind[0].upper()}L", "")
            microphone = "SE_CH34" if labels.microphone == "studio" else "ME_CH12"
            name = f"2019-11-12-15-3{number}_Site{number // 2}_50Kmh_{middle}{what}_{microphone}{end}.wav"
            write_sound(idmt / "audio" / name, samples)
            for file in ("idmt_traffic_all", f"eusipco_2021_{labels.split}"):
                lists[file].append(name)
    (idmt / "annotation").mkdir()
    for file, names in lists.items():
        (idmt / "annotation" / f"{file}.txt").write_text("\n".join(names))
    tokens = {kind: token for token, kind in KINDS.items()}
    for middle, (labels, samples) in enumerate(city):
        spot = f"2024-01-1{labels.recording}_13-{middle}-0.0-Fitzroy1"
        if labels.kind == BACKGROUND:
            write_sound(melaudis / "MELAUDIS_BG" / f"{spot}.wav", samples)
        elif labels.kind in tokens:
            name = f"{spot}_FF_1V-{tokens[labels.kind]}_L1_2Lanes_LR_stereo.wav"
            write_sound(melaudis / "MELAUDIS_Vehicles" / "Final_Veh" / "Fit1" / name, samples)
    return idmt, melaudis


def write_sound(path, samples):
    path.parent.mkdir(parents=True, exist_ok=True)
    soundfile.write(path, np.repeat(samples, 2, axis=1), int(RATE_HZ), subtype="PCM_24")


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
    louder = ClipSignatures.of(
        "louder",
        [
            (ClipLabels(k, "phone", r, ""), e + 9.0)
            for k, r, e in zip(away.kinds, away.recordings, away.energy, strict=True)
        ],
    )
    by_level, by_shape = (
        scores_of(louder, transferred(home, louder, by), louder.motor) for by in ("level", "shape")
    )
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
    idmt, melaudis = folders
    broken = next((idmt / "audio").glob("*_CL_SE_*"))
    whole = broken.read_bytes()
    broken.write_bytes(whole[: len(whole) // 2])
    try:
        words = ["corpora", "--idmt", idmt, "--melaudis", melaudis, "--out", tmp_path, "--json"]
        assert main([*map(str, words)]) == 0
    finally:
        broken.write_bytes(whole)
    report = json.loads(capsys.readouterr().out)
    assert report == json.loads((tmp_path / "signatures.json").read_text())
    rows = {(row["name"], row["corpus"], row["figure"]): row for row in report["rows"]}
    assert {row["name"].split()[0] for row in rows.values() if row["value"] is None} == {"electric"}
    studio = rows["vehicle by level, studio microphones", "IDMT-Traffic", "AUROC"]
    assert studio["paper"] == [0.999, 0.999]
    assert "official split; worst site" in studio["note"]
    assert studio["low"] <= studio["value"] <= studio["high"]
    assert studio["value"] > 0.9
    # Two recordings for the test, each with a car, two trucks and three clips of background.
    assert rows["vehicle by level, mems microphones", "IDMT-Traffic", "AUROC"]["n_clips"] == 12
    assert [problem for problem in report["left_out"] if broken.name in problem] == report["left_out"] != []


def test_rows_of_a_missing_corpus_contain_the_command_that_computes_them(city):
    table = ClipSignatures.of("city", [(labels, signature(samples, RATE_HZ)) for labels, samples in city])
    rows = signature_study(None, table, np.random.default_rng(0)).rows
    notes = {row.note for row in rows if row.value is None}
    assert "worldstate-lab corpora --idmt DIR" in notes
    assert "worldstate-lab corpora --idmt DIR --melaudis DIR" in notes
    assert all(row.value is not None for row in rows if row.name == "tram by level, phone microphones")


def test_a_wrong_folder_is_one_line_and_exit_code_two(tmp_path, capsys):
    assert main(["corpora", "--idmt", str(tmp_path)]) == 2
    assert "missing: annotation/idmt_traffic_all.txt" in capsys.readouterr().err


def test_without_a_corpus_the_command_lists_its_options(capsys):
    assert main(["corpora"]) == 2
    assert "expected --idmt, --melaudis or both" in capsys.readouterr().err
