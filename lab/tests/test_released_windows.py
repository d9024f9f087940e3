"""Reference runs on the released windows of OVAD: our method, its baselines and the published pipeline."""

import json

import numpy as np
import pytest
from released_data import FOLDER, needs_released_windows
from released_data import TABLE as NAME
from scipy.stats import binom
from worldstate_lab.cli.main import main
from worldstate_lab.cli.windows import comparison, report, run_passes
from worldstate_lab.features.feature_evaluation import check_unseen, predict_held_out
from worldstate_lab.features.methods import row_of

from worldstate.abduction.signature.window_classes import hazard_statistic
from worldstate.adapters.datasets.feature_table import read_features, read_ids
from worldstate.adapters.files.model_file import read_model
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import encode
from worldstate.operations.metrics.approach_table import auroc
from worldstate.operations.training.training import TrainingSettings, train_model

TABLE = FOLDER and FOLDER / NAME
LISTS = ("timeHorizonStaticTestset.csv", "timeHorizonDynamicTestset.csv")
pytestmark = needs_released_windows


def compared(group, protocol, others=(), seeds=1, reference="curated"):
    row = row_of("worldstate", protocol, reference)
    whole = read_features(TABLE)
    table = whole.group(group)
    train = whole.group("static") if protocol == "transfer" else None
    passes = run_passes((row, *others), table, protocol, seeds=seeds, alpha=0.02, train=train)
    return comparison(table, passes, row, draws=60)


def assert_budget(figures):
    """Check that so many false positives are not unlikely if the true rate is the budget."""
    count = round(figures["fpr"] * figures["n_hazard_free"])
    assert binom.sf(count - 1, figures["n_hazard_free"], 0.02) >= 0.05


@pytest.mark.long
def test_a_standing_ego_at_a_junction_never_seen():
    figures = compared("static", "lojo", ("baseline",))
    assert figures["auroc_macro"] >= 0.97
    assert figures["auroc_pooled"] >= 0.965
    assert figures["worst_group_auroc"] >= 0.94
    assert figures["accuracy"] >= 0.88
    assert figures["tpr"] >= 0.75
    assert_budget(figures)
    assert figures["ece"] <= figures["ece_floor"] + 2 * figures["ece_floor_std"]
    for key in ("auroc_macro", "auroc_pooled", "tpr"):
        assert figures["gains"]["baseline"][key]["low"] > 0


@pytest.mark.long
def test_a_moving_ego_at_a_junction_never_seen():
    # Three of five junctions are available, so each classifier is trained on two.
    figures = compared("dynamic", "lojo")
    assert figures["auroc_macro"] >= 0.885
    assert figures["auroc_pooled"] >= 0.88
    assert figures["accuracy"] >= 0.69
    assert figures["tpr"] >= 0.48
    assert_budget(figures)
    # The predicted risks are overconfident: each classifier is trained on two junctions only.
    assert figures["ece"] <= figures["ece_floor"] + 3 * figures["ece_floor_std"]


@pytest.mark.slow
def test_a_learned_reference_is_between_none_and_curated_windows():
    # With a moving ego, the level is informative only at known junctions; three passes, one table.
    table = read_features(TABLE).group("dynamic")
    rows = [row_of("worldstate", "lojo", reference) for reference in ("cold", "run", "curated")]
    passes = run_passes(rows, table, "lojo", seeds=1, alpha=0.02)
    cold, run, curated = (comparison(table, passes, row, draws=2)["auroc_pooled"] for row in rows)
    assert cold + 0.02 < run < curated - 0.02


@pytest.mark.slow
def test_new_recordings_of_known_junctions():
    figures = compared("static", "cv")
    assert figures["auroc_pooled"] >= 0.98
    assert figures["accuracy"] >= 0.915
    assert figures["tpr"] >= 0.84
    assert_budget(figures)


def test_from_a_standing_to_a_moving_ego():
    figures = compared("dynamic", "transfer")
    assert figures["auroc_macro"] >= 0.83
    assert figures["auroc_pooled"] >= 0.82
    assert_budget(figures)
    assert figures["ece"] <= figures["ece_floor"] + 2 * figures["ece_floor_std"]


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["lojo", "cv", "transfer"])
def test_a_moving_ego_improves_on_the_published_classifier(protocol):
    gains = compared("dynamic", protocol, ("baseline",))["gains"]["baseline"]
    assert gains["auroc_pooled"]["gain"] > 0
    assert gains["brier"]["gain"] < 0


def command(*words):
    return main(["windows", str(TABLE), *map(str, words)])


@pytest.mark.slow
def test_the_command_prints_every_row(capsys):
    words = ("--group", "dynamic", "--protocol", "transfer", "--method", "worldstate", "--seeds", 1)
    assert command(*words, "--json") == 0
    figures = json.loads(capsys.readouterr().out)
    assert set(figures["rows"]) == {
        "baseline", "distant_site_cold", "distant_site_curated", "ensemble_run",
    }  # fmt: skip
    for row in (figures, *figures["rows"].values()):
        for key, (low, high) in row["intervals"].items():
            assert low <= high
            assert key == "ece" or low - 1e-9 <= row[key] <= high + 1e-9
    assert command("--group", "static", "--protocol", "transfer") == 2
    assert "transfer" in capsys.readouterr().err


@pytest.mark.long
def test_no_row_of_the_data_ships_and_figures_hold_on_the_official_test_recordings():
    table = read_features(TABLE).group("static")
    ids = read_ids(FOLDER / LISTS[0])
    settings = TrainingSettings(repeats=1)
    model = train_model(table.without(ids), settings, dataset="OVAD", group="static")
    tested = table.only(ids)
    found = predict_held_out(model, tested, 0.02, "curated", np.random.default_rng(0))
    assert (found.classes == tested.labels).mean() >= 0.88
    scored, absent = tested.labels != "front", hazard_statistic(found.probabilities, 0.0)
    assert auroc(absent[scored], tested.hazards[scored]) >= 0.975
    written = {f"{value:.6f}" for value in leaves(encode(model.signature))}
    for row in np.concatenate([table.features, np.log(table.features)]):
        assert len(written & {f"{value:.6f}" for value in row}) < 10


def leaves(value):
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return [leaf for item in value for leaf in leaves(item)]
    return [value] if isinstance(value, float) else []


def evaluated(group, protocol, seeds):
    table = read_features(TABLE).group(group)
    passes = run_passes(["baseline"], table, protocol, seeds=seeds, alpha=0.02)
    return comparison(table, passes, "baseline", draws=2)


def test_the_table_has_the_known_counts():
    table = read_features(TABLE)
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
