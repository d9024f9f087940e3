"""The sweep over camera states: its figures from known decisions, its files, its report, the command."""

import json

import numpy as np
import pytest

from worldstate.adapters.camera.degradation import LEVELS
from worldstate.cli.main import main
from worldstate.ground.errors import InvalidArgumentError
from worldstate.operations.recordings.hop_stream import ABSENT, PRESENT, UNQUERIED
from worldstate.operations.recordings.hop_table import HopTable
from worldstate.studies.degradation.degradation_report import sweep_report, sweep_table, write_sweep_figure
from worldstate.studies.degradation.degradation_sweep import SweepSettings, degradation_sweep
from worldstate.studies.degradation.degraded_detections import CLEAN, OFF, camera_states

PRIOR = (0.25,) * 4
HOPS, T0_S = 60, 4.0
STATES = (*map(str, camera_states()), OFF)
BETA = dict(zip(LEVELS, (0.05, 0.3, 0.6, 0.9, 1.0), strict=True))


def beta_of(state):
    return 1.0 if state == OFF else BETA[0.0 if state == CLEAN else float(state.split()[1])]


def staged(number, approach, rng, hearing=3.0):
    """A signature that is right most of the time, a camera that misses as its beta says."""
    time_s = 1.0 + 0.1 * np.arange(HOPS)
    hidden, visible = approach & (time_s > 2.0) & (time_s <= T0_S), approach & (time_s > T0_S)
    likelihoods = rng.normal(0.0, 0.7, (HOPS, 4))
    likelihoods[:, 3] += 0.5 * hearing * ~(hidden | visible)
    likelihoods[:, 0] += hearing * hidden
    likelihoods[:, 2] += hearing * visible
    beta = np.array([beta_of(state) for state in STATES])[:, None]
    off = np.array([state == OFF for state in STATES])[:, None]
    seen = (rng.random((len(STATES), HOPS)) >= beta) & visible & ~off
    heard = np.logaddexp.reduce(likelihoods[:, :3], axis=1) - likelihoods[:, 3]
    whole = HopTable(
        {"time_s": time_s, "there": visible, "log_likelihoods": likelihoods},
        f"r{number}", "left" if approach else "none", T0_S if approach else float("nan"),
    )  # fmt: skip
    answer = np.where(off, UNQUERIED, np.where(seen, PRESENT, ABSENT))
    by_state = zip(STATES, answer, beta[:, 0], seen, strict=True)
    return {
        state: whole.replace(
            answer=answered,
            miss_rate=np.full(HOPS, np.clip(missed, 0.02, 0.98)),
            clutter_rate=np.full(HOPS, 0.01),
            seen=there,
            found=there,
            degradation=np.full(HOPS, missed),
            presence=1.0 / (1.0 + np.exp(-heard)),
        )
        for state, answered, missed, there in by_state
    }


def changed(one, **columns):
    """The same recording with other columns in every state."""
    return {state: table.replace(**columns) for state, table in one.items()}


@pytest.fixture(scope="module")
def corpus():
    rng = np.random.default_rng(5)
    return [staged(i, i % 2 == 0, rng) for i in range(24)]


@pytest.fixture(scope="module")
def rows(corpus):
    return degradation_sweep(corpus, SweepSettings(PRIOR), np.random.default_rng(0))


def test_vision_alone_decays_as_one_minus_beta_and_awareness_does_not(rows):
    by_state = {row.state: row for row in rows}
    assert list(by_state) == list(STATES)
    for state, row in by_state.items():
        assert row.vision_only == pytest.approx(1.0 - beta_of(state), abs=0.06)
        assert row.awareness >= row.vision_only
        assert row.awareness_interval[0] <= row.awareness <= row.awareness_interval[1]
    assert by_state["noise 1"].vision_only == 0.0
    assert by_state["noise 1"].awareness == pytest.approx(by_state[OFF].awareness)
    assert by_state["noise 1"].awareness > 0.6


def test_awareness_is_counted_as_it_is_defined(corpus):
    """Against loops over the hops, with thresholds that nothing and everything passes."""
    for level, heard in ((2.0, False), (-1.0, True)):
        bent = [
            changed(one, presence=np.full(HOPS, 0.5 if one[OFF].hazard_free else level)) for one in corpus
        ]
        for row in degradation_sweep(bent, SweepSettings(PRIOR), np.random.default_rng(0)):
            aware = hops = 0
            for one in (bent_one[row.state] for bent_one in bent):
                for i, time_s in enumerate(one.time_s):
                    if not one.hazard_free and time_s > one.t0_s + 1e-6 and one.there[i]:
                        hops += 1
                        aware += bool(one.seen[i] or not heard)
            assert row.awareness == pytest.approx(aware / hops)


def test_false_alarms_keep_the_budget_of_the_clean_camera(rows, corpus):
    """The statistic falls as absence says less, and a detector without clutter adds no awareness."""
    report = sweep_report(rows)
    clean = next(row for row in rows if row.state == CLEAN)
    assert all(row.false_alarms_per_hour <= clean.false_alarms_per_hour + 1e-9 for row in rows)
    hours = sum(one[CLEAN].hazard_free for one in corpus) * HOPS * 0.1 / 3600.0
    assert clean.false_awareness_per_hour * hours <= clean.false_awareness * 12 * HOPS + 1e-9
    assert clean.false_awareness <= 0.06
    assert report["largest_ratio_of_false_awareness_per_hour"] == pytest.approx(1.0)


def test_false_detections_are_false_awareness(corpus):
    raving = [
        {state: table.replace(seen=table.seen | (np.arange(HOPS) % 2 == 0)) for state, table in one.items()}
        for one in corpus
    ]
    row = degradation_sweep(raving, SweepSettings(PRIOR), np.random.default_rng(0))[0]
    assert row.false_awareness_per_hour > 10_000
    assert row.false_awareness == pytest.approx(0.5, abs=0.05)


def test_report_table_and_figure(rows, tmp_path):
    report = json.loads(json.dumps(sweep_report(rows), allow_nan=False))
    assert report["least_vision_only"] == 0.0
    assert report["least_awareness"] == min(
        row["awareness"] for row in report["states"] if row["state"] != OFF
    )
    assert [line.split()[0] for line in sweep_table(rows).splitlines()][1:3] == ["clean", "blur"]
    write_sweep_figure(rows, tmp_path / "sweep.png")
    assert (tmp_path / "sweep.png").read_bytes()[:4] == b"\x89PNG"


def test_a_detection_of_something_else_is_no_awareness_of_the_vehicle(corpus):
    raving = [changed(one, seen=np.ones(HOPS, bool)) for one in corpus]
    before = degradation_sweep(corpus, SweepSettings(PRIOR), np.random.default_rng(0))
    after = degradation_sweep(raving, SweepSettings(PRIOR), np.random.default_rng(0))
    assert [row.vision_only for row in after] == [row.vision_only for row in before]
    assert [row.awareness for row in after] == [row.awareness for row in before]
    assert {row.any_detection for row in after} == {row.false_awareness for row in after} == {1.0}


def test_what_does_not_fit_is_refused(corpus):
    with pytest.raises(InvalidArgumentError, match="states"):
        degradation_sweep([], SweepSettings(PRIOR), np.random.default_rng(0))
    free = [one for one in corpus if one[CLEAN].hazard_free]
    with pytest.raises(InvalidArgumentError, match="view"):
        degradation_sweep(free, SweepSettings(PRIOR), np.random.default_rng(0))
    one_free = [one for one in corpus if not one[CLEAN].hazard_free] + free[:1]
    with pytest.raises(InvalidArgumentError, match="hazard-free"):
        degradation_sweep(one_free, SweepSettings(PRIOR), np.random.default_rng(0))
    with pytest.raises(InvalidArgumentError, match="states"):
        degradation_sweep(
            [corpus[0], {CLEAN: corpus[1][CLEAN]}], SweepSettings(PRIOR), np.random.default_rng(0)
        )
    with pytest.raises(InvalidArgumentError, match="presence"):
        corpus[0][CLEAN].replace(presence=np.zeros(3))


def test_missing_miss_rates_are_one_line(tmp_path, capsys):
    assert main(["evaluate-degradation", str(tmp_path), "--miss-rates", str(tmp_path / "beta.json")]) == 2
    assert "beta.json" in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_end_to_end_and_again_from_what_it_kept(tmp_path, capsys):
    """Two approaches and two empty streets, short; the second run stages nothing."""
    sim, out = tmp_path / "sim", tmp_path / "sweep"
    assert main(["simulate", "--out", str(sim), "--static", "4", "--duration", "3", "--video"]) == 0
    beta = tmp_path / "beta.json"
    assert main(["measure-absence", str(sim), "--out", str(beta)]) == 0
    command = ["evaluate-degradation", str(sim), "--miss-rates", str(beta), "--out", str(out), "--json"]
    command += ["--jobs", "2"]
    capsys.readouterr()
    assert main(command) == 0
    first = json.loads(capsys.readouterr().out)
    kept = {path: path.stat().st_mtime_ns for path in (out / "staged").iterdir()}
    assert len(kept) == 4
    assert main(command) == 0
    assert json.loads(capsys.readouterr().out) == first
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert [row["state"] for row in first["states"]] == list(STATES)
    assert first["clean_vision_only"] > 0.5
    assert first["least_vision_only"] <= 0.05
    assert json.loads((out / "degradation.json").read_text()) == first
    assert (out / "degradation.png").is_file()
