"""Windows of streams and of sources in the open; renderings for several arrays."""

from dataclasses import replace

import numpy as np
import pytest
from hop_tables import heard_stream
from hypothesis import given
from hypothesis import strategies as st

from worldstate.abduction.signature.ensemble import SMALLEST_LEVEL
from worldstate.abduction.signature.ensemble_training import SimulatedWindows
from worldstate.abduction.signature.site_estimate import SiteSignature
from worldstate.abduction.signature.window_classes import WINDOW_CLASSES, side_ratios
from worldstate.adapters.datasets.feature_table import FeatureTable, write_features
from worldstate.adapters.files.acoustic_domain import domain_of
from worldstate.adapters.files.model_file import read_model
from worldstate.cli.main import main
from worldstate.commissioning import commission
from worldstate.commissioning.commission import windows_of_array
from worldstate.commissioning.heard_stream import CommissionSettings, hear_stream, mountings
from worldstate.commissioning.simulated_windows import (
    WEIGHT,
    OpenSource,
    hop_labels,
    open_feature,
    open_field_windows,
    posteriors_along,
    stream_windows,
)
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.errors import OutOfDomainError
from worldstate.simulation import site
from worldstate.simulation.stream.settings import StreamSettings

TIME_S = np.round(np.arange(1.0, 60.0, 0.1), 1)


def stream(*vehicles, site="SA1", rng=None):
    """Return vehicles by kind, arm and entry, each in view for three seconds."""
    features = np.ones((len(TIME_S), 60)) if rng is None else rng.uniform(0.05, 0.9, (len(TIME_S), 60))
    told = [(i, arm, kind, arm, entry, True) for i, (kind, arm, entry) in enumerate(vehicles)]
    entries = enumerate(entry for _, _, entry in vehicles)
    rows = [(i, t, 8.0, 1.0, entry <= t <= entry + 3.0, 0.0) for i, entry in entries for t in TIME_S]
    return heard_stream(told, rows, {"time_s": TIME_S, "feature": features}, site=site)


def label_at(labels, time_s):
    return labels[np.abs(TIME_S - time_s).argmin()]


# The second after the vehicle has left still contains it, so no empty window follows at once.
STANDING = {
    5.0: "none",
    18.5: "",
    19.5: "left",
    20.0: "left",
    20.2: "",
    21.5: "front",
    23.5: "",
    24.2: "none",
}
# Windows of a moving ego are half a second later.
MOVING = {18.5: "", 19.5: "left", 20.5: "left", 20.7: "", 21.5: "front", 24.2: "none"}


@pytest.mark.parametrize(("site", "times"), [("SA1", STANDING), ("DA1", MOVING)])
def test_windows_have_kind_arm_and_time_of_a_vehicle(site, times):
    labels = hop_labels(stream(("light", "left", 20.0), ("light", "right", 40.0), site=site))
    assert {time: label_at(labels, time) for time in times} == times


def test_two_vehicles_within_1_5_s_are_labelled_both():
    near = hop_labels(stream(("light", "left", 30.0), ("light", "right", 31.2)))
    assert {label_at(near, time) for time in (29.2, 29.9)} == {"both"}
    # The first vehicle, in view, masks the second.
    assert label_at(near, 30.8) == ""
    far = hop_labels(stream(("light", "left", 30.0), ("light", "right", 35.0)))
    assert label_at(far, 29.5) == "left" and label_at(far, 34.9) == "right"


def test_a_bicycle_gives_neither_hidden_nor_empty_windows():
    labels = hop_labels(stream(("bicycle", "left", 30.0)))
    assert {label_at(labels, time) for time in (26.0, 29.0, 30.0)} == {""}
    beside = hop_labels(stream(("bicycle", "left", 30.0), ("light", "right", 30.2)))
    assert label_at(beside, 29.8) == ""


def test_classes_have_the_weights_of_the_released_windows():
    rng = np.random.default_rng(1)
    parts = [stream(("light", "left", 30.0), site=name, rng=rng) for name in ("SA1", "SB1")]
    found = stream_windows(parts)
    hidden = np.isin(found.y, ("left", "right", "both"))
    mass = {name: found.weights[found.y == name].sum() for name in ("front", "none")}
    assert mass == pytest.approx(dict.fromkeys(mass, found.weights[hidden].sum()))
    assert (found.weights[hidden] == WEIGHT).all()
    np.testing.assert_array_equal(found.at(["SA1"]).X, stream_windows(parts[:1]).X)
    # An open field belongs to no site, so its windows are always present.
    everything = SimulatedWindows.joined([found, open_field_windows(np.ones((3, 60)))])
    assert len(everything.at(["SB1"]).y) == (found.sites == "SB1").sum() + 3
    assert len(everything.at([]).y) == 3


def test_posteriors_of_a_stream_equal_those_of_the_running_model():
    model, features = read_model().signature, np.random.default_rng(2).uniform(SMALLEST_LEVEL, 1.0, (8, 60))
    running = SiteSignature(model)
    by_hop = [running.evidence(feature).sides.log_ratios for feature in features]
    found = side_ratios(posteriors_along(model, features), model.classes, model.class_prior)
    np.testing.assert_allclose(found, by_hop, atol=1e-9)


@pytest.mark.slow
def test_the_card_counts_the_classes_of_learned_streams(tmp_path):
    rng = np.random.default_rng(5)
    both = stream(("light", "left", 30.0), ("light", "right", 30.5), ("light", "left", 50.0), rng=rng)
    both.save(tmp_path / "heard.npz")
    n, names = 240, np.tile(["front", "left", "none", "right"], 60)
    keys, sites = np.arange(n).astype(str), np.tile(["SA1", "SB1"], n // 2)
    table = FeatureTable(rng.uniform(0.05, 0.9, (n, 60)), names, keys, sites, keys, (None,) * n)
    real, learned, out = (str(tmp_path / name) for name in ("real.csv", "heard.npz", "m"))
    write_features(real, table)
    assert main(["model", "fit", real, "--streams", learned, "--out", out]) == 0
    model = read_model(tmp_path / "m")
    assert model.signature.classes == WINDOW_CLASSES
    assert "180 direct" in model.provenance.classifier and " both" in model.provenance.classifier
    # The hypotheses of the policies are hidden on either side, in view, and none.
    assert len(model.policies.policies[0].reference_prior) == 4
    assert sum(model.policies.policies[0].reference_prior) == pytest.approx(1.0)


ANGLES = np.arange(8) * np.pi / 4
RING = MicrophoneArray(0.15 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES), np.zeros(8)]))


@pytest.mark.parametrize("azimuth_deg", [-60.0, 0.0, 45.0])
def test_the_feature_of_a_source_in_the_open_peaks_at_its_azimuth(azimuth_deg):
    rng = np.random.default_rng(3)
    loud = OpenSource(np.radians(azimuth_deg), 12.0, (0.0, 0.0), snr_db=25.0)
    early, late = open_feature(RING, loud, rng).reshape(2, 30)
    # Azimuths of the feature increase to the right.
    there = np.linspace(-90.0, 90.0, 30)
    for half in (early, late):
        assert there[half.argmax()] == pytest.approx(-azimuth_deg, abs=8.0)
    lost = open_feature(RING, OpenSource(loud.azimuth_rad, 12.0, (0.0, 0.0), -30.0), rng)
    assert np.ptp(lost) < 0.5 * np.ptp(early)


ARRAY = MicrophoneArray([[0.1, 0.2, 0.0], [0.0, 0.05, 0.1], [0.0, -0.1, 0.0], [-0.1, -0.25, 0.2]])


@given(st.floats(-np.pi, np.pi))
def test_a_turned_array_turns_the_bearing(azimuth_rad: float) -> None:
    _, turned, _ = mountings(ARRAY, np.random.default_rng(1)).values()
    np.testing.assert_allclose(
        turned.delays_s(azimuth_rad + np.radians(2.0)), ARRAY.delays_s(azimuth_rad), atol=1e-12
    )


def test_one_rendering_serves_all_arrays() -> None:
    settings = StreamSettings(site("SB1"), minutes=0.05, sample_rate_hz=6000.0)
    mounted = list(mountings(ARRAY, np.random.default_rng(1)).values())
    right, turned, _ = hear_stream(settings, [ARRAY], [mounted])
    (alone,) = hear_stream(settings, [ARRAY])
    for name, column in alone.hops.columns.items():
        np.testing.assert_array_equal(right.hops.columns[name], column, err_msg=name)
    assert not np.array_equal(turned.hops.feature, right.hops.feature)


def test_renderings_are_reused_for_other_arrays(tmp_path, monkeypatch) -> None:
    """A second array needs no new rendering, and its sound is the same as alone."""
    settings = StreamSettings(site("SB1"), minutes=0.05, sample_rate_hz=6000.0)
    board = MicrophoneArray(ARRAY.positions_m[:3] * [1.0, 0.5, 1.0])
    (expected,) = hear_stream(settings, [board])
    list(commission.heard_streams([settings], ARRAY, tmp_path, beside=[board]))
    monkeypatch.delattr(commission, "hear_stream")
    (kept,) = commission.heard_streams([settings], board, tmp_path)
    np.testing.assert_allclose(kept.hops.feature, expected.hops.feature, atol=1e-5)
    np.testing.assert_array_equal(kept.hops.time_s, expected.hops.time_s)


def test_tables_of_another_array_raise_an_error() -> None:
    names, here = np.array(["SA1", "SB1", "SB2"]), domain_of(ARRAY, [6000.0], ["SA101"])
    table = FeatureTable(np.ones((3, 60)), np.array(["left"] * 3), names, names, names, (None,) * 3)
    kept = windows_of_array(table, CommissionSettings(leave_out=("SB1",)), here)
    assert kept.environments.tolist() == ["SA1", "SB2"]
    # Without its domain a commissioned model would have no budget and no times.
    assert kept.domain is here
    elsewhere = domain_of(MicrophoneArray(ARRAY.positions_m * [1.0, 1.1, 1.0]), [6000.0], ["SA1"])
    with pytest.raises(OutOfDomainError, match="not the array"):
        windows_of_array(replace(table, domain=elsewhere), CommissionSettings(), here)
