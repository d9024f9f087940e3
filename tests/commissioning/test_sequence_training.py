"""Boosted trees kept as arrays against scikit-learn's own, and the margin of stated times."""

import numpy as np
import pytest
from sklearn.ensemble import HistGradientBoostingClassifier

from worldstate.abduction.sequence.sequence_model import GROUPS, LONGEST_S
from worldstate.commissioning.sequence_training import (
    Growth,
    LabelledStream,
    StreamTruth,
    calibrated_margin_s,
    exported,
    train_sequence,
)


@pytest.mark.parametrize("seed", [0, 1])
def test_exported_trees_say_what_the_classifier_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    inputs, groups = rng.normal(size=(400, 7)), rng.choice([0, 3, 14], 400)
    machine = HistGradientBoostingClassifier(max_iter=5, max_leaf_nodes=6, random_state=seed)
    machine.fit(inputs, groups)
    fresh = rng.normal(size=(200, 7)) * 2.0
    scores = exported(machine, inputs[:5]).scores(fresh)
    exponent = np.exp(scores - scores.max(axis=1, keepdims=True))
    said = exponent / exponent.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(said[:, [0, 3, 14]], machine.predict_proba(fresh), atol=1e-6)
    assert said[:, 1].max() < 1e-9


def _stream(rng: np.random.Generator, hops: int = 1200) -> LabelledStream:
    """Return a made-up street where evidence of the left side rises before somebody comes, every 12 s."""
    time_s = 0.1 * np.arange(hops)
    coming = np.stack([12.0 - time_s % 12.0, np.full(hops, np.inf)], axis=1)
    rises = np.clip(3.0 - coming[:, 0], -2.0, 3.0)
    sides = np.stack([rises, np.full(hops, -2.0)], axis=1) + rng.normal(size=(hops, 2))
    rest = np.abs(rng.normal(size=(7, hops))).T
    nobody = np.full((hops, 2), -np.inf)
    return LabelledStream(
        np.concatenate([sides, rest, rng.normal(size=(hops, 4))], axis=1),
        StreamTruth(coming, np.zeros(hops, bool), nobody, nobody, np.zeros((hops, 2), bool)),
    )


@pytest.mark.long
def test_a_trained_sequence_tells_who_comes_and_its_intervals_hold_nine_of_ten() -> None:
    rng = np.random.default_rng(5)
    model = train_sequence([_stream(rng) for _ in range(2)], rng, Growth(8, 16))
    fresh = _stream(rng)
    others = [_stream(rng), _stream(rng)]
    margin_s = calibrated_margin_s([(model.posterior(one.evidence), one.truth) for one in others])
    said = model.posterior(fresh.evidence)
    assert np.isclose(model.share.sum(), 1.0, atol=1e-4) and said.groups.shape == (1200, 2, len(GROUPS))
    soon = fresh.truth.coming_s[:, 0] <= 1.0
    within = said.within()[:, 0, -1]
    # A few rounds that are held back are not sure of anything yet; they know which hops are which.
    assert within[soon].mean() > 0.2 > 2 * within[fresh.truth.coming_s[:, 0] > 6.0].mean()
    times, coming = said.time_to_visible_s(), fresh.truth.coming_s <= LONGEST_S
    low, _, high = times[coming].T
    inside = (low - margin_s <= fresh.truth.coming_s[coming]) & (
        fresh.truth.coming_s[coming] <= high + margin_s
    )
    assert 0.85 < inside.mean() < 0.96
