"""The domain guard: verdicts against scipy's softmax, files and flagged evidence."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import softmax

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.abduction.road_users import DomainGuard, Familiar, Foreign, WarningSignal, neutral
from worldstate.ground.serialisation import decode, encode

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
    assert isinstance(GUARD.judge(np.zeros(2)), Familiar)
    speech, music = GUARD.judge(np.array([6.0, 1.0])), GUARD.judge(np.array([6.0, -1.0]))
    assert isinstance(speech, Foreign) and speech.reason == "sounds like speech"
    assert isinstance(music, Foreign) and music.reason == "sounds like music"
    siren = GUARD.judge(np.array([0.0, 5.5]))
    assert isinstance(siren, WarningSignal) and siren.signal == "siren"


@given(measures)
def test_a_signal_must_exceed_foreign_sounds_by_its_margin(x: np.ndarray) -> None:
    share = softmax(GUARD.weights @ x + GUARD.biases)
    verdict, nats = GUARD.judge(x), np.log(share[3]) - np.log(share[1] + share[2])
    assert isinstance(verdict, WarningSignal) == (verdict.log_odds > 0.0 and nats > 1.0)


@given(measures)
def test_a_file_gives_the_same_verdict(x: np.ndarray) -> None:
    assert decode(DomainGuard, encode(GUARD), "guard").judge(x) == GUARD.judge(x)


levels = st.floats(-20.0, 20.0)


@given(levels, levels, levels, levels, st.floats(0.0, 10.0))
def test_flagged_evidence_shrinks_by_the_margin_towards_neutral(
    left: float, right: float, visible: float, none: float, margin: float
) -> None:
    evidence = SignatureEvidence(("left", "right"), (left, right), visible, none)
    flagged = neutral(evidence, margin)
    assert (flagged.visible, flagged.none) == (visible, none)
    for before, after in zip(evidence.hidden, flagged.hidden, strict=True):
        assert abs(after - none) == pytest.approx(max(abs(before - none) - margin, 0.0), abs=1e-9)
        assert (after - none) * (before - none) >= 0.0
