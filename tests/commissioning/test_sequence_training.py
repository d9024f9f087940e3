"""Boosted trees as arrays against scikit-learn, the margin of times, and parallel learning."""

from types import SimpleNamespace

import numpy as np
import pytest
from hop_tables import heard_stream
from hypothesis import given
from hypothesis import strategies as st
from sklearn.ensemble import HistGradientBoostingClassifier

from worldstate.abduction.sequence.sequence_inputs import sequence_inputs
from worldstate.abduction.sequence.sequence_model import GROUPS, LONGEST_S, SequenceModel
from worldstate.commissioning import commission
from worldstate.commissioning.sequence_training import (
    MOVING,
    STANDING,
    Growth,
    LabelledStream,
    StreamTruth,
    calibrated_margin_s,
    exported,
    stream_truth,
    train_sequence,
)
from worldstate.commissioning.stream_exam import smoothed_log_odds
from worldstate.ground.typing import FloatArray


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("sizes", [(6,), (4, 9), (8, 3, 5)])
def test_exported_trees_equal_the_geometric_mean_of_classifiers(seed: int, sizes: tuple[int, ...]) -> None:
    rng = np.random.default_rng(seed)
    inputs, groups = rng.normal(size=(400, 7)), rng.choice([0, 3, 14], 400)
    machines = [
        HistGradientBoostingClassifier(max_iter=3 + one, max_leaf_nodes=one, random_state=seed).fit(
            inputs, groups
        )
        for one in sizes
    ]
    fresh = rng.normal(size=(200, 7)) * 2.0
    scores = exported(machines, inputs[:5]).scores(fresh)
    exponent = np.exp(scores - scores.max(axis=1, keepdims=True))
    averaged = exponent / exponent.sum(axis=1, keepdims=True)
    product = np.prod([one.predict_proba(fresh) for one in machines], axis=0) ** (1.0 / len(sizes))
    expected = product / product.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(averaged[:, [0, 3, 14]], expected, atol=1e-6)
    assert averaged[:, 1].max() < 1e-9


def _stream(rng: np.random.Generator, hops: int = 1200) -> tuple[np.ndarray, StreamTruth]:
    """Return a synthetic street: every 12 s the evidence of the left side rises before a vehicle."""
    time_s = 0.1 * np.arange(hops)
    coming = np.stack([12.0 - time_s % 12.0, np.full(hops, np.inf)], axis=1)
    rises = np.clip(3.0 - coming[:, 0], -2.0, 3.0)
    sides = np.stack([rises, np.full(hops, -2.0)], axis=1) + rng.normal(size=(hops, 2))
    rest = np.abs(rng.normal(size=(7, hops))).T
    nobody = np.full((hops, 2), -np.inf)
    truth = StreamTruth(coming, np.zeros(hops, bool), nobody, nobody, np.zeros((hops, 2), bool))
    return np.concatenate([sides, rest, rng.normal(size=(hops, 4))], axis=1), truth


@pytest.mark.parametrize("background_db", [-10.0, 0.0, 8.0])
def test_distant_vehicles_are_weighted_by_level_over_background(background_db: float) -> None:
    """Fainter vehicles are audible in a quiet street and must not be labelled empty."""
    hops = 12
    rising_db = 48.0 + background_db + np.linspace(-6.0, 6.0, hops)
    far, time_s = (7, "far", "light", "left", np.nan, False), 0.1 * np.arange(hops)
    rows = [(7, at_s, 9.0, 60.0, False, level) for at_s, level in zip(time_s, rising_db, strict=True)]
    heard = heard_stream([far], rows, {"time_s": time_s}, site="SA1", background_db=background_db)
    left, _ = stream_truth(heard).groups().T
    assert [GROUPS[group] for group in left] == ["none"] * 6 + ["rising"] * 6


@pytest.mark.long
def test_a_trained_sequence_detects_and_has_90_per_cent_intervals() -> None:
    rng = np.random.default_rng(5)
    learned = [
        LabelledStream.of(sequence_inputs(heard), truth) for heard, truth in (_stream(rng), _stream(rng))
    ]
    model = train_sequence(learned, 5, [Growth(8, 16, 0.2)])
    fresh, coming_to = _stream(rng)
    others = [_stream(rng), _stream(rng)]
    margin_s = calibrated_margin_s([(model.posterior(heard), truth) for heard, truth in others])
    said = model.posterior(fresh)
    assert np.isclose(model.share.sum(), 1.0, atol=1e-4) and said.groups.shape == (1200, 2, len(GROUPS))
    soon = coming_to.coming_s[:, 0] <= 1.0
    within = said.within()[:, 0, -1]
    # A few regularised rounds give no certainty, but they separate the hops.
    assert within[soon].mean() > 0.2 > 2 * within[coming_to.coming_s[:, 0] > 6.0].mean()
    times, coming = said.time_to_visible_s(), coming_to.coming_s <= LONGEST_S
    low, _, high = times[coming].T
    inside = (low - margin_s <= coming_to.coming_s[coming]) & (coming_to.coming_s[coming] <= high + margin_s)
    assert 0.85 < inside.mean() < 0.96


def levels_of_readings(calm: tuple[object, object, SequenceModel, FloatArray]) -> FloatArray:
    """Without sound there are no windows, so the alarm depends on the readings only."""
    _, _, model, found = calm
    return smoothed_log_odds(model.posterior(found))


@given(st.lists(st.integers(10, 40_000), min_size=1, max_size=8), st.booleans())
def test_the_number_of_trees_grows_with_the_sound(hops: list[int], moves: bool) -> None:
    """Seven minutes (--quick) use a tenth of the trees, because all of them take most of the time."""
    streams = [SimpleNamespace(hops=range(n), ego_moves=moves) for n in hops]
    sizes, few = (MOVING if moves else STANDING), commission.dealt_growth(streams[:1])
    for most, less, every in zip(sizes, few, commission.dealt_growth(streams), strict=True):
        assert 20 <= less.rounds <= every.rounds <= most.rounds and every.leaves == most.leaves
        if sum(hops) >= 72_000:
            assert every == most
        if sum(hops) <= 4_200:
            assert every.rounds <= 20


@pytest.mark.long
def test_learning_does_not_depend_on_the_number_of_processes(monkeypatch) -> None:
    rng = np.random.default_rng(3)
    streets = [
        SimpleNamespace(site=f"SA{i // 2}", hazard_free=bool(i % 2), hops=range(600), ego_moves=False)
        for i in range(8)
    ]
    made_up = {id(street): _stream(rng, 600) for street in streets}
    monkeypatch.setattr(commission, "stream_evidence", lambda windows, street: made_up[id(street)][0])
    monkeypatch.setattr(commission, "stream_truth", lambda street: made_up[id(street)][1])
    monkeypatch.setattr(commission, "STANDING", [Growth(4, 6, 0.2), Growth(3, 3, 0.1)])
    monkeypatch.setattr(commission, "_quiet_levels", levels_of_readings)
    one, two = (
        commission.learn_sequence(streets, lambda some: None, 30.0, np.random.default_rng(1), jobs)
        for jobs in (1, 2)
    )
    np.testing.assert_array_equal(one.trees.value, two.trees.value)
    np.testing.assert_array_equal(one.trees.threshold, two.trees.threshold)
    assert (one.margin_s, one.alarm) == (two.margin_s, two.alarm)
