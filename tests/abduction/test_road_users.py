"""Softmax over kinds of road users, the domain guard, and their model files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import softmax

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.abduction.road_users import (
    DomainGuard,
    Familiar,
    RoadUserModel,
    WarningSignal,
    likeliest,
    neutral,
    with_siren,
)
from worldstate.adapters.files.model_file import read_model, save_model
from worldstate.ground.errors import InputFileError, InvalidArgumentError

CLASSES = ("van", "car", "unknown")


def model(seed: int = 0) -> RoadUserModel:
    rng = np.random.default_rng(seed)
    return RoadUserModel(("a", "b"), CLASSES, rng.standard_normal((3, 2)), rng.standard_normal(3))


@given(st.integers(0, 99), st.lists(st.floats(-50.0, 50.0), min_size=2, max_size=2))
def test_class_probabilities_are_a_softmax(seed: int, measured: list[float]) -> None:
    one, x = model(seed), np.array(measured)
    expected = dict(zip(CLASSES, softmax(one.weights @ x + one.biases), strict=True))
    said = one.classify(x)
    assert [name for name, _ in said] == sorted(CLASSES)
    assert dict(said) == pytest.approx(expected, abs=1e-12)


@given(st.lists(st.floats(0.01, 1.0), min_size=3, max_size=3), st.floats(-5.0, 5.0), st.floats(0.05, 0.999))
def test_the_likeliest_set_is_minimal_and_a_siren_keeps_its_odds(parts, log_odds, mass):
    shares = tuple(zip(sorted(CLASSES), (np.array(parts) / sum(parts)).tolist(), strict=True))
    chosen, by_name = likeliest(shares, mass), dict(shares)
    assert sum(by_name[name] for name in chosen) >= mass - 1e-9
    assert sum(sorted(by_name.values())[-len(chosen) + 1 :] if len(chosen) > 1 else [0.0]) < mass
    heard = dict(with_siren(shares, log_odds))
    assert sum(heard.values()) == pytest.approx(1.0)
    assert np.log(heard["siren"] / (1.0 - heard["siren"])) == pytest.approx(log_odds)


def test_classes_without_an_unknown_one_and_a_wrong_shape_raise_an_error(tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    save_model(path, replace(read_model(), road_users=model()))
    path.write_text(path.read_text().replace('"unknown"', '"ghost"'))
    with pytest.raises(InputFileError, match="unknown"):
        read_model(path)
    with pytest.raises(InvalidArgumentError, match="biases"):
        RoadUserModel(("a",), CLASSES, np.zeros((3, 1)), np.zeros(2))


# Two measures: foreign sounds are at positive x, signals at (0, 5), street sounds at the origin.
GUARD = DomainGuard(
    measures=("x", "y"),
    foreign=("speech", "music"),
    signals=("siren",),
    weights=np.array([[0.0, 0.0], [2.0, 0.0], [2.0, -1.0], [0.0, 2.0]]),
    biases=np.array([4.0, 0.0, 0.0, 0.0]),
    threshold=1.0,
    signal_nats=1.0,
)
measures = st.lists(st.floats(-9.0, 9.0), min_size=2, max_size=2).map(np.array)


@given(measures)
def test_log_odds_are_those_of_the_softmax_over_the_threshold(x: np.ndarray) -> None:
    street = softmax(GUARD.weights @ x + GUARD.biases)[0]
    verdict = GUARD.judge(x)
    assert verdict.log_odds == pytest.approx(np.log((1.0 - street) / street) - 1.0, abs=1e-6)
    assert isinstance(verdict, Familiar) == (verdict.log_odds <= 0.0)


def test_a_verdict_has_its_reason_or_signal() -> None:
    speech, music, siren = (GUARD.judge(np.array(x)) for x in ([6.0, 1.0], [6.0, -1.0], [0.0, 5.5]))
    assert (speech.reason, music.reason, siren.signal) == ("sounds like speech", "sounds like music", "siren")


@given(measures)
def test_a_signal_must_exceed_foreign_sounds_by_its_margin(x: np.ndarray) -> None:
    share = softmax(GUARD.weights @ x + GUARD.biases)
    verdict, nats = GUARD.judge(x), np.log(share[3]) - np.log(share[1] + share[2])
    assert isinstance(verdict, WarningSignal) == (verdict.log_odds > 0.0 and nats > 1.0)


levels = st.floats(-20.0, 20.0)


@given(levels, levels, levels, levels, st.floats(0.0, 10.0))
def test_flagged_evidence_shrinks_by_the_margin_towards_neutral(left, right, visible, none, margin):
    evidence = SignatureEvidence(("left", "right"), (left, right), visible, none)
    flagged = neutral(evidence, margin)
    assert (flagged.visible, flagged.none) == (visible, none)
    for before, after in zip(evidence.hidden, flagged.hidden, strict=True):
        assert abs(after - none) == pytest.approx(max(abs(before - none) - margin, 0.0), abs=1e-9)
        assert (after - none) * (before - none) >= 0.0
