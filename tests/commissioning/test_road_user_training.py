"""Training of road users on known clusters and one simulated junction."""

from dataclasses import replace

import numpy as np
import pytest
from worldstate_lab.cli.kinds import road_user_exam

from worldstate.adapters.files.model_file import read_model
from worldstate.commissioning.guard_training import characters
from worldstate.commissioning.heard_stream import junction_named
from worldstate.commissioning.road_user_training import (
    CLASS_OF,
    CLASSES,
    RoadUserRows,
    fit_road_users,
    road_user_rows,
    town_shares,
)
from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.frontend.spectra.sound_character import BANDS, MEASURES
from worldstate.ground.typing import FloatArray
from worldstate.simulation.scene.kinds import KINDS
from worldstate.simulation.stream.close_sounds import close_vehicle, recorded
from worldstate.simulation.stream.settings import StreamSettings

N_INPUTS, EACH, SITES = len(MEASURES) + len(BANDS), 100, ("one", "two", "three")


def made_up_rows(seed: int, apart: float = 4.0) -> RoadUserRows:
    """Draw clusters: each kind on its own axis, inaudible vehicles at the origin."""
    rng = np.random.default_rng(seed)
    kinds = np.array([kind for kind in CLASS_OF for _ in range(EACH)] * len(SITES))
    audible = rng.random(len(kinds)) < 0.8
    centres = apart * np.stack([np.eye(N_INPUTS)[list(CLASS_OF).index(kind)] for kind in kinds.tolist()])
    measures = rng.standard_normal((len(kinds), N_INPUTS)) + centres * audible[:, None]
    sites = np.repeat(SITES, len(kinds) // len(SITES))
    return RoadUserRows(measures, kinds, sites, audible, rng.random(len(kinds)) < 0.9)


def test_distinct_classes_are_separated_and_equal_ones_have_the_prior() -> None:
    rows, fresh = made_up_rows(1), made_up_rows(2)
    found = road_user_exam(rows)
    assert found["log_loss"] < 0.7 * found["prior_log_loss"]
    assert found["recall_of_equals"][:-1].min() > 0.5
    np.testing.assert_allclose(found["confusion"].sum(axis=1), 1.0, atol=1e-9)
    # Classes have the shares of a town, although kinds are drawn equally often.
    said = fit_road_users(rows).probabilities(fresh.measures)
    expected = np.average(said, axis=0, weights=fresh.weights)
    np.testing.assert_allclose(expected, town_shares(fresh), atol=0.1)
    # Random labels have nothing to learn.
    dealt = replace(rows, kinds=np.random.default_rng(3).permutation(rows.kinds))
    nothing = road_user_exam(replace(dealt, measures=made_up_rows(4, apart=0.0).measures))
    assert nothing["log_loss"] > 0.8 * nothing["prior_log_loss"]


@pytest.mark.slow
def test_simulated_vehicles_are_audible_before_sight() -> None:
    rows = road_user_rows(ovad_array(), ["SB1"], 6000.0, np.random.default_rng(1))
    names = np.array(CLASSES)[rows.classes]
    audible = {
        kind: float((names[(rows.kinds == kind) & rows.counts] != "unknown").mean()) for kind in CLASS_OF
    }
    assert audible["heavy"] > 0.95
    assert audible["light"] > 0.8
    assert audible["bicycle"] < 0.5
    assert rows.weights.sum() == pytest.approx(1.0)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["light", "tram"])
def test_kinds_are_robust_to_the_slope_of_a_recorder(kind: str) -> None:
    """New clips through a filter of 6 dB from 80 to 2,700 Hz with the shipped model."""
    model, rng, rate_hz = read_model().road_users, np.random.default_rng(3), 6000.0
    assert model is not None
    street = StreamSettings(junction_named("SA1"), 1.0, sample_rate_hz=rate_hz)
    said = {tilt_db: list[FloatArray]() for tilt_db in (0.0, 6.0, -6.0)}
    for _ in range(12):
        passing = close_vehicle(KINDS[kind], street.preset, street.site, 4.0, rate_hz, rng)
        dry = recorded(passing, rate_hz, rng)
        octaves = np.log2(np.clip(np.fft.rfftfreq(len(dry), 1.0 / rate_hz), 80.0, 2700.0) / 80.0)
        for tilt_db, means in said.items():
            gain = 10.0 ** (tilt_db * octaves / np.log2(2700.0 / 80.0) / 20.0)
            sound = np.fft.irfft(np.fft.rfft(dry) * gain, len(dry)).astype(np.float32)
            means.append(model.probabilities(characters(sound, rate_hz)[0]).mean(axis=0))
    as_it_is = np.mean(said[0.0], axis=0)
    assert as_it_is[model.classes.index(CLASS_OF[kind])] > 0.25
    for tilt_db in (6.0, -6.0):
        assert np.abs(np.mean(said[tilt_db], axis=0) - as_it_is).max() < 0.06
