"""From decisions to figures: closed-form cases, independent formulas, and laws of the bootstrap."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_trials import alarmed, made_up, random_answer, random_study, tracked
from scipy.stats import chi2
from sklearn.metrics import brier_score_loss, roc_auc_score
from worldstate_lab.evaluation.scores import BASELINE, DETECTED, OURS, Score, equal_detection
from worldstate_lab.metrics.intervals import calibration_error_sampling, stratified_draws
from worldstate_lab.metrics.track_measures import gated_median_deg
from worldstate_lab.trials.trial import TRUTH_COLUMNS, Trial

from worldstate.abduction.cueing.risk_map import expected_calibration_error
from worldstate.ground.errors import InvalidArgumentError
from worldstate.operations.recordings.hop_table import HopTable


def close(ours, theirs):
    assert ours.keys() == theirs.keys()
    for name in ours:
        np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-9, atol=1e-12, err_msg=name)


def windows(trials, answers, column, horizon_s=np.inf):
    """Return values and labels of all scored windows, collected by a simple loop."""
    values, labels = [], []
    for trial, said in zip(trials, answers, strict=True):
        left_s = trial.t0_s - trial.hops.time_s
        used = np.full(len(left_s), True)
        if not trial.hazard_free:
            used = (left_s > -1e-6) & (left_s < horizon_s + 1e-6)
        values.append(getattr(said, column)[used])
        labels.append(np.full(used.sum(), not trial.hazard_free))
    return np.concatenate(values), np.concatenate(labels)


def test_figures_of_known_alarms():
    trials = [made_up("a", "left", t0_s=7.0), made_up("b", "right", t0_s=7.0), made_up("c"), made_up("d")]
    left = np.ones(81, int)
    answers = [
        # 5.5 s and 1.7 s before T0, and once after it.
        alarmed(trials[0], [(1.5, 1.8), (5.3, 5.6), (7.4, 7.6)], side=left),
        alarmed(trials[1], [(7.1, 8.0)], side=left),
        alarmed(trials[2], [(2.0, 2.9), (4.0, 4.1)]),
        alarmed(trials[3], []),
    ]
    figures = Score.of(trials, [answers]).figures()
    hours = 162 * 0.1 / 3600
    expected = {
        "detection": 0.5,
        "lead_s": 1.7,
        "lead_missed_zero_s": 0.85,
        "early_onsets_per_approach": 0.5,
        "false_onsets": 2.0,
        "hazard_free_hours": hours,
        "quantum_per_hour": 1 / hours,
        "false_alarms_per_hour": 2 / hours,
        "advisory_share": 10 / 162,
        "side_correct": 1.0,
        # Two onsets in the 2 x 6 s before T0, of which the last 5 s count.
        "random_detection": 1 - (7 / 12) ** 2,
        # Every hop in view has its box.
        "hazard_awareness": 1.0,
    }
    for name, value in expected.items():
        assert figures[name] == pytest.approx(value), name


def test_the_hop_at_t0_and_the_one_five_seconds_before_it():
    # 0.1 is not exact in binary: the hop that ends at T0 = 6.3 s must not count as a lead of 1e-15 s.
    trials = [made_up("a", "left", t0_s=0.1 * 63), made_up("b", "left", t0_s=0.1 * 63), made_up("c")]
    answers = [alarmed(trials[0], [(6.3, 7.0)]), alarmed(trials[1], [(1.3, 1.5)]), alarmed(trials[2], [])]
    score = Score.of(trials, [answers])
    assert score.figures(np.array([0]))["detection"] == 0.0
    assert score.figures(np.array([1]))["lead_s"] == pytest.approx(5.0)


def test_stamps_half_a_sample_off_change_nothing():
    # At 47,998 Hz a window ends up to 10 us from its nominal time, before or after T0.
    rng = np.random.default_rng(10)
    trials, (answers,) = random_study(rng)
    shifted, said = [], []
    for trial, answer in zip(trials, answers, strict=True):
        time_s = trial.hops.time_s + rng.uniform(-1e-5, 1e-5, len(trial.hops))
        shifted.append(replace(trial, hops=trial.hops.replace(time_s=time_s)))
        said.append(replace(answer, time_s=time_s))
    figures, expected = Score.of(shifted, [said]).figures(), Score.of(trials, [answers]).figures()
    for name, value in expected.items():
        assert figures[name] == pytest.approx(value, abs=1e-4, nan_ok=True), name


def test_awareness_counts_alarms_and_boxes():
    trial = made_up("a", "left", t0_s=5.0)
    blind = replace(trial, boxes=made_up("b").boxes)
    calm = made_up("c")
    for one, spans, expected in [(trial, [], 1.0), (blind, [], 0.0), (blind, [(5.3, 5.6)], 0.3)]:
        figures = Score.of([one, calm], [[alarmed(one, spans), alarmed(calm, [])]]).figures()
        assert figures["hazard_awareness"] == pytest.approx(expected)


def test_figures_of_windows_are_those_of_other_formulas():
    trials, (answers,) = random_study(np.random.default_rng(1))
    score = Score.of(trials, [answers])
    figures = score.figures()
    for name, horizon_s in {"all": np.inf, "2s": 2.0, "1s": 1.0}.items():
        values, labels = windows(trials, answers, "score", horizon_s)
        assert figures[f"auroc_{name}"] == pytest.approx(roc_auc_score(labels, values))
    risk, labels = windows(trials, answers, "risk")
    raw, _ = windows(trials, answers, "score")
    assert figures["ece"] == pytest.approx(expected_calibration_error(risk, labels))
    assert figures["ece_raw"] == pytest.approx(expected_calibration_error(raw, labels))
    assert figures["hazard_share"] == pytest.approx(labels.mean())
    skill = 1 - brier_score_loss(labels, risk) / brier_score_loss(labels, np.full(len(labels), labels.mean()))
    assert figures["brier_skill"] == pytest.approx(skill)
    floor = calibration_error_sampling(risk, np.random.default_rng(0))[0]
    assert figures["ece_floor"] == pytest.approx(floor, rel=0.03)
    pairs = [
        (said.bearing_rad[use] - 0.3, trial.hops.prominence[use])
        for trial, said in zip(trials, answers, strict=True)
        for use in [np.isfinite(trial.hops.reference_rad)]
    ]
    error, prominence = map(np.concatenate, zip(*pairs, strict=True))
    assert figures["bearing_deg"] == pytest.approx(np.degrees(np.median(np.abs(error))))
    checks = HopTable({"prominence": prominence, "error_rad": error})
    assert figures["bearing_gated_deg"] == pytest.approx(gated_median_deg(checks))


def test_gospa_of_a_late_track_is_its_misses_and_its_errors():
    # In view for ten hops, tracked with an error of 5 degrees from the third on.
    trial, calm = made_up("a", "left"), made_up("c")
    seen = np.flatnonzero(np.isfinite(trial.hops.reference_rad))
    there = np.zeros(81, bool)
    there[seen[2:]] = True
    tracks = tracked(trial, there, np.zeros(81, int), np.full(81, 0.3 + np.radians(5.0)))
    figures = Score.of([trial, calm], [[alarmed(trial, [], tracks=tracks), alarmed(calm, [])]]).figures()
    assert figures["gospa_deg"] == pytest.approx((8 * 5.0 + 2 * 30.0) / 10)


def test_a_bearing_without_a_track_counts_while_in_alarm():
    trial, calm = made_up("a", "left"), made_up("c")
    off = np.full(81, 0.3 - np.radians(10.0))
    said = [alarmed(trial, [(5.7, 8.0)], bearing_rad=off), alarmed(calm, [])]
    figures = Score.of([trial, calm], [said]).figures()
    assert figures["gospa_deg"] == pytest.approx((4 * 10.0 + 6 * 30.0) / 10)
    assert figures["bearing_deg"] == pytest.approx(10.0)


def test_the_time_to_visible_is_compared_with_the_best_constant():
    trial, calm = made_up("a", "left"), made_up("c")
    true_s = 5.0 - trial.hops.time_s
    stated = np.stack([true_s, true_s + 0.5, true_s + 1.0], axis=1)
    stated[:10, 0] += 0.2
    figures = Score.of(
        [trial, calm], [[alarmed(one, [], visible_s=stated) for one in (trial, calm)]]
    ).figures()
    before = true_s[true_s > -1e-6]
    assert figures["visible_error_s"] == pytest.approx(0.5)
    assert figures["visible_error_constant_s"] == pytest.approx(before.std())
    assert figures["visible_coverage"] == pytest.approx(1 - 10 / len(before))


@pytest.mark.parametrize("risk", [0.002, 0.01, 0.2, 0.5])
def test_the_floor_of_few_windows_stays_near_its_own(risk):
    trials = [made_up("a", "left", t0_s=1.6), made_up("b", hops=9)]
    answers = [alarmed(one, [], risk=np.full(len(one.hops), risk)) for one in trials]
    floor = calibration_error_sampling(np.full(16, risk), np.random.default_rng(5), draws=40000)[0]
    assert Score.of(trials, [answers]).figures()["ece_floor"] == pytest.approx(floor, rel=0.2)


def test_angles_wrap_and_a_fast_camera_changes_nothing():
    trial, calm = made_up("a", "left", in_view_rad=np.pi - 0.05), made_up("c")
    behind = np.full(81, -np.pi + 0.05)
    tracks = tracked(trial, np.ones(81, bool), np.zeros(81, int), behind)
    answers = [alarmed(trial, [], bearing_rad=behind, tracks=tracks), alarmed(calm, [])]
    # Three images per hop, and a vehicle in view before the first window.
    time_s = np.round(np.arange(0.0, 9.0, 1 / 30), 6)
    seen = (time_s < 0.5) | (time_s > 5.05) & (time_s < 6.05)
    rows = zip(time_s, np.zeros(len(time_s)), np.full(len(time_s), np.pi - 0.05), seen, strict=True)
    fast = replace(trial, truth=HopTable.of_rows(TRUTH_COLUMNS, rows))
    for one in (trial, fast):
        figures = Score.of([one, calm], [answers]).figures()
        for name in ("bearing_deg", "gospa_deg"):
            assert figures[name] == pytest.approx(np.degrees(0.1)), name


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6))
def test_a_draw_counts_like_the_recordings_it_repeats(seed):
    rng = np.random.default_rng(seed)
    trials, passes = random_study(rng, approaches=4, calm=3, seeds=2, hops=45)
    rows = rng.integers(0, len(trials), 9)
    drawn = Score.of([trials[i] for i in rows], [[answers[i] for i in rows] for answers in passes])
    close(Score.of(trials, passes).figures(rows), drawn.figures())


def test_figures_are_means_over_seeds():
    trials, passes = random_study(np.random.default_rng(2), seeds=3)
    each = [Score.of(trials, [answers]).figures() for answers in passes]
    close(Score.of(trials, passes).figures(), {n: np.mean([one[n] for one in each]) for n in each[0]})


def test_a_method_that_no_seed_changes_is_scored_once():
    trials, (answers,) = random_study(np.random.default_rng(9))
    assert len(Score.of(trials, [answers] * 3).wins) == 1
    # Copies may differ in fields that are not compared: they are scored like any other pass.
    assert len(Score.of(trials, [answers, [replace(one) for one in answers]]).wins) == 2


def test_a_mirrored_world_has_the_same_figures():
    trials, (answers,) = random_study(np.random.default_rng(4))
    other = {"left": "right", "right": "left", "none": "none"}
    mirrored = [
        Trial(
            one.hops.replace(label=other[one.label], reference_rad=-one.hops.reference_rad),
            one.boxes,
            one.truth.replace(azimuth_rad=-one.truth.azimuth_rad),
        )
        for one in trials
    ]
    turned = [
        replace(
            said, side=-said.side, bearing_rad=-said.bearing_rad,
            tracks=said.tracks.replace(azimuth_rad=-said.tracks.azimuth_rad),
        )
        for said in answers
    ]  # fmt: skip
    ours = Score.of(trials, [answers]).figures()
    close(ours, Score.of(mirrored, [turned]).figures())
    # A method that ignores the mirroring is right where it was wrong before.
    assert Score.of(mirrored, [answers]).figures()["side_correct"] != ours["side_correct"]


def detector(trials, rate, rng):
    """Return alarms that detect each approach with a given probability, a second before T0."""
    return [
        alarmed(trial, [(4.0, 4.5)] if not trial.hazard_free and rng.random() < rate else [])
        for trial in trials
    ]


@pytest.mark.long
def test_intervals_contain_the_truth_in_most_experiments():
    rng = np.random.default_rng(7)
    trials = [made_up(f"r{i}", "left", hops=50, site=f"S{i % 2}") for i in range(40)] + [
        made_up("c", hops=50)
    ]
    held = 0
    for _ in range(50):
        score = Score.of(trials, [detector(trials, 0.7, rng)])
        low, high = score.intervals(stratified_draws(score.strata, rng, 120))["detection"]
        held += low <= 0.7 <= high
    # 95 % minus the undercoverage of a bootstrap of 40 recordings; four standard deviations of the share are
    # 0.12.
    assert 0.82 < held / 50 <= 1.0


def test_false_alarms_have_their_exact_interval():
    trials, passes = random_study(np.random.default_rng(8), seeds=2)
    score = Score.of(trials, passes)
    figures = score.figures()
    count, hours = round(figures["false_onsets"]), figures["hazard_free_hours"]
    expected = (chi2.ppf(0.025, 2 * count) / 2 / hours, chi2.ppf(0.975, 2 * count + 2) / 2 / hours)
    low_high = score.intervals(stratified_draws(score.strata, np.random.default_rng(0), 5))
    assert low_high["false_alarms_per_hour_poisson"] == pytest.approx(expected)


def scored(trial, levels):
    """Return decisions of which only the score is used: a level from each start on, for half a second."""
    time_s, score = trial.hops.time_s, np.full(len(trial.hops), 0.01)
    for start_s, level in levels:
        score[(time_s > start_s - 1e-6) & (time_s < start_s + 0.5 - 1e-6)] = level
    return alarmed(trial, [], score=score)


def test_false_alarms_are_compared_at_equal_detection():
    near = [made_up(f"a{i}", "left", t0_s=7.0) for i in range(10)]
    calm = [made_up("c"), made_up("d")]
    trials = [*near, *calm]
    # Ours separates nine of ten from a false burst that is as high as the tenth; the baseline separates none.
    ours = [scored(one, [(5.5, 0.9 if i else 0.2)]) for i, one in enumerate(near)]
    ours += [scored(calm[0], [(3.0, 0.5)]), scored(calm[1], [])]
    theirs = [scored(one, [(5.5, 0.6)]) for one in near] + [
        scored(one, [(2.0, 0.8), (5.0, 0.8)]) for one in calm
    ]
    draws = stratified_draws([trial.label for trial in trials], np.random.default_rng(0), 100)
    found = {one.detected: one for one in equal_detection(trials, {OURS: [ours], BASELINE: [theirs]}, draws)}
    hours = 162 * 0.1 / 3600.0
    assert tuple(found) == DETECTED
    assert found[0.9].ours == 0.0 and found[0.9].baseline == pytest.approx(4 / hours)
    assert found[0.9].ratio == found[0.9].low == 0.0
    # Detecting the tenth costs the burst as a false alarm.
    assert found[0.95].ours == pytest.approx(1 / hours) and found[0.95].ratio == pytest.approx(0.25)
    assert found[0.95].low == 0.0 and found[0.95].high <= 0.5
    assert not equal_detection(trials, {BASELINE: [theirs]}, draws)


def test_figures_by_site_include_the_worst_one():
    good, bad = made_up("a", "left", site="SA1"), made_up("b", "left", site="SB1")
    calm = made_up("c", site="SC1")
    score = Score.of([good, bad, calm], [[alarmed(good, [(4.0, 4.2)]), alarmed(bad, []), alarmed(calm, [])]])
    rates = [figures["detection"] for figures in score.by_site().values()]
    assert rates == pytest.approx([1.0, 0.0, np.nan], nan_ok=True)
    assert score.worst_sites()["detection"] == ("SB1", 0.0)
    assert score.worst_sites()["false_alarms_per_hour"] == ("SC1", 0.0)


def test_values_that_a_method_does_not_give_are_missing():
    trials = [made_up("a", "left"), made_up("c")]
    score = Score.of(trials, [[alarmed(one, []) for one in trials]])
    figures = score.figures()
    stated = {"detection", "false_alarms_per_hour", "advisory_share", "random_detection", "hazard_awareness"}
    assert all(np.isfinite(figures[name]) for name in stated)
    silent = {
        "side_correct",
        "auroc_all",
        "ece",
        "ece_raw",
        "ece_floor",
        "brier_skill",
        "bearing_deg",
        "lead_s",
    }
    assert all(np.isnan(figures[name]) for name in silent)
    # Log-odds are a score, but not a probability.
    odds = [alarmed(one, [], score=np.linspace(-3.0, 3.0, 81)) for one in trials]
    figures = Score.of(trials, [odds]).figures()
    assert np.isnan(figures["ece_raw"]) and np.isfinite(figures["auroc_all"])


@pytest.mark.parametrize("label", ["left", "none"])
def test_one_kind_of_recordings_alone_has_the_figures_of_its_kind(label):
    rng = np.random.default_rng(0)
    trials = [made_up(f"r{i}", label) for i in range(3)]
    score = Score.of(trials, [[random_answer(one, rng) for one in trials]])
    figures = score.figures()
    assert np.isnan(figures["auroc_all"]) and np.isnan(figures["brier_skill"])
    assert np.isnan(figures["false_alarms_per_hour"]) == (label == "left")
    assert np.isnan(figures["detection"]) == (label == "none")
    score.intervals(stratified_draws(score.strata, rng, 5))


def test_invalid_decisions_are_rejected():
    near, calm = made_up("a", "left"), made_up("c")
    fits = [alarmed(near, []), alarmed(calm, [])]
    for trials, passes, told in [
        ([], [[]], "at least one recording"),
        ([near], [], "at least one recording"),
        ([near, calm], [fits[:1]], "decisions of a pass"),
        ([near], [[alarmed(made_up("x", hops=5), [])]], "a: time_s of the decisions"),
        ([near], [[alarmed(near, [], risk=np.full(81, 1.5))]], r"a: risk: expected numbers in \[0, 1\]"),
        ([made_up("a", "left", t0_s=np.nan)], [fits[:1]], "a: line-of-sight entry"),
    ]:
        with pytest.raises(InvalidArgumentError, match=told):
            Score.of(trials, passes)
