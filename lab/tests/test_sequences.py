"""Scores of real recordings: known figures of artificial ones, and the command on an artificial corner."""

import csv
import json
from dataclasses import replace
from functools import reduce
from operator import getitem
from pathlib import Path

import numpy as np
import pytest
from made_up_corner import write_corner
from made_up_trials import made_up
from worldstate_lab.cli.card import with_real
from worldstate_lab.cli.main import main, read_results
from worldstate_lab.methods.line_of_sight import OcSortRecovery
from worldstate_lab.sequences.path_figures import simulated_exam
from worldstate_lab.sequences.path_tables import alarm_table
from worldstate_lab.sequences.recordings import NANODET_BOXES
from worldstate_lab.sequences.scores import alarm_row, calibration, curve, leads, sweep

from worldstate.abduction.sequence.sequence_model import HORIZONS_S
from worldstate.adapters.files.array_file import read_array
from worldstate.adapters.files.model_file import read_model, save_model

EVIDENCE = Path(__file__).resolve().parents[2] / "docs" / "evidence"


def corner(approaches=4, calm=4, *, t0_s=5.0, hops=81, start_s=0.0):
    """Return approaches alternately from right and left at two junctions, and recordings without a
    vehicle."""
    labels = [("right", "left")[i % 2] for i in range(approaches)] + ["none"] * calm
    left_s, hops = t0_s - start_s, hops - round(10 * start_s)
    return [
        made_up(f"r{i}", label, t0_s=left_s, hops=hops, site=f"S{i // 2 % 2}", leads_from_s=left_s)
        for i, label in enumerate(labels)
    ]


def before(trial, first_s, last_s=0.0):
    """Return which hops of an approach end from `first_s` to `last_s` before T0."""
    left_s = trial.t0_s - trial.hops.time_s
    return (left_s < first_s + 1e-6) & (left_s > last_s - 1e-6) & (not trial.hazard_free)


def draw():
    return np.random.default_rng(0)


def test_a_score_that_rises_two_seconds_before_t0_separates_from_then_on() -> None:
    trials = corner()
    scores = [before(one, 2.0).astype(float) for one in trials]
    right = [(one.label == "right") * score for one, score in zip(trials, scores, strict=True)]
    found = leads(trials, scores, right, draw())
    for lead in ("0.5", "1", "1.5", "2"):
        assert found[lead]["auroc"] == found[lead]["side_auroc"] == found[lead]["auroc_all_hops"] == 1.0
        assert found[lead]["auroc_interval"] == (1.0, 1.0)
    assert found["3"]["auroc"] == found["3"]["auroc_all_hops"] == found["3"]["side_auroc"] == 0.5
    assert found["1"]["auroc_by_junction"] == {"S0": 1.0, "S1": 1.0}
    assert (found["1"]["approaches"], found["1"]["hazard_free"]) == (4, 4)


def test_every_hop_of_hazard_free_recordings_counts() -> None:
    trials = corner(2, 2)
    # In a quarter of all hazard-free hops the score equals that of an approach, at the compared hop it does
    # not.
    high = np.arange(81) >= 61
    scores = [before(one, 1.0).astype(float) if not one.hazard_free else high.astype(float) for one in trials]
    found = leads(trials, scores, None, draw())["1"]
    assert found["auroc"] == 1.0
    assert found["auroc_all_hops"] == pytest.approx(1.0 - 0.5 * high.mean())
    assert "side_auroc" not in found


def test_hops_of_a_cut_start_are_not_counted() -> None:
    kinds = corner(), corner(start_s=2)
    whole, cut = (leads(one, [x.hops.time_s for x in one], None, draw()) for one in kinds)
    assert [whole[lead]["approaches"] for lead in ("2", "3")] == [4, 4]
    assert [cut[lead]["approaches"] for lead in ("2", "3")] == [4, 0]
    assert cut["3"]["hazard_free"] == 0
    assert np.isnan(cut["3"]["auroc"])


def test_an_alarm_at_the_first_hop_is_an_onset_with_its_lead() -> None:
    trials = corner(2, 2, t0_s=8.0)
    always = [np.ones(81, bool) for _ in trials]
    row = alarm_row(trials, [always], draw())
    assert (row["onsets"], row["false_recordings"], row["advisory_share"]) == (2.0, 2.0, 1.0)
    assert row["lead_s"] == row["lasting_lead_s"] == pytest.approx(7.0)
    assert row["leads_beyond_5_s"] == [7.0, 7.0]
    assert row["text"] == "2 of 2 at 2 false onsets"
    # T0 is at 8.0 s and the last hop ends at 9.0 s: there are no hops from 2 s after T0 on.
    assert row["after_pass_share"] is None
    hours = 2 * 81 * 0.1 / 3600
    assert row["alarms_per_hour"] == pytest.approx(2 / hours)
    assert row["interval"][0] < 2 / hours < row["interval"][1]


def test_a_lasting_alarm_is_on_half_a_second_before_t0() -> None:
    trials = corner(2, 2)
    # Both begin 3 s before T0; the second alarm ends, and begins again too late.
    alarms = [before(trials[0], 3.0), before(trials[1], 3.0, 1.0) | before(trials[1], 0.3)]
    row = alarm_row(trials, [[*alarms, *(np.zeros(81, bool),) * 2]], draw())
    assert (row["count"], row["lasting_count"], row["onsets"]) == (2.0, 1.0, 0.0)
    assert row["lead_s"] == row["lead_s_missed_0"] == pytest.approx(3.0)
    assert row["lasting_lead_s"] == pytest.approx(1.5)
    again = before(trials[0], 3.0, 2.0) | before(trials[0], 1.0)
    row = alarm_row(trials, [[again, *(np.zeros(81, bool),) * 3]], draw())
    assert (row["lead_s"], row["lasting_lead_s"]) == (pytest.approx(3.0), pytest.approx(0.5))
    assert row["lead_s_missed_0"] == pytest.approx(1.5)


def test_passes_are_means_over_the_same_hours() -> None:
    trials = corner(2, 2)
    never, always = ([np.full(81, on) for _ in trials] for on in (False, True))
    row = alarm_row(trials, [never, always], draw())
    assert (row["warned"], row["onsets"], row["advisory_share"]) == (0.5, 1.0, 0.5)
    assert row["text"] == "1 of 2 at 1 false onset"


def test_a_row_of_the_curve_has_one_threshold() -> None:
    trials = corner(2, 8)
    # At 0.5 both are warned for one onset, at 0.3 both longer for two; at 0.9 one for none, late.
    scores = [np.where(before(one, 1.0), 0.5, np.where(before(one, 3.0), 0.3, 0.0)) for one in trials]
    scores[0][before(trials[0], 0.3)] = 0.9
    scores[2][10], scores[3][20:30] = 0.6, 0.3
    found = curve(trials, scores, "onsets", draw())
    assert [found[n]["threshold"] for n in ("0", "1", "3", "6")] == [0.9, 0.5, 0.3, 0.3]
    assert [found[n]["count"] for n in ("0", "1", "3")] == [1.0, 2.0, 2.0]
    assert [round(found[n]["lead_s_missed_0"], 2) for n in ("0", "1", "3")] == [0.15, 1.0, 3.0]
    by_recording = curve(trials, scores, "false_recordings", draw())
    assert [by_recording[n]["threshold"] for n in ("0", "1", "2", "3")] == [0.9, 0.5, 0.3, 0.3]


def test_the_sweep_counts_as_the_rows_do() -> None:
    rng, trials = draw(), corner()
    scores = [np.round(rng.random(81), 1) for _ in trials]
    swept = sweep(trials, scores)
    for i, level in enumerate(swept["level"]):
        row = alarm_row(trials, [[one >= level for one in scores]], rng)
        assert (row["onsets"], row["false_recordings"]) == (swept["onsets"][i], swept["false_recordings"][i])
        assert row["count"] == swept["warned"][i]
        assert row["lead_s_missed_0"] == pytest.approx(swept["lead_s"][i] / 4)


def test_chances_are_compared_with_the_side_of_the_vehicle() -> None:
    trials = corner(2, 2)

    def stated(trial, sure):
        within = np.zeros((81, 2, len(HORIZONS_S)))
        side = ("left", "right").index(trial.label) if not trial.hazard_free else 0
        within[:, side, HORIZONS_S.index(2.0)] = sure * before(trial, 2.0)
        return replace(trial, hops=trial.hops.replace(within=within))

    true = calibration([stated(one, 1.0) for one in trials], draw())
    assert (true["ece"], true["brier_skill"]) == (0.0, 1.0)
    # Before T0 at 5.0 s, from 1.0 s on: 40 hops per approach, 20 of them within 2 s; 81 without a hazard.
    assert true["base_rate"] == pytest.approx(2 * 20 / (2 * 2 * (40 + 81)))
    half = calibration([stated(one, 0.5) for one in trials], draw())
    assert half["ece"] == pytest.approx(0.5 * true["base_rate"])
    unknown = [replace(one, hops=one.hops.replace(within=np.full((81, 2, 4), np.nan))) for one in trials]
    assert calibration(unknown, draw())["ece"] is None


def test_the_tracker_accepts_boxes_by_its_filter() -> None:
    low = made_up("a", "left")
    boxes = low.boxes.replace(score=np.full(len(low.boxes), 0.4), box_px=low.boxes.box_px * [0, 0, 70, 70])
    trial = replace(low, boxes=boxes)
    usual, wide = OcSortRecovery("coasting"), OcSortRecovery("coasting", keep=NANODET_BOXES)
    assert usual.name == wide.name
    assert not usual.fit([], draw())(trial).alarm.any()
    assert wide.fit([], draw())(trial).alarm.any()


def test_the_command_scores_a_made_up_corner(tmp_path, capsys) -> None:
    folder = write_corner(tmp_path / "corner", draw())
    assert main(["sequences", str(folder), "--results", str(tmp_path / "results.json"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    found = report["seven"]
    assert found["recordings"] == 4
    assert found["failed"] == {}
    assert {"horizons", "risk"} <= set(found)
    assert {"world-state advisory", "Vision-only", "OC-SORT recovery (coasting)"} <= set(found["rows"])
    assert found["rows"]["Vision-only"]["warned"] == 0.0
    assert list(found["leads"]) == ["0.5", "1", "1.5", "2", "3", "5", "6"]
    assert list(found["at_onsets"]) == ["0", "1", "3", "6"]
    assert found["leads"]["2"]["approaches"] == 2
    assert found["leads"]["3"]["approaches"] == 0
    # A vehicle whose sound doubles each half second is separated from a quiet street.
    assert found["scores"]["loudness meter"]["leads"]["0.5"]["auroc"] == 1.0
    assert found["scores"]["window alone"]["leads"]["0.5"]["auroc"] == 1.0
    assert "sequences corner" in json.loads((tmp_path / "results.json").read_text())


def test_the_command_prints_tables_without_a_camera_and_start(tmp_path, capsys) -> None:
    folder = write_corner(tmp_path / "corner", draw())
    assert main(["sequences", str(folder), "--boxes", "none", "--start", "1"]) == 0
    printed = capsys.readouterr().out
    assert "seven: 2 approaches, 2 hazard-free recordings" in printed
    assert "risk, sound alone" in printed
    # In the remaining 3 s T0 is at 2 s: the first hop ends a second before.
    assert "0 + 0" in printed


@pytest.mark.parametrize(
    ("words", "hazard_free", "problem"),
    [
        (["--features", "a.csv"], 2, "--lists"),
        (["--model", "a.json"], 2, "--path"),
        (["--path", "seven", "--streams", "a.npz"], 2, "expected no --path"),
        (["--start", "9"], 2, "--start"),
        ([], 0, "found one kind"),
        ([], 2, "srp.npz"),
    ],
)
def test_unsuitable_options_and_recordings_are_rejected(tmp_path, capsys, words, hazard_free, problem):
    folder = write_corner(tmp_path / "corner", draw(), hazard_free=hazard_free)
    (folder / "srp.npz").unlink()
    assert main(["sequences", str(folder), *words]) == 2
    assert problem in capsys.readouterr().err


def test_figures_of_the_simulated_exam_are_printed_beside_the_same_real_figures(tmp_path) -> None:
    file = tmp_path / "exam.json"
    file.write_text(json.dumps({"auroc_1s_before": 0.98, "detected": 0.79, "onsets_per_hour": 6.0}))
    exam = simulated_exam(file)
    assert (exam["auroc_1"], exam["auroc_2"], exam["warned"]) == (0.98, None, 0.79)
    row = alarm_row(corner(2, 2), [[np.ones(81, bool)] * 4], draw())
    last = alarm_table({"ours": row}, "alarm", "alarms", exam).lines()[-1]
    assert "0.79" in last
    assert "6.00" in last


def test_the_card_of_the_shipped_model_has_the_figures_of_the_pages_and_a_board_only_a_note(
    tmp_path, capsys
) -> None:
    model = read_model()
    results = read_results(EVIDENCE / "results.json")
    assert with_real(model, results).provenance.real == model.provenance.real
    with (EVIDENCE / "figures.csv").open(encoding="utf-8") as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}

    def printed(name: str) -> float:
        return reduce(getitem, rows[name]["at"].split("/"), results[rows[name]["key"]]["figures"])

    own, warned, gap, _ = model.provenance.real
    assert own.real == printed("corner.on.alone.auroc.1") and warned.real == printed("corner.on.alone.warned")
    assert gap.real == printed("corner.pair.alone.1") and gap.simulated == printed("corner.exam.1s")
    assert [one.simulated for one in (own, warned)] == [
        model.provenance.exam[name] for name in ("auroc_1s_before", "detected")
    ]
    board, array = tmp_path / "board.json.gz", read_array("uma-8")
    domain = replace(model.domain, array=array.name, positions_m=array.positions_m)
    save_model(board, replace(model, signature=replace(model.signature, domain=domain)))
    words = ["card", str(board), "--real", str(EVIDENCE / "results.json"), "--out", str(board)]
    assert main(words) == 0
    assert read_model(board).provenance.real == model.provenance.real[2:]
    assert capsys.readouterr().out.count("no real recording of such an array and motion") == 2
    save_model(board, replace(model, provenance=replace(model.provenance, exam={})))
    assert main(words) == 2
    assert "expected those of an exam" in capsys.readouterr().err
