"""Reference runs on the released windows of OVAD: results of the published pipeline."""

import numpy as np
import pytest
from released_data import FOLDER, TABLE, needs_released_windows
from worldstate_lab.cli.windows import report
from worldstate_lab.features.feature_evaluation import (
    WindowMethod,
    check_unseen,
    cross_validate,
    predict_held_out,
)
from worldstate_lab.features.published_classifier import PublishedClassifier

from worldstate.adapters.datasets.feature_table import read_features, read_ids
from worldstate.adapters.files.model_file import read_model
from worldstate.ground.errors import InvalidArgumentError
from worldstate.operations.training.training import PUBLISHED_MISS_RATE

LISTS = ("timeHorizonStaticTestset.csv", "timeHorizonDynamicTestset.csv")


pytestmark = needs_released_windows


def evaluated(group, protocol, seeds):
    table = read_features(FOLDER / TABLE).group(group)
    published = WindowMethod(PublishedClassifier, PUBLISHED_MISS_RATE)
    generators = map(np.random.default_rng, range(seeds))
    return report(table, [cross_validate(table, protocol, published, rng, alpha=0.02) for rng in generators])


def test_the_table_has_the_known_counts():
    table = read_features(FOLDER / TABLE)
    assert len(table) == 909
    assert len(np.unique(table.recording_keys)) == 601
    assert (table.group("static").hazards.sum(), table.group("static").hazard_free.sum()) == (212, 199)
    assert len(table.only(read_ids(FOLDER / LISTS[0]))) == 125


@pytest.mark.long
def test_static_cross_validation_reaches_the_published_figures():
    figures = evaluated("static", "cv", seeds=2)
    assert 0.91 <= figures["accuracy"] <= 0.93
    assert figures["auroc_pooled"] == pytest.approx(0.976, abs=0.006)
    assert figures["tpr"] == pytest.approx(0.74, abs=0.07)
    # Law 4 guarantees the budget on the data that set gamma; out of fold it holds within the error of 199
    # windows.
    assert figures["fpr"] <= 0.05
    assert figures["ece"] <= figures["ece_floor"] + 0.02


@pytest.mark.long
def test_an_unseen_junction_is_harder():
    figures = evaluated("static", "lojo", seeds=1)
    assert figures["accuracy"] == pytest.approx(0.807, abs=0.015)
    assert figures["auroc_macro"] == pytest.approx(0.945, abs=0.01)
    assert figures["auroc_pooled"] == pytest.approx(0.918, abs=0.01)


@pytest.mark.slow
def test_a_moving_ego_is_harder_still():
    figures = evaluated("dynamic", "cv", seeds=5)
    # 0.770 over five dynamic junctions, of which two are not in this copy.
    assert figures["accuracy"] == pytest.approx(0.77, abs=0.03)


def test_the_shipped_model_is_not_trained_on_the_official_lists():
    table = read_features(FOLDER / TABLE).group("static")
    excluded = [name for file in LISTS for name in read_ids(FOLDER / file)]
    shipped = read_model()
    assert shipped.provenance.excluded_lists == tuple(LISTS)
    assert set(shipped.provenance.training_recordings) == set(table.without(excluded).recording_keys.tolist())
    check_unseen(shipped, table.only(read_ids(FOLDER / LISTS[0])))
    with pytest.raises(InvalidArgumentError, match="trained on"):
        check_unseen(shipped, table.without(excluded))


def test_the_shipped_model_keeps_its_figures_on_the_official_test_recordings():
    table = read_features(FOLDER / TABLE).group("static").only(read_ids(FOLDER / LISTS[0]))
    figures = report(
        table, [predict_held_out(read_model(), table, 0.02, "curated", np.random.default_rng(0))]
    )
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
    table = read_features(FOLDER / TABLE)
    for row in np.concatenate([table.features, np.log(table.features)]):
        assert len(numbers & set(np.round(row, 6).tolist())) < 10
