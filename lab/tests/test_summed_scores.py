"""Sums of sequence, window and levels: their terms, and the training on simulated streams."""

import numpy as np
import pytest
from hop_tables import heard_stream
from worldstate_lab.sequences.summed_scores import OTHERS, LevelReading, summed_scores
from worldstate_lab.trials.trial import Trial

from worldstate.abduction.sequence.sequence_inputs import COLUMNS, sequence_inputs
from worldstate.adapters.files.model_file import read_model
from worldstate.commissioning.commission import parts_of, stream_evidence
from worldstate.commissioning.sequence_training import stream_truth
from worldstate.operations.recordings.hop_table import HopTable

VEHICLES = (("left", 20.0), ("right", 35.0), ("left", 50.0), ("right", 65.0))
BANDS, RISES_S = 12, 5.0


def stream(vehicles, seed, duration_s=75.0):
    """Return a stream that grows louder for five seconds before each T0, from the side of its vehicle."""
    rng = np.random.default_rng(seed)
    time_s = np.round(np.arange(1.0, duration_s, 0.1), 1)
    loud, bearing = np.zeros(len(time_s)), np.zeros(len(time_s))
    rows = []
    for number, (arm, t0_s) in enumerate(vehicles):
        near = (time_s > t0_s - RISES_S) & (time_s <= t0_s)
        loud[near], bearing[near] = time_s[near] - t0_s + RISES_S, 0.8 if arm == "left" else -0.8
        rows += [(number, moment, 5.0, 5.0, False, 60.0) for moment in time_s[near]]
    hops = {
        "time_s": time_s,
        "feature": rng.uniform(0.9, 1.1, (len(time_s), 60)),
        "band_log_energy": loud[:, None] + 0.2 * rng.normal(size=(len(time_s), BANDS)),
        "prominence": np.exp(0.1 + 0.1 * loud),
        "looming_hz": np.full(len(time_s), np.nan),
        "looming_std_hz": np.full(len(time_s), np.nan),
        "bearing_rad": bearing + 0.05 * rng.normal(size=len(time_s)),
    }
    told = [(number, arm, "light", arm, t0_s, True) for number, (arm, t0_s) in enumerate(vehicles)]
    return heard_stream(told, rows, hops, site="SA101")


@pytest.fixture(scope="module")
def model():
    return read_model(None)


@pytest.fixture(scope="module")
def streams():
    return [stream(VEHICLES, 0), stream((), 1)]


@pytest.fixture(scope="module")
def reading(streams, model):
    return LevelReading.learned(streams, model)


def trial(columns, unknown=0):
    """Return a recording whose first hops have no columns."""
    n = len(columns)
    given = np.array(columns)
    given[:unknown] = np.nan
    rng = np.random.default_rng(3)
    hops = {
        "time_s": 1.0 + 0.1 * np.arange(n),
        "inputs": given,
        "side_nats": rng.normal(size=(n, 2)),
        "compared_nats": rng.normal(size=(n, 2)),
        "shipped": rng.normal(size=(n, 4)),
    }
    about = {"site": "SA1", "prior": {"shipped": [0.1, 0.1, 0.2, 0.6]}}
    return Trial(HopTable(hops, "a", "left", 7.0, about))


def test_35_of_68_inputs_are_not_window_evidence() -> None:
    columns = np.random.default_rng(0).uniform(0.5, 2.0, size=(40, len(COLUMNS)))
    changed = columns.copy()
    changed[:, :3] += np.random.default_rng(1).normal(size=(40, 3))
    assert len(OTHERS) == 35
    reading = LevelReading(np.ones(35), 0.0, 0.0)
    assert np.array_equal(reading.log_odds(columns), reading.log_odds(changed))
    assert not np.allclose(sequence_inputs(columns), sequence_inputs(changed))


def test_sound_that_grows_louder_on_a_side_comes_from_there(reading, model) -> None:
    other = stream((("right", 15.0),), seed=7, duration_s=20.0)
    said = reading.log_odds(stream_evidence(parts_of(model)[0], other))
    coming = stream_truth(other).coming_s[:, 1] <= 2.0
    early = other.hops.time_s < 9.0
    assert said[coming, 1].min() > said[early].max()
    assert (said[coming, 1] > said[coming, 0]).all()


def test_a_hop_without_columns_has_the_usual_log_odds(reading, model, streams) -> None:
    columns = stream_evidence(parts_of(model)[0], streams[0])[:30]
    missing = columns.copy()
    missing[:4] = np.nan
    said = reading.log_odds(missing)
    assert (said[:4] == reading.usual).all()
    assert np.array_equal(said[4:], reading.log_odds(columns[4:]))
    assert (reading.log_odds(np.full((3, len(COLUMNS)), np.nan)) == reading.usual).all()


def test_sums_are_means_of_their_terms_over_three_hops(streams, model) -> None:
    columns = stream_evidence(parts_of(model)[0], streams[0])
    # The path of two microphones has one hop more.
    seven, pair = trial(columns[100:150]), trial(columns[160:211], unknown=3)
    found = {
        name: one[0]
        for name, one in summed_scores([seven], [pair], LevelReading.learned(streams, model), model).items()
    }
    assert all(one.shape == (50,) and np.isfinite(one).all() for one in found.values())
    parts = ("sequence, levels of both channels", "side ratio", "logistic")
    whole = found["sequence + side ratio + logistic"]
    assert np.allclose(whole, sum(found[name] for name in parts))
    ratio = seven.hops.side_nats.max(axis=1)
    assert np.allclose(found["side ratio"][2:], (ratio[2:] + ratio[1:-1] + ratio[:-2]) / 3.0)
    assert np.array_equal(found["sequence, as published"], seven.hops.compared_nats.max(axis=1))


def test_levels_of_both_channels_are_those_of_the_pair(streams, model) -> None:
    columns = stream_evidence(parts_of(model)[0], streams[0])
    seven, same, louder = (trial(columns[first : first + 60]) for first in (0, 0, 150))
    names = [f"sequence, levels of {which}, one hop" for which in ("one channel", "both channels")]
    found = summed_scores([seven, seven], [same, louder], LevelReading.learned(streams, model), model)
    one, both = (found[name] for name in names)
    assert np.array_equal(one[0], both[0])
    assert np.array_equal(one[0], one[1])
    assert not np.allclose(one[1], both[1])
