"""A sequence model applied hop by hop gives the posterior of the whole stream, also after a checkpoint."""

import json

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_sequence import evidence_of, sequence_model

from worldstate.abduction.sequence.sequence_reader import SequenceHistory, SequenceReader, SequenceReading
from worldstate.abduction.sequence.street_sides import (
    SECTORS,
    PassSound,
    SidePatterns,
    StreetHearing,
    StreetListener,
)
from worldstate.ground.serialisation import decode, encode
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import NotUsable


def _hops(whole: FloatArray) -> list[FloatArray]:
    return [whole[at : at + 1] for at in range(len(whole))]


# Shorter and longer than the minute of history that the reader keeps.
@given(st.integers(0, 2**32 - 1), st.sampled_from([15, 60, 620]))
@settings(max_examples=4)
def test_hop_by_hop_gives_the_posterior_of_the_whole_stream(seed: int, hops: int) -> None:
    rng = np.random.default_rng(seed)
    model, whole = sequence_model(rng), evidence_of(rng, hops)
    reader, said = SequenceReader(model), model.posterior(whole).groups
    for number, hop in enumerate(_hops(whole)):
        reading = reader.read(hop)
        if number < 9:
            assert isinstance(reading, NotUsable)
        else:
            assert isinstance(reading, SequenceReading)
            np.testing.assert_array_equal(reading.groups, said[number])


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=3)
def test_a_reader_continues_bit_for_bit_from_a_saved_history(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model, hops = sequence_model(rng), _hops(evidence_of(rng, 40))
    reader = SequenceReader(model)
    cut = int(rng.integers(0, 30))
    for hop in hops[:cut]:
        reader.read(hop)
    written = json.dumps(encode(reader.history), allow_nan=False)
    again = SequenceReader(model, decode(SequenceHistory, json.loads(written), "history"))
    for hop in hops[cut:]:
        here, there = reader.read(hop), again.read(hop)
        if isinstance(here, SequenceReading):
            np.testing.assert_array_equal(here.groups, there.groups)
    assert isinstance(here, SequenceReading)


def test_a_known_street_corrects_the_sides_of_a_reading() -> None:
    rng = np.random.default_rng(5)
    model, hops = sequence_model(rng), _hops(evidence_of(rng, 12))
    known = SidePatterns("roof")
    for arm, sign in (("left", 1.0), ("right", -1.0)):
        patterns = sign * np.linspace(1.0, -1.0, SECTORS) + rng.normal(0.0, 0.3, (30, SECTORS))
        known = known.with_pass(arm, PassSound(patterns, np.ones(30), "roof"))
    plain = SequenceReader(model)
    turned = SequenceReader(model, street=StreetListener(StreetHearing(known)))
    of_the_left = np.arange(60, 0, -1.0)
    for hop in hops:
        usual, told = plain.read(hop), turned.read(hop, of_the_left)
    assert isinstance(usual, SequenceReading)
    assert isinstance(told, SequenceReading)
    np.testing.assert_array_equal(told.groups, known.sides().turned(usual.groups[None], of_the_left[None])[0])
    assert not np.array_equal(told.groups, usual.groups)
