"""The command `table` and its report: complete files, no foreign markup, the paper's numbers beside ours."""

import csv
import io
import math
import re
import shutil
import time
from argparse import Namespace
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_evaluation import HOPS, approach, calm
from test_hazard_awareness import RISING, counts, judged, staged
from worldstate_lab.cli.main import keep_results, main, read_results, result_key
from worldstate_lab.degradation.beta_curves import beta_curves
from worldstate_lab.degradation.degradation_study import DegradationSettings, DegradationStudy, DetectorSweep
from worldstate_lab.evaluation.evaluation import Evaluation, EvaluationSettings
from worldstate_lab.evaluation.figures import PAPER_VALUES, paper_value
from worldstate_lab.evaluation.front_end_study import front_end_study
from worldstate_lab.evaluation.protocols import DYNAMIC, FIXED, RETRAINED, STATIC, run_protocol
from worldstate_lab.evaluation.report.contents import evaluation_document
from worldstate_lab.evaluation.report.panels import roc_curve
from worldstate_lab.evaluation.scores import Score
from worldstate_lab.methods.acoustic_rules import CalibratedCue, PublishedRule
from worldstate_lab.methods.line_of_sight import VisionOnly
from worldstate_lab.metrics.intervals import stratified_draws
from worldstate_lab.report.table import (
    Document,
    Figure,
    Section,
    Table,
    Value,
    csv_text,
    markdown_page,
    write_document,
)
from worldstate_lab.trials.trial import Take, TakeList

from worldstate.operations.metrics.approach_table import auroc

HOSTILE = '<script src="http://x/y.js">a|b</script> `*_\n| "q" & [t](http://x)'


def plot(canvas):
    canvas.subplots().plot([0, 1], [1, 0])


def small_document(text):
    table = Table("t", text, (text, "v"), ((text, Value(0.5, 0.4, 0.6, note=text, paper=Value(1.0))),), text)
    figure = Figure("f", text, text, plot, ("x", text), [(0.1, text)])
    return Document(text, text, (Section(text, (text,), (table, figure)),), ((text, text),))


def test_external_text_is_never_markup():
    text = markdown_page(small_document(HOSTILE), "report_files")
    rows = [line for line in text.splitlines() if line.startswith("|")]
    # A bar or a line break in a name would change the number of cells.
    assert {line.replace("\\|", "").count("|") for line in rows} == {3}
    assert "<script" not in text
    assert "\\[t](http" in text


@settings(max_examples=30)
@given(st.lists(st.tuples(st.text(max_size=8), st.floats(-1e6, 1e6)), min_size=1, max_size=5))
def test_csv_preserves_every_number_to_the_last_bit(rows):
    table = Table("t", "", ("name", "x"), tuple((name, Value(x, x - 1.0)) for name, x in rows))
    read = list(csv.reader(io.StringIO(csv_text(table.columns, table.rows), newline="")))
    assert read[0] == ["name", "x value", "x low"]
    assert [(float(a), float(b)) for _, a, b in read[1:]] == [(x, x - 1.0) for _, x in rows]


def test_a_missing_value_has_a_reason_and_minus_zero_is_never_printed():
    assert Value(math.nan, note="states none").text == "states none"
    assert Value(-0.001, -0.004, 0.1).text == "0.00 [0.00, 0.10]"
    assert Value(1.0, math.nan, 2.0).text == "1.00"


def test_rates_of_the_paper_are_whole_numbers_of_onsets_in_its_hours():
    hours = paper_value("static", "proposed .02", "hazard_free_hours").value
    rates = [one for one in PAPER_VALUES if (one.figure, one.group) == ("false_alarms_per_hour", "static")]
    for one in rates:
        assert one.value * hours == pytest.approx(round(one.value * hours), abs=0.06), one
    assert len({(one.group, one.row, one.figure) for one in PAPER_VALUES}) == len(PAPER_VALUES)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_area_under_the_drawn_curve_is_the_auroc(seed):
    rng = np.random.default_rng(seed)
    # Rounded, so that scores tie.
    high, low = rng.normal(1.0, 1.0, 30).round(1), rng.normal(0.0, 1.0, 40).round(1)
    area = auroc(np.concatenate([high, low]), np.arange(70) < 30)
    assert np.trapezoid(*roc_curve(high, low)[::-1]) == pytest.approx(area)


METHODS = (
    VisionOnly(),
    PublishedRule("published"),
    PublishedRule("published, sustained", sustained=True),
    *(CalibratedCue(f"proposed {text}", float(text)) for text in (".01", ".02", ".05")),
)


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory):
    rng, burst = np.random.default_rng(0), tuple(range(20, 27))
    made = [(f"{i}", approach(i, rng, lead_s=2.0)) for i in range(8)]
    made += [(f"none{i}", calm(i, rng, false_alarms=burst if i % 3 else ())) for i in range(8)]
    trials = []
    for i, (name, one) in enumerate(made):
        about = {**one.hops.about, "site": ("SA1", "SB1")[i % 2]}
        trials.append(replace(one, hops=one.hops.replace(name=name, about=about)))
    root = tmp_path_factory.mktemp("streets")
    takes = TakeList(root, tuple(Take(root / t.name, t.name, t.site, t.label) for t in trials), (), (), False)
    draws = stratified_draws([(t.label, t.site) for t in trials], rng, 50)
    runs, scores = {}, {}
    for one in (STATIC, FIXED):
        run = runs[one.name] = run_protocol(one, trials, METHODS, None, (0,))
        scores[one.name] = {name: Score.of(trials, passes) for name, passes in run.decisions.items()}
    lacking = {one.name: "needs more" for one in (DYNAMIC, RETRAINED)}
    return Evaluation(
        takes, tuple(trials), (), lacking, runs, scores, dict.fromkeys(runs, draws),
        front_end_study(trials, rng, 20), None, EvaluationSettings(draws=50),
    )  # fmt: skip


@pytest.mark.long
def test_the_report_contains_every_number_of_the_paper_with_the_measured_one(evaluation, tmp_path):
    document = evaluation_document(evaluation, configuration=(("--seed", "7"),))
    blocks = {block.name: block for block in document.blocks}
    assert ("--seed", "7") in document.facts
    assert len(blocks) == len(document.blocks), "two blocks would share a file"
    assert len(blocks["paper"].rows) == len(PAPER_VALUES)
    row = next(row for row in blocks["table_i"].rows if row[0] == "proposed .02")
    cells = dict(zip(blocks["table_i"].columns, row, strict=True))
    figures = evaluation.scores["static"]["proposed .02"].figures()
    detected = cells["detected (share)"]
    assert (detected.value, detected.paper.value) == (figures["detection"], 0.881)
    assert detected.low <= detected.value <= detected.high
    rate = cells["false alarms (1/h)"]
    assert (rate.low, rate.high) == evaluation.scores["static"]["proposed .02"].poisson()
    bounds = [
        (here, paper) for _, group, _, paper, _, here, _ in blocks["paper"].rows if group == "array bounds"
    ]
    assert len(bounds) == 7
    for here, paper in bounds:
        assert here.value == pytest.approx(paper.value, rel=0.025), "the bounds need no sound"
    write_document(document, tmp_path)
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    linked = re.findall(r"\]\((.*?)\)", text)
    assert set(linked) == {f"report_files/{path.name}" for path in (tmp_path / "report_files").iterdir()}
    assert "not run: needs more" in text


def test_every_table_states_its_data_and_every_mean_its_worst_junction(evaluation, tmp_path):
    blocks = {block.name: block for block in evaluation_document(evaluation).blocks}
    hours = 8 * HOPS * 0.1 / 3600.0
    told = f"16 recordings: 8 approaches and 8 hazard-free, {hours:.3f} h."
    assert {"table_i", "calibration", "protocol_junctions_fixed"} <= {
        name for name, block in blocks.items() if block.caption.startswith(told)
    }
    assert {row[2] for row in blocks["junctions"].rows} == {"8"}
    table = blocks["table_i"]
    row = next(row for row in table.rows if row[0] == "proposed .02")
    sites = evaluation.scores["static"]["proposed .02"].by_site()
    rate = dict(zip(table.columns, row, strict=True))["false alarms (1/h)"]
    worst = max(sites, key=lambda site: sites[site]["false_alarms_per_hour"])
    assert rate.note == f"worst {worst} {sites[worst]['false_alarms_per_hour']:.0f}"
    assert rate.note in csv_text(table.columns, table.rows)
    fewer = next(row for row in blocks["paper"].rows if row[2].endswith("false alarms saved"))[5]
    assert fewer.low <= fewer.value <= fewer.high


@pytest.mark.long
def test_a_model_outside_its_domain_has_rows_without_numbers(evaluation, tmp_path):
    why = "<b>: not the array of the model"
    refused = {"static": {"shipped model": why, "shipped scores .02": why}}
    document = evaluation_document(replace(evaluation, refused=refused))
    blocks = {block.name: block for block in document.blocks}
    for name, method in (("table_i", "shipped model"), ("table_i", "shipped scores .02")):
        (cells,) = (row[1:] for row in blocks[name].rows if row[0] == method)
        assert cells[0].number == "not scored: the model was not made for this sound"
        assert cells[1:] == (None,) * (len(cells) - 1)
        assert blocks[name].caption.endswith(f"Not scored: {why}.")
    assert not any(row[0] == "shipped model" for row in blocks["calibration"].rows)
    write_document(document, tmp_path)
    assert "&lt;b>: not the array of the model" in (tmp_path / "report.md").read_text("utf-8")


@pytest.mark.long
def test_every_detector_of_a_sweep_gets_panels_and_tables_of_its_own(evaluation, tmp_path):
    rng = np.random.default_rng(0)
    found = judged([staged(i, i % 2 == 0, rng) for i in range(12)])
    curves = beta_curves([counts(RISING)] * 3, stratified_draws([0] * 3, rng))
    sweeps = tuple(DetectorSweep(name, curves, found) for name in ("first", "<b>second"))
    study = DegradationStudy(sweeps, ("a", "b"), ("c", "d"), {}, (), DegradationSettings())
    document = evaluation_document(replace(evaluation, degradation=study))
    blocks = {block.name: block for block in document.blocks}
    assert len(blocks) == len(document.blocks)
    assert {"cueing_awareness_1", "cueing_awareness_2", "degradation_2", "rain_2"} <= set(blocks)
    paper = {row[2]: row[3:6] for row in blocks["paper"].rows}
    least, _, ours = paper["after line-of-sight entry: least hazard awareness"]
    assert (least.value, ours.value) == (0.87, sweeps[0].least_awareness.awareness.value)
    assert paper["miss rate of the camera: clean, 20 to 30 deg"][2].value == pytest.approx(RISING[2][0] / 40)
    write_document(document, tmp_path)
    assert "<b>second" not in (tmp_path / "report.md").read_text(encoding="utf-8")


def test_results_are_merged_by_the_arguments_that_change_a_figure(tmp_path, capsys):
    path = tmp_path / "results.json"
    for words in (["bench", "--seed", "3"], ["bench", "--seed", "3", "--jobs", "2"], ["bench", "--smoke"]):
        given = Namespace(seed=3, smoke="--smoke" in words)
        keep_results(path, words, given, {"beta": np.array([0.1, np.nan])})
    found = read_results(path)
    assert [*found] == ["bench --seed 3", "bench --smoke"] and found["bench --smoke"]["smoke"]
    assert found["bench --seed 3"]["figures"] == {"beta": [0.1, None]}
    assert found["bench --seed 3"]["seeds"] == [3] and "commit" in found["bench --seed 3"]
    for name in ("a.npz", "b.npz"):
        (tmp_path / name).touch()
    both = [f"{tmp_path}/a.npz", f"{tmp_path}/b.npz"]
    assert result_key(["streams", *both]) == f"streams {tmp_path.name}/*.npz"
    assert result_key(["streams", both[0], "--set-on", both[1]]) == "streams a.npz --set-on b.npz"
    path.write_text("{")
    assert main(["place", "none.csv", "--results", str(path)]) == 2
    assert "results of worldstate-lab: expected JSON" in capsys.readouterr().err


BLIND = "Vision-only", "Radar field-of-view model", "OC-SORT recovery (stock)"
TABLE_ONE = {
    *("OC-SORT recovery (coasting)", "published", "published, sustained", "proposed .01", "proposed .02"),
    *("proposed .05", "proposed .02 + looming", "with absence .02", "shipped model", "+ site adaptation"),
    "world-state advisory",
}


def test_every_row_of_the_table_is_there(smoke):
    _, report = smoke
    rows = report["protocols"]["static"]
    assert {*BLIND, *TABLE_ONE} <= set(rows)
    # Methods that need a line of sight have no alarm before T0.
    assert [rows[name]["detection"] for name in BLIND] == [0.0, 0.0, 0.0]
    assert set(report["protocols"]) == {"static", "junctions_fixed", "junctions_retrained"}
    assert "dynamic" in report["lacking"] and "moving ego" in report["lacking"]["dynamic"]
    assert "SIMULATED" in report["data"]
    # Two recordings of either kind are too few, and the report states this.
    assert len(report["cautions"]["static"]) == 2


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
