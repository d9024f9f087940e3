"""Reference runs on the released windows of OVAD: our method, its baselines and the published pipeline."""

import numpy as np
import pytest
from released_data import FOLDER, needs_released_windows
from released_data import TABLE as NAME
from scipy.stats import binom
from worldstate_lab.cli.windows import comparison, report, run_passes
from worldstate_lab.features.feature_evaluation import check_unseen, predict_held_out, row_of

from worldstate.adapters.datasets.feature_table import read_features, read_ids
from worldstate.adapters.files.model_file import read_model
from worldstate.ground.errors import InvalidArgumentError

TABLE = FOLDER and FOLDER / NAME
LISTS = ("timeHorizonStaticTestset.csv", "timeHorizonDynamicTestset.csv")
pytestmark = needs_released_windows


def compared(group, protocol, row, others=(), seeds=1):
    whole = read_features(TABLE)
    table = whole.group(group)
    train = whole.group("static") if protocol == "transfer" else None
    passes = run_passes((row, *others), table, protocol, seeds=seeds, alpha=0.02, train=train)
    return comparison(table, passes, row, draws=60)


# Least values of our method; the calibration error may exceed its floor by this many standard deviations.
# Three of five junctions with a moving ego are available: classifiers trained on two are overconfident.
LEAST = [
    pytest.param(
        *("static", "lojo", 2),
        {
            "auroc_macro": 0.97,
            "auroc_pooled": 0.965,
            "worst_group_auroc": 0.94,
            "accuracy": 0.88,
            "tpr": 0.75,
        },
        marks=pytest.mark.long,
    ),
    pytest.param(
        *("dynamic", "lojo", 3),
        {"auroc_macro": 0.885, "auroc_pooled": 0.88, "accuracy": 0.69, "tpr": 0.48},
        marks=pytest.mark.long,
    ),
    ("dynamic", "transfer", 2, {"auroc_macro": 0.83, "auroc_pooled": 0.82}),
]


@pytest.mark.parametrize(("group", "protocol", "deviations", "least"), LEAST)
def test_our_method_keeps_its_figures_and_its_budget(group, protocol, deviations, least):
    others = ("baseline",) if (group, protocol) == ("static", "lojo") else ()
    figures = compared(group, protocol, row_of("worldstate", protocol, "curated"), others)
    assert {name: figures[name] for name, value in least.items() if figures[name] < value} == {}
    # So many false positives are not unlikely if the true rate is the budget.
    count = round(figures["fpr"] * figures["n_hazard_free"])
    assert binom.sf(count - 1, figures["n_hazard_free"], 0.02) >= 0.05
    assert figures["ece"] <= figures["ece_floor"] + deviations * figures["ece_floor_std"]
    for name in others:
        assert all(figures["gains"][name][key]["low"] > 0 for key in ("auroc_macro", "auroc_pooled", "tpr"))


@pytest.mark.long
def test_static_cross_validation_reaches_the_published_figures():
    figures = compared("static", "cv", "baseline", seeds=2)
    assert 0.91 <= figures["accuracy"] <= 0.93
    assert figures["auroc_pooled"] == pytest.approx(0.976, abs=0.006)
    assert figures["tpr"] == pytest.approx(0.74, abs=0.07)
    # Law 4 guarantees the budget on the data that set gamma; out of fold it holds within the error of 199
    # windows.
    assert figures["fpr"] <= 0.05
    assert figures["ece"] <= figures["ece_floor"] + 0.02


@pytest.mark.long
def test_an_unseen_junction_is_harder_for_the_published_classifier():
    figures = compared("static", "lojo", "baseline")
    assert figures["accuracy"] == pytest.approx(0.807, abs=0.015)
    assert figures["auroc_macro"] == pytest.approx(0.945, abs=0.01)
    assert figures["auroc_pooled"] == pytest.approx(0.918, abs=0.01)


def test_the_table_has_the_known_counts():
    table = read_features(TABLE)
    assert (len(table), len(np.unique(table.recording_keys))) == (909, 601)
    assert (table.group("static").hazards.sum(), table.group("static").hazard_free.sum()) == (212, 199)
    assert len(table.only(read_ids(FOLDER / LISTS[0]))) == 125


def test_the_shipped_model_is_not_trained_on_the_official_lists():
    table = read_features(TABLE).group("static")
    excluded = [name for file in LISTS for name in read_ids(FOLDER / file)]
    shipped = read_model()
    assert shipped.provenance.excluded_lists == tuple(LISTS)
    assert set(shipped.provenance.training_recordings) == set(table.without(excluded).recording_keys.tolist())
    check_unseen(shipped, table.only(read_ids(FOLDER / LISTS[0])))
    with pytest.raises(InvalidArgumentError, match="trained on"):
        check_unseen(shipped, table.without(excluded))


def test_the_shipped_model_keeps_its_figures_on_the_official_test_recordings():
    table = read_features(TABLE).group("static").only(read_ids(FOLDER / LISTS[0]))
    figures = report(table, predict_held_out(read_model(), table, 0.02, "curated", np.random.default_rng(0)))
    # The authors' own classifier has 0.928 there, retrained on this table 0.920: two more classes and the
    # share of hazards in streams reduce accuracy but not ranking. Windows of a second renderer cost another
    # 0.03 and of a third 0.02, while the ranking improves (0.984 before it).
    assert figures["accuracy"] == pytest.approx(0.83, abs=0.02)
    assert figures["auroc_pooled"] > 0.985
    assert figures["tpr"] > 0.7
    assert figures["fpr"] <= 0.05


def test_no_row_of_the_data_ships():
    model = read_model().signature
    stored = [row for expert in model.experts for row in (*expert.weights, expert.mean, expert.scale)]
    stored += [model.empty, *np.split(model.home, 3)]
    numbers = {round(number, 6) for row in stored for number in row.tolist()}
    table = read_features(TABLE)
    for row in np.concatenate([table.features, np.log(table.features)]):
        assert len(numbers & set(np.round(row, 6).tolist())) < 10
