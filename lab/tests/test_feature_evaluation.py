"""Protocols on artificial windows: no recording in both training and test, every figure reproducible."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit, logit
from sklearn.metrics import roc_auc_score
from worldstate_lab.cli.main import main as lab
from worldstate_lab.cli.windows import comparison, run_passes
from worldstate_lab.features.feature_evaluation import WindowMethod, cross_validate, matched_risk, methods
from worldstate_lab.features.published_classifier import PublishedClassifier

from worldstate.abduction.cueing.risk_map import fit_platt
from worldstate.abduction.signature.window_classes import CLASSES, hazard_statistic
from worldstate.adapters.datasets.feature_table import FeatureTable, write_features
from worldstate.cli.main import main
from worldstate.ground.errors import InvalidArgumentError
from worldstate.operations.training.site_references import STREAMS
from worldstate.operations.training.training import (
    N_FOLDS,
    calibrate_passes,
    fit_ensemble,
    folds_by_recording,
    recording_labels,
)

JUNCTIONS = ("SA1", "SB1", "SB2")


def made_up_table(seed=0, recordings=72, spread=1.5):
    """Return a table with half of the recordings hazard-free, the others with a hazard and a front window."""
    rng = np.random.default_rng(seed)
    azimuth = np.tile(np.linspace(-1, 1, 30), 2)
    shape = {"front": azimuth**2, "none": 0 * azimuth, "left": -azimuth, "right": azimuth}
    rows = []
    for number in range(recordings):
        side = ("left", "right")[number // 6 % 2]
        for label in ("none",) if number % 2 else (side, "front"):
            feature = shape[label] + 0.2 + spread * rng.normal(size=60)
            rows.append((feature, label, f"{label}_{number}", JUNCTIONS[number % 3], str(number)))
    features, *labels = zip(*rows, strict=True)
    return FeatureTable(np.array(features), *map(np.array, labels), (None,) * len(rows))


def written(path, table):
    write_features(path, table)
    return path


@pytest.fixture(scope="module")
def csv_path(tmp_path_factory):
    return written(tmp_path_factory.mktemp("table") / "windows.csv", made_up_table())


def command(*words):
    run, given = (main, ["model", "fit"]) if words[0] == "fit" else (lab, words[:1])
    return run([str(word) for word in (*given, *words[1:])])


def refused(capsys, problem, *words):
    capsys.readouterr()
    assert command(*words) == 2
    assert re.search(problem, capsys.readouterr().err)


@given(st.integers(0, 1000), st.integers(12, 60))
def test_folds_never_split_a_recording_and_divide_every_stratum(seed, recordings):
    table = made_up_table(recordings=recordings)
    folds = folds_by_recording(table, np.random.default_rng(seed))
    keys, labels = table.recording_keys, recording_labels(table)
    assert set(labels.values()) <= {"left", "right", "none"}  # By the hazard, not by the window in view
    fold_of = dict(zip(keys.tolist(), folds.tolist(), strict=True))
    assert all(fold_of[key] == fold for key, fold in zip(keys.tolist(), folds.tolist(), strict=True))
    for stratum in {(key.split("/")[0], label) for key, label in labels.items()}:
        members = [fold_of[k] for k, label in labels.items() if (k.split("/")[0], label) == stratum]
        counts = [members.count(str(fold)) for fold in range(N_FOLDS)]
        assert max(counts) - min(counts) <= 1


class Spy(PublishedClassifier):
    """Stores its training set and raises an error if it is applied to it."""

    def fit(self, X, y, groups=None):
        self.seen = {row.tobytes() for row in X}
        return super().fit(X, y)

    def predict_proba(self, X):
        assert not self.seen & {row.tobytes() for row in X}
        return super().predict_proba(X)


@pytest.mark.long
@pytest.mark.parametrize("protocol", ["cv", "lojo"])
def test_no_window_is_predicted_by_a_classifier_trained_on_it(protocol):
    table = made_up_table(recordings=60)
    predictions = cross_validate(table, protocol, WindowMethod(Spy), np.random.default_rng(0), alpha=0.1)
    np.testing.assert_allclose(predictions.probabilities.sum(axis=1), 1.0)
    assert ((predictions.risk >= 0) & (predictions.risk <= 1)).all()


@pytest.mark.parametrize("reference", ["run", "cold", "curated"])
def test_a_threshold_is_set_on_windows_with_the_reference_of_its_use(reference):
    made_up = made_up_table(spread=0.5)
    table = replace(made_up, features=np.exp(made_up.features))
    method = methods()[f"ensemble_{reference}"]
    train, rng = method.prepare(table), np.random.default_rng(0)
    passes = method.passes(train, rng, "lojo", method.asks(train, rng))
    assert len(passes) == (STREAMS if reference == "run" else 1)
    for site in JUNCTIONS:
        here = train.environments == site
        model = fit_ensemble(train.select(~here))
        expected = model.explain(train.features[here] if reference == "curated" else table.features[here])
        if reference != "run":
            np.testing.assert_allclose(passes[0][here], expected)
        else:
            assert all(np.abs(one[here] - expected).max() > 1e-3 for one in passes)
            assert np.abs(passes[0][here] - passes[1][here]).max() > 1e-3


def test_a_threshold_is_the_mean_over_streams_and_half_way_between_both_folds():
    """With a level whose passes differ strongly, because a mean in log-odds would differ there."""
    table, rng = made_up_table(), np.random.default_rng(3)
    levels = [[rng.dirichlet(np.ones(4), len(table)) for _ in range(n)] for n in (2, 3)]
    learned = calibrate_passes(table, levels, alpha=0.1, miss_rate=0.0)
    sorted_scores = [
        [np.sort(hazard_statistic(one, 0.0)[table.hazard_free])[::-1] for one in level] for level in levels
    ]
    # Just above the first window that would exceed a tenth of them.
    paid = int(0.1 * table.hazard_free.sum())
    expected = np.mean([np.mean([one[paid] for one in level]) for level in sorted_scores])
    assert learned.gamma == pytest.approx(expected, abs=1e-12)
    scored, pooled = np.tile(table.hazards | table.hazard_free, 3), np.concatenate(levels[1])
    hazards = np.tile(table.hazards, 3)[scored]
    assert learned.risk_map == fit_platt(hazard_statistic(pooled, 0.0)[scored], hazards)
    with pytest.raises(InvalidArgumentError, match="pass"):
        calibrate_passes(table, [[], levels[1]], alpha=0.1, miss_rate=0.0)


@pytest.mark.long
@pytest.mark.parametrize("protocol", ["cv", "lojo"])
def test_every_figure_can_be_recomputed_from_the_predictions(protocol):
    table = made_up_table()
    passes = run_passes(["baseline"], table, protocol, seeds=2, alpha=0.02)
    figures = comparison(table, passes, "baseline", draws=2)
    scored = table.labels != "front"
    hazard = table.labels[scored] != "none"
    accuracy, areas, by_junction, rates = [], [], [], []
    for one in passes["baseline"]:
        _, left, _, right = one.probabilities.T
        likeliest = np.array(CLASSES)[np.argmax(one.probabilities, axis=1)]
        accuracy.append(np.mean(likeliest == table.labels))
        areas.append(roc_auc_score(hazard, one.score[scored]))
        here = [scored & (table.environments == site) for site in JUNCTIONS]
        by_junction.append([roc_auc_score(table.hazards[rows], one.score[rows]) for rows in here])
        rates.append((one.decision[scored][hazard].mean(), one.decision[scored][~hazard].mean()))
        np.testing.assert_allclose(one.score, left + right, atol=1e-9)
    assert figures["accuracy"] == pytest.approx(np.mean(accuracy))
    assert figures["auroc_pooled"] == pytest.approx(np.mean(areas))
    assert (figures["tpr"], figures["fpr"]) == pytest.approx(tuple(np.mean(rates, axis=0)))
    assert figures["auroc_macro"] == pytest.approx(np.mean(by_junction))
    assert figures["worst_group_auroc"] == pytest.approx(np.mean(np.min(by_junction, axis=1)))


@pytest.mark.long
def test_the_same_command_prints_the_same(csv_path, capsys):
    outputs = []
    for form in ("--json", "--json", "--seeds=1"):
        assert command("windows", csv_path, "--method", "baseline", "--seeds", 1, form) == 0
        outputs.append(capsys.readouterr().out)
    assert outputs[0] == outputs[1]
    figures = json.loads(outputs[0])
    for key, (low, high) in figures["intervals"].items():
        assert low <= high and (key == "ece" or low - 1e-9 <= figures[key] <= high + 1e-9)
    assert "worst_group_auroc" in outputs[2]


@pytest.mark.long
def test_train_writes_exactly_its_path_and_leaves_out_listed_recordings(csv_path, tmp_path, capsys):
    ids = tmp_path / "ids.csv"
    ids.write_text("ID\n" + "\n".join(f"none_{n}" for n in (1, 3, 5, 7)) + "\nleft_0\nright_6\n")
    model = tmp_path / "m"
    words = ("--exclude", ids, "--out", model, "--json")
    assert command("fit", csv_path, *words) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["n_recordings"] == 66
    assert summary["n_excluded_windows"] == 8
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ids.csv", "m"]
    refused(capsys, r"trained on 66 of these 72 recordings.*--exclude", "windows", csv_path, "--model", model)
    assert command("windows", csv_path, "--model", model, "--only", ids, "--reference", "cold", "--json") == 0
    assert json.loads(capsys.readouterr().out)["n_windows"] == 8


def test_bad_requests_are_rejected(csv_path, tmp_path, capsys):
    refused(capsys, "dynamic", "windows", csv_path, "--group", "dynamic")
    refused(capsys, "seeds", "windows", csv_path, "--seeds", 0)
    refused(capsys, "alpha", "windows", csv_path, "--alpha", 1.5, "--seeds", 1)
    refused(capsys, "nowhere", "fit", csv_path, "--out", tmp_path / "nowhere" / "m")
    table = made_up_table()
    one = written(tmp_path / "one.csv", table.select(table.environments == "SA1"))
    refused(capsys, "two junctions", "windows", one, "--protocol", "lojo")
    lonely = table.select((table.environments != "SA1") | (table.recordings == table.recordings[0]))
    path = written(tmp_path / "lonely.csv", lonely)
    refused(capsys, "another recording of its junction", "fit", path, "--out", tmp_path / "m")


def of_sites(recordings, sites):
    words = np.array(["none"] * len(recordings))
    columns = (np.array(sites), np.array(recordings))
    return FeatureTable(np.ones((len(recordings), 60)), words, words, *columns, (None,) * len(recordings))


def test_the_mean_is_that_of_the_other_recordings():
    risk = np.array([0.1, 0.3, 0.6, 0.9])
    matched = matched_risk(risk, of_sites(["a", "b", "c", "d"], ["DA1"] * 4), 0.5)
    for i in range(4):
        shift = logit(matched[i]) - logit(risk[i])
        assert expit(logit(np.delete(risk, i)) + shift).mean() == pytest.approx(0.5, abs=1e-9)


def test_a_site_with_one_recording_has_no_others_to_match():
    with pytest.raises(InvalidArgumentError, match="DA1/a"):
        matched_risk(np.array([0.5, 0.5]), of_sites(["a", "a"], ["DA1"] * 2), 0.5)
