"""Reference runs of the method on the released windows of OVAD, compared with its baselines."""

import json

import numpy as np
import pytest
from released_data import FOLDER, needs_released_windows
from released_data import TABLE as NAME
from scipy.stats import binom
from worldstate_lab.cli.main import main
from worldstate_lab.cli.windows import comparison, run_passes
from worldstate_lab.features.feature_evaluation import predict_held_out
from worldstate_lab.features.methods import row_of

from worldstate.abduction.signature.window_classes import hazard_statistic
from worldstate.adapters.datasets.feature_table import read_features, read_ids
from worldstate.ground.serialisation import encode
from worldstate.operations.metrics.approach_table import auroc
from worldstate.operations.training.training import TrainingSettings, train_model

TABLE = FOLDER and FOLDER / NAME
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
    figures = compared("static", "lojo", ("loudest_direction",))
    assert figures["auroc_macro"] >= 0.97
    assert figures["auroc_pooled"] >= 0.965
    assert figures["worst_group_auroc"] >= 0.94
    assert figures["accuracy"] >= 0.88
    assert figures["tpr"] >= 0.75
    assert_budget(figures)
    assert figures["ece"] <= figures["ece_floor"] + 2 * figures["ece_floor_std"]
    for key in ("auroc_macro", "auroc_pooled", "tpr"):
        assert figures["gains"]["loudest_direction"][key]["low"] > 0


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
@pytest.mark.parametrize("row", ["baseline", "loudest_direction"])
def test_a_moving_ego_improves_on_every_other_row(protocol, row):
    figures = compared("dynamic", protocol, ("baseline", "loudest_direction"))
    assert figures["gains"][row]["auroc_pooled"]["gain"] > 0
    assert figures["gains"][row]["brier"]["gain"] < 0


def command(*words):
    return main(["windows", str(TABLE), *map(str, words)])


@pytest.mark.slow
def test_the_command_prints_every_row(capsys):
    words = ("--group", "dynamic", "--protocol", "transfer", "--method", "worldstate", "--seeds", 1)
    assert command(*words, "--json") == 0
    figures = json.loads(capsys.readouterr().out)
    assert set(figures["rows"]) == {
        "baseline", "loudest_direction", "distant_site_cold", "distant_site_curated", "ensemble_run",
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
    ids = read_ids(TABLE.parent / "timeHorizonStaticTestset.csv")
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
