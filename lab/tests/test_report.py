"""The report: complete files, external text never as markup, the paper's numbers beside ours."""

import csv
import io
import math
import re
from argparse import Namespace
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_evaluation import HOPS, approach, calm
from worldstate_lab.cli.main import keep_results, main, read_results, result_key
from worldstate_lab.degradation.awareness import Awareness, AwarenessRow, CommonCause, Estimate
from worldstate_lab.degradation.beta_curves import Band, BetaCurves
from worldstate_lab.degradation.conditions import CLEAN, FAMILIES, Condition
from worldstate_lab.degradation.degradation_study import DegradationSettings, DegradationStudy, DetectorSweep
from worldstate_lab.evaluation.evaluation import Evaluation, EvaluationSettings
from worldstate_lab.evaluation.figures import PAPER_VALUES, paper_value
from worldstate_lab.evaluation.front_end_study import front_end_study
from worldstate_lab.evaluation.protocols import DYNAMIC, FIXED, RETRAINED, STATIC, ProtocolRun
from worldstate_lab.evaluation.report.approach_panel import approach_figure
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
from worldstate_lab.trials.trial import Decisions, Take, TakeList, Trial

from worldstate.ground.errors import InputFileError
from worldstate.operations.metrics.approach_table import auroc
from worldstate.operations.recordings.hop_table import HopTable

HOSTILE = '<script src="http://x/y.js">a|b</script> `*_\n| "q" & [t](http://x)'


def plot(canvas):
    canvas.subplots().plot([0, 1], [1, 0])


def small_document(text, draw=plot):
    table = Table("t", text, (text, "v"), ((text, Value(0.5, 0.4, 0.6, note=text, paper=Value(1.0))),), text)
    figure = Figure("f", text, text, draw, ("x", text), [(0.1, text)])
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


def test_a_failed_picture_leaves_the_last_report_unchanged(tmp_path):
    write_document(small_document("first"), tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    def fail(canvas):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        write_document(small_document("second", fail), tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert sorted(path.name for path in tmp_path.rglob("*")) == [
        "f.csv", "f.png", "report.md", "report_files", "t.csv",
    ]  # fmt: skip


def test_a_file_of_the_user_is_not_mistaken_for_an_old_report(tmp_path):
    (tmp_path / "report_files").write_text("mine")
    with pytest.raises(InputFileError, match="earlier report"):
        write_document(small_document("x"), tmp_path)
    assert (tmp_path / "report_files").read_text() == "mine"


def test_numbers_of_the_paper_agree_with_each_other():
    def of(row, figure, group="static"):
        return paper_value(group, row, figure).value

    rate, sustained = (of(row, "false_alarms_per_hour") for row in ("proposed .02", "published, sustained"))
    assert 1.0 - rate / sustained == pytest.approx(
        of("against the sustained rule", "fewer_false_alarms"), abs=0.005
    )
    assert 1.0 / of("proposed .02", "hazard_free_hours") == pytest.approx(9.7, abs=0.05)
    # Onsets are whole numbers: every rate of the static set is a multiple of the quantum, up to rounding.
    for one in PAPER_VALUES:
        if one.figure == "false_alarms_per_hour" and one.group == "static":
            onsets = one.value * of("proposed .02", "hazard_free_hours")
            assert onsets == pytest.approx(round(onsets), abs=0.06), one
    assert of("proposed .02", "detection") * 42 == pytest.approx(37, abs=0.05)
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


def run_of(protocol, trials):
    """Return the result of `run_protocol` without a classifier: the trials already contain its posteriors."""
    said = {method.name: {} for method in METHODS}
    for calibration, tested in protocol.parts(trials, np.random.default_rng(0)):
        for method in METHODS:
            decide = method.fit([trials[i] for i in calibration], np.random.default_rng(0))
            said[method.name] |= {i: decide(trials[i]) for i in tested}
    passes = {name: (tuple(one[i] for i in range(len(trials))),) for name, one in said.items()}
    return ProtocolRun(protocol, tuple(trials), passes, (0,), "all")


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory):
    rng, burst = np.random.default_rng(0), tuple(range(20, 27))
    made = [(f"{i}", approach(i, rng, lead_s=2.0)) for i in range(8)]
    made += [(f"none{i}", calm(i, rng, false_alarms=burst if i % 3 else ())) for i in range(8)]
    trials = [
        replace(
            one, hops=one.hops.replace(name=name, about={**one.hops.about, "site": ("SA1", "SB1")[i % 2]})
        )
        for i, (name, one) in enumerate(made)
    ]
    root = tmp_path_factory.mktemp("streets")
    takes = TakeList(root, tuple(Take(root / t.name, t.name, t.site, t.label) for t in trials), (), (), False)
    runs = {one.name: run_of(one, trials) for one in (STATIC, FIXED)}
    scores = {
        name: {m: Score.of(run.trials, p) for m, p in run.decisions.items()} for name, run in runs.items()
    }
    rng = np.random.default_rng(0)
    draws = {
        name: stratified_draws([(t.label, t.site) for t in run.trials], rng, 50) for name, run in runs.items()
    }
    lacking = {one.name: "needs more" for one in (DYNAMIC, RETRAINED)}
    study = front_end_study(trials, rng, 20)
    return Evaluation(
        takes, tuple(trials), (), lacking, runs, scores, draws, study, None, EvaluationSettings(draws=50)
    )


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
    assert {"table_i", "equal_detection", "calibration", "protocol_junctions_fixed"} <= {
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


def test_the_boxes_of_one_image_are_counted_at_its_hop():
    times = 1.0 + 0.1 * np.arange(20)
    boxes = HopTable({"time_s": np.array([0.5, 2.0, 2.01]), "moving": np.ones(3, bool)})
    said = Decisions.of(times, times > 1.5, score=np.linspace(0, 1, 20), threshold=np.array([0.5]))
    figure = approach_figure("a", Trial(HopTable({"time_s": times}, "a", "left", 1.9), boxes), said, ())
    # The boxes of one image are counted at its hop, each once.
    assert sum(row[3] for row in figure.rows) == 2


def degradation(detectors):
    """Return a sweep in which beta is 0.1 per level and awareness is 0.98 minus 0.01 per level."""
    shape = (len(FAMILIES), 5)
    overall = np.broadcast_to(0.05 + 0.1 * np.arange(5), shape)
    wide = np.broadcast_to(overall[:, None], (shape[0], 3, shape[1]))
    by_azimuth = wide + np.array([0.0, 0.01, 0.02])[:, None]
    conditions = [Condition(CLEAN), *(Condition(f, level) for f in FAMILIES for level in range(1, 5))]
    rows = tuple(
        AwarenessRow(
            one, one.degradation, 0.1, Estimate(0.95 - 0.1 * one.level, 0.4, 1.0), 0.9,
            Estimate(0.98 - 0.01 * one.level, 0.9, 1.0), None, 0.8, None,
            Estimate(10.0, 1.0, 40.0), Estimate(10.0, 1.0, 40.0), 0.1,
        )
        for one in conditions
    )  # fmt: skip
    half = Estimate(0.5, 0.4, 0.6)
    sweeps = tuple(
        DetectorSweep(
            name,
            BetaCurves(
                (0.0, 10.0, 20.0, 36.0), np.full(by_azimuth.shape, 30.0), Band(*[by_azimuth] * 3),
                Band(*[overall] * 3), (),
            ),
            Awareness(rows, (CommonCause(1, 6.0, half, half, half, half, half),), 100, 0.03),
        )
        for name in detectors
    )  # fmt: skip
    return DegradationStudy(sweeps, ("a", "b"), ("c", "d"), {}, (), DegradationSettings())


@pytest.mark.long
def test_every_detector_of_a_sweep_gets_panels_and_tables_of_its_own(evaluation, tmp_path):
    document = evaluation_document(replace(evaluation, degradation=degradation(("first", "<b>second"))))
    names = [block.name for block in document.blocks]
    assert len(set(names)) == len(names)
    assert {"cueing_awareness_1", "cueing_awareness_2", "degradation_2", "rain_2"} <= set(names)
    paper = {row[2]: row[3:6] for block in document.blocks if block.name == "paper" for row in block.rows}
    least, _, found = paper["after line-of-sight entry: least hazard awareness"]
    assert (least.value, found.value) == (0.87, pytest.approx(0.94))
    _, _, found = paper["miss rate of the camera: clean, 20 to 30 deg"]
    assert found.value == pytest.approx(0.07)
    (panel,) = (block for block in document.blocks if block.name == "cueing_awareness_1")
    (worst,) = ((row[2], row[3].value) for row in panel.rows if row[0] == "blur" and row[1] == 4)
    assert worst == pytest.approx((0.45, 0.94))
    write_document(document, tmp_path)
    assert "<b>second" not in (tmp_path / "report.md").read_text(encoding="utf-8")


def test_results_are_merged_by_the_arguments_that_change_a_figure(tmp_path, capsys):
    path = tmp_path / "results.json"
    for words in (["bench", "--seed", "3"], ["bench", "--seed", "3", "--jobs", "2"], ["bench", "--smoke"]):
        given = Namespace(seed=3, smoke="--smoke" in words)
        keep_results(path, words, given, {"beta": np.array([0.1, np.nan])})
    found = read_results(path)
    assert {key: one["smoke"] for key, one in found.items()} == {
        "bench --seed 3": False,
        "bench --smoke": True,
    }
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
