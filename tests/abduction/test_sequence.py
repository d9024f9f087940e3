"""Sequence models: symmetric inputs, times to visible, hop by hop as over a whole stream."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_sequence import column, evidence_of, sequence_model
from scipy.linalg import expm

from worldstate.abduction.sequence.markov_chain import balanced, transitions
from worldstate.abduction.sequence.sequence_inputs import INPUTS, sequence_inputs
from worldstate.abduction.sequence.sequence_model import (
    BoostedTrees,
)
from worldstate.abduction.sequence.sequence_reader import SequenceHistory, SequenceReader, SequenceReading
from worldstate.ground.serialisation import decode, encode
from worldstate.ground.values import NotUsable

SEEDS = st.integers(0, 2**32 - 1)


@given(SEEDS)
@settings(max_examples=20)
def test_inputs_of_the_mirrored_street_exchange_the_sides(seed: int) -> None:
    here = evidence_of(np.random.default_rng(seed), 60)
    there = here.copy()
    there[:, [column("left"), column("right")]] = here[:, [column("right"), column("left")]]
    there[:, column("bearing")] *= -1.0
    np.testing.assert_allclose(sequence_inputs(there), sequence_inputs(here)[:, ::-1], atol=1e-12)


def test_inputs_show_a_second_rise_after_the_loudest_hop() -> None:
    level = np.concatenate([np.linspace(0.0, 5.0, 20), np.linspace(4.9, 2.0, 30), np.linspace(2.1, 3.5, 10)])
    heard = evidence_of(np.random.default_rng(1), len(level))
    heard[:, column("loudness")] = level
    last = dict(zip(INPUTS, sequence_inputs(heard)[-1, 0], strict=True))
    found = [last[name] for name in ("since_loudest", "below_loudest", "above_dip")]
    assert found == [pytest.approx(4.0), pytest.approx(-1.5), pytest.approx(1.5)]


@pytest.mark.long
@given(SEEDS, st.integers(1, 900))
def test_levels_are_relative_to_a_quantile_of_the_last_minute(seed: int, hops: int) -> None:
    heard = evidence_of(np.random.default_rng(seed), hops)
    found = sequence_inputs(heard)[:, 0, [INPUTS.index("level"), INPUTS.index("visible_above")]]
    for at in {0, hops // 2, hops - 1}:
        pairs = (heard[:, column("level")], 0.2), (heard[:, column("visible")], 0.5)
        for value, (values, share) in zip(found[at], pairs, strict=True):
            usual = np.quantile(values[max(at - 599, 0) : at + 1], share, method="lower")
            assert value == values[at] - usual


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 2, 8, 9, 16, 33, 64]))
def test_trees_give_the_scores_of_a_walk_from_node_to_node(seed: int, leaves: int) -> None:
    rng = np.random.default_rng(seed)
    trees, nodes = 7, min(2 * leaves + 3, 127)  # Some nodes after the last leaf are unreachable
    yes, no = np.tile(np.arange(nodes), (2, trees, 1))
    for tree in range(trees):
        ends = [0]
        for child in range(1, 2 * int(rng.integers(1, leaves + 1)) - 1, 2):
            node = ends.pop(int(rng.integers(len(ends))))
            yes[tree, node], no[tree, node] = rng.permutation([child, child + 1])
            ends += [child, child + 1]
    split = rng.integers(3, size=(trees, nodes))
    threshold, value = rng.normal(size=(2, trees, nodes))
    classes = rng.integers(2, size=trees)
    X = rng.normal(size=(4, 3))
    X[0, 0] = threshold[0, 0]
    expected = np.tile([0.5, -0.5], (len(X), 1))
    for row, x in enumerate(X):
        for tree in range(trees):
            node = 0
            while yes[tree, node] != node:
                node = (yes if x[split[tree, node]] <= threshold[tree, node] else no)[tree, node]
            expected[row, classes[tree]] += value[tree, node]
    grown = BoostedTrees(split, threshold, yes, no, value, classes, np.array([0.5, -0.5]))
    np.testing.assert_allclose(grown.scores(X), expected, rtol=1e-12)
    np.testing.assert_array_equal(grown.scores(X[1:2]), grown.scores(X)[1:2])


# Shorter and longer than the minute of history that the reader keeps.
@given(st.integers(0, 2**32 - 1), st.sampled_from([15, 60, 620]))
@settings(max_examples=4)
def test_hop_by_hop_gives_the_posterior_of_the_whole_stream(seed: int, hops: int) -> None:
    rng = np.random.default_rng(seed)
    model, whole = sequence_model(rng), evidence_of(rng, hops)
    reader, said = SequenceReader(model), model.posterior(whole).groups
    for number, hop in enumerate(whole):
        reading = reader.read(hop[None])
        if number < 9:
            assert isinstance(reading, NotUsable)
        else:
            np.testing.assert_array_equal(reading.groups, said[number])


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=3)
def test_a_reader_continues_bit_for_bit_from_a_saved_history(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model, hops = sequence_model(rng), evidence_of(rng, 40)
    reader = SequenceReader(model)
    cut = int(rng.integers(0, 30))
    for hop in hops[:cut]:
        reader.read(hop[None])
    written = json.dumps(encode(reader.history), allow_nan=False)
    again = SequenceReader(model, decode(SequenceHistory, json.loads(written), "history"))
    for hop in hops[cut:]:
        here, there = reader.read(hop[None]), again.read(hop[None])
        if isinstance(here, SequenceReading):
            np.testing.assert_array_equal(here.groups, there.groups)
    assert isinstance(here, SequenceReading)


@given(SEEDS, st.integers(1, 10**9), st.integers(1, 10**9))
def test_a_balanced_chain_keeps_its_distribution_and_two_steps_are_one(seed: int, one: int, two: int) -> None:
    rng = np.random.default_rng(seed)
    chain, share = rng.dirichlet(np.ones(5), 5), 0.9 * rng.dirichlet(np.ones(5)) + 0.02
    rates_hz = balanced(0.9 * chain + 0.02, share) - np.eye(5)
    first, second, both = (transitions(rates_hz, step_ns) for step_ns in (one, two, one + two))
    np.testing.assert_allclose(first @ second, both, atol=1e-9)
    np.testing.assert_allclose(share @ both, share, atol=1e-7)
    np.testing.assert_allclose(np.eye(5)[0] @ transitions(rates_hz, 10**12), share, atol=1e-4)


@given(SEEDS, st.integers(1, 22), st.floats(-4.0, 2.0), st.integers(1, 10**10))
def test_a_step_is_the_matrix_exponential_of_its_rates(seed, states, scale, step_ns):
    rates_hz = np.random.default_rng(seed).exponential(10.0**scale, (states, states))
    np.fill_diagonal(rates_hz, 0.0)
    np.fill_diagonal(rates_hz, -rates_hz.sum(axis=1))
    np.testing.assert_allclose(transitions(rates_hz, step_ns), expm(rates_hz * (step_ns / 1e9)), atol=1e-11)
