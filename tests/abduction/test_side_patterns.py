"""Sound patterns of the two arms, learned from passes, against scikit-learn's discriminant."""

import json
import logging
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_sequence import evidence_of, sequence_model
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

from worldstate.abduction.sequence.sequence_model import COMING_S, GROUPS
from worldstate.abduction.sequence.sequence_reader import SequenceReader
from worldstate.abduction.sequence.street_sides import (
    SECTORS,
    PassSound,
    SidePatterns,
    StreetHearing,
    StreetListener,
)
from worldstate.adapters.files.acoustic_domain import heard_with
from worldstate.adapters.files.model_file import read_model
from worldstate.adapters.listener import listen_steps
from worldstate.adapters.source import ListenSettings, open_source, street_listener
from worldstate.ground.serialisation import decode, encode
from worldstate.smoothing.learned_street import LearnedStreet, StreetPass, forgotten, with_pass

OTHER = GROUPS.index("other")
SLOPE = np.linspace(1.0, -1.0, SECTORS)


def passes_of(rng: np.random.Generator, count: int, hops: int = 30) -> list[tuple[str, PassSound]]:
    """Return noisy passes that are louder on their own side."""
    arms = [("left", 1.0), ("right", -1.0)] * count
    sounds = [sign * 0.3 * SLOPE + rng.normal(0.0, 0.4, (hops, SECTORS)) for _, sign in arms]
    return [
        (arm, PassSound(x - x.mean(axis=1, keepdims=True), np.ones(hops), "roof"))
        for (arm, _), x in zip(arms, sounds, strict=True)
    ]


def learned(passes: list[tuple[str, PassSound]]) -> SidePatterns:
    known = SidePatterns()
    for arm, sound in passes:
        known = known.with_pass(arm, sound)
    return known


def test_many_passes_give_fishers_discriminant():
    passes = passes_of(np.random.default_rng(0), 400)
    sides = learned(passes).sides()
    x = np.concatenate([sound.patterns for _, sound in passes])
    y = np.repeat([arm == "left" for arm, _ in passes], 30)
    peer = LinearDiscriminantAnalysis(solver="lsqr", shrinkage=0.1).fit(x, y)
    assert sides.weights == pytest.approx(peer.coef_[0], rel=0.02, abs=0.02)
    assert sides.offset == pytest.approx(peer.intercept_[0], abs=0.02)
    assert sides.certainty > 0.99


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_patterns_change_the_side_and_not_the_existence(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sides = learned(passes_of(rng, 3)).sides()
    groups, feature = rng.dirichlet(np.ones(len(GROUPS)), (5, 2)), rng.lognormal(0.0, 1.0, (5, 60))
    turned, told = sides.turned(groups, feature), sides.log_ratio(feature)
    np.testing.assert_allclose(turned.sum(axis=-1), 1.0, atol=1e-12)
    assert (turned >= 0.0).all()
    untouched = slice(len(COMING_S), OTHER), slice(OTHER + 1, None)
    for one in untouched:
        np.testing.assert_array_equal(turned[..., one], groups[..., one])

    def odds(of: np.ndarray) -> np.ndarray:
        return np.log(of[..., : len(COMING_S)].sum(axis=-1)) - np.log(of[..., OTHER])

    np.testing.assert_allclose(odds(turned) - odds(groups), np.stack([told, -told], axis=1), atol=1e-6)


def test_patterns_need_both_arms_and_gain_weight_with_passes():
    passes = passes_of(np.random.default_rng(2), 8)
    assert learned([one for one in passes if one[0] == "left"]).sides() is None
    of_the_left = np.exp(np.repeat(SLOPE, 5))[None]
    told = [float(learned(passes[: 2 * n]).sides().log_ratio(of_the_left)[0]) for n in (1, 8)]
    assert 0.0 < told[0] < told[1] < 3.0


def test_patterns_of_another_array_are_not_used(caplog):
    known = learned(passes_of(np.random.default_rng(4), 3))
    arm, sound = passes_of(np.random.default_rng(5), 1)[0]
    again = known.with_pass(arm, PassSound(sound.patterns, sound.weights, "bumper"))
    assert again.weights == (1.0, 0.0)
    domain = read_model(None).domain
    with caplog.at_level(logging.WARNING):
        assert street_listener(domain, known, None).hearing.known == SidePatterns(heard_with(domain))
    assert "another array (roof)" in caplog.text
    mine = replace(known, heard_by=heard_with(domain))
    assert street_listener(domain, mine, None).hearing.known == mine


def heard_hop(rng: np.random.Generator, slope: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a hop with an approaching vehicle of unknown side, louder on one side."""
    groups = np.zeros((2, len(GROUPS)))
    groups[:, 3], groups[:, OTHER], groups[:, -1] = 0.4, 0.4, 0.2
    return groups, np.exp(np.repeat(slope * SLOPE, 5) + rng.normal(0.0, 0.3, 60))


def told_of(listener: StreetListener, rng: np.random.Generator, slope: float, hops: int = 40) -> float:
    """Return P(vehicle from the left) after some hops."""
    for _ in range(hops):
        groups = listener.turned(*heard_hop(rng, slope))
    return float(groups[0, 3])


def test_hand_overs_teach_the_side_and_checkpoints_continue_exactly():
    rng = np.random.default_rng(8)
    listener = StreetListener(StreetHearing(SidePatterns("roof")))
    for arm, slope in (("left", 0.5), ("right", -0.5)) * 3:
        told_of(listener, rng, slope)
        listener.passed(arm)
    assert told_of(listener, rng, 0.5) > 0.6
    assert told_of(listener, rng, -0.5) < 0.2
    written = json.dumps(encode(listener.hearing), allow_nan=False)
    again = StreetListener(decode(StreetHearing, json.loads(written), "street"))
    for arm in ("left", "right"):
        groups, feature = heard_hop(rng, 0.5)
        np.testing.assert_array_equal(listener.turned(groups, feature), again.turned(groups, feature))
        listener.passed(arm)
        again.passed(arm)
    assert listener.hearing.known == again.hearing.known


def test_patterns_are_not_applied_for_three_seconds_after_a_pass():
    known = learned(passes_of(np.random.default_rng(5), 1))
    listener, left = StreetListener(StreetHearing(known)), np.exp(np.linspace(1.0, -1.0, 60))
    even = np.full((2, len(GROUPS)), 1.0 / len(GROUPS))
    assert (listener.turned(even, left) != even).any()
    listener.passed("right")
    turned = [bool((listener.turned(even, left) != even).any()) for _ in range(31)]
    assert turned == [hop >= 29 for hop in range(31)]


def test_a_known_street_corrects_the_sides_of_a_reading() -> None:
    rng = np.random.default_rng(5)
    model, hops = sequence_model(rng), evidence_of(rng, 12)
    known, of_the_left = learned(passes_of(rng, 1)), np.arange(60, 0, -1.0)
    plain, corrected = (
        SequenceReader(model),
        SequenceReader(model, street=StreetListener(StreetHearing(known))),
    )
    for hop in hops:
        usual, told = plain.read(hop[None]), corrected.read(hop[None], of_the_left)
    np.testing.assert_array_equal(told.groups, known.sides().turned(usual.groups[None], of_the_left[None])[0])
    assert not np.array_equal(told.groups, usual.groups)


def test_overlapping_passes_of_both_arms_teach_nothing():
    rng = np.random.default_rng(9)
    listener = StreetListener(StreetHearing(SidePatterns("roof")))
    told_of(listener, rng, 0.5)
    listener.passed("left")
    told_of(listener, rng, 0.5, hops=10)
    before = listener.hearing.known
    listener.passed("right")
    assert listener.hearing.known == before
    listener.interrupt()
    assert len(listener.hearing.recent) == 0
    listener.passed("right")
    assert listener.hearing.known == before


@pytest.mark.long
@pytest.mark.parametrize("adapts", [True, False])
def test_a_hand_over_teaches_the_street(adapts, approach):
    settings = ListenSettings(site_adaptation=adapts)
    *_, last = listen_steps(open_source(approach.folder, settings=settings))
    assert (sum(last.checkpoint.street.known.weights) > 0.0) == adapts


def test_a_street_keeps_patterns_and_forgets_them_slowly():
    street = LearnedStreet()
    for arm, sound in passes_of(np.random.default_rng(6), 3):
        street = with_pass(street, StreetPass(arm, None, None, sound=sound))
    later = forgotten(street, 30 * 86400.0).patterns
    assert later.weights == pytest.approx(tuple(3.0 * np.exp(-1.0) for _ in range(2)))
    assert later.sides().certainty < street.patterns.sides().certainty
