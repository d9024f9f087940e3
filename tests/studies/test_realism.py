"""The comparison of simulated with real windows, on sets whose answer is known."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal

from worldstate.adapters.datasets.feature_table import FeatureTable, write_features
from worldstate.adapters.simulation import SITES
from worldstate.cli.main import main
from worldstate.cli.studies import realism as command
from worldstate.frontend.array.ovad_array import ovad_array
from worldstate.frontend.direction.feature import published_feature
from worldstate.ground.errors import InvalidArgumentError
from worldstate.studies.streets.realism import DESCRIPTORS, compare_windows, describe_windows
from worldstate.studies.streets.simulated_windows import (
    DECIMATION,
    NFFT,
    RATE_HZ,
    simulated_windows,
    window_feature,
)

LABELS = ("left", "right", "none", "front")


def windows(rng: np.random.Generator, n: int = 30, louder: float = 1.5, scale: float = 1.0) -> FeatureTable:
    """Smooth made-up windows of two junctions; hazards are `louder`."""
    labels = np.repeat(LABELS, n)
    bump = np.exp(-0.5 * ((np.arange(30) - rng.uniform(5, 25, (4 * n, 1))) / 4.0) ** 2)
    gain = np.where(labels == "none", 1.0, louder)[:, None] * rng.lognormal(0.0, 0.1, (4 * n, 1))
    features = scale * gain * np.tile(0.1 + 0.1 * bump, (1, 2))
    where = np.tile(["SA1", "SB1"], 2 * n)
    keys = np.array([str(i) for i in range(4 * n)])
    return FeatureTable(features, labels, keys, where, keys, (None,) * (4 * n))


def test_sets_of_one_kind_agree_and_cannot_be_told_apart():
    rng = np.random.default_rng(1)
    result = compare_windows(windows(rng), windows(rng), rng, draws=50)
    scale_rows = [row for row in result.medians if row.statistic in ("level", "peak")]
    assert len(scale_rows) == 2 * 2 * 3
    assert all(row.within for row in scale_rows)
    assert 0.35 < result.c2st["all"] < 0.65
    assert min(one.auroc for one in result.transfers) > 0.9
    assert set(result.to_dict()) == {"medians", "transfers", "c2st"}
    assert "C2ST all" in result.table()


def test_another_level_is_seen():
    rng = np.random.default_rng(2)
    result = compare_windows(windows(rng), windows(rng, scale=2.0), rng, draws=50)
    levels = [row for row in result.medians if row.statistic == "level"]
    assert levels
    assert not any(row.within for row in levels)
    assert result.c2st["all"] > 0.9


def test_a_gain_over_the_scalar_has_an_interval_around_the_difference():
    rng = np.random.default_rng(3)
    for one in compare_windows(windows(rng, louder=1.1), windows(rng, louder=1.1), rng, draws=100).transfers:
        assert one.gain[0] <= one.auroc - one.scalar <= one.gain[1]


def test_shape_does_not_depend_on_the_level():
    features = windows(np.random.default_rng(4)).features
    one, two = describe_windows(features), describe_windows(3.0 * features)
    for name in DESCRIPTORS:
        factor = 3.0 if name in ("level", "peak", "change") else 1.0
        np.testing.assert_allclose(two[name], factor * one[name], rtol=1e-9, atol=1e-12)


def test_a_set_without_hazards_is_refused():
    rng = np.random.default_rng(5)
    calm = windows(rng)
    with pytest.raises(InvalidArgumentError, match="simulated"):
        compare_windows(windows(rng), calm.select(calm.hazard_free), rng)


def test_the_feature_at_a_quarter_of_the_rate_is_the_published_one():
    """Band-limited noise from one side, at both rates: the same bins, hence the same feature."""
    rng, n = np.random.default_rng(6), 48_000
    offsets = ovad_array().centred_m
    spectrum = np.fft.rfft(rng.standard_normal(n + DECIMATION * NFFT))
    frequency = np.fft.rfftfreq(n + DECIMATION * NFFT, 1 / (DECIMATION * RATE_HZ))
    spectrum[frequency > 3000.0] = 0.0
    delays = -offsets @ np.array([np.cos(0.7), np.sin(0.7), 0.0]) / 343.0
    sound = np.fft.irfft(
        spectrum * np.exp(-2j * np.pi * frequency * delays[:, None]), n + DECIMATION * NFFT
    ).T
    sound += 0.3 * scipy.signal.lfilter([1.0], [1.0, -0.9], rng.standard_normal(sound.shape), axis=0)
    full = published_feature(sound[:n], ovad_array(), DECIMATION * RATE_HZ)
    quarter = window_feature(sound[:n:DECIMATION].astype(np.float32))
    assert full.max() > 1.2 * full.mean()
    # The independent noise beyond 6 kHz folds back at the lower rate; it is 20 dB down at 1 kHz.
    np.testing.assert_allclose(quarter, full, atol=0.12 * full.max())
    assert np.argmax(quarter[:30]) == np.argmax(full[:30])


def test_simulated_windows_are_laid_out_as_the_released_ones():
    table = simulated_windows(1, 3, sites=("SB1",))
    assert table.labels.tolist() == ["left", "front", "right", "front", "none", "none"]
    assert set(table.environments) == {"SB1"}
    assert table.features.shape == (6, 60)
    assert np.isfinite(table.features).all()
    assert (table.features > 0.0).all()
    assert len(np.unique(table.recordings)) == 4
    again = simulated_windows(1, 3, sites=("SB1",))
    np.testing.assert_array_equal(again.features, table.features)
    assert "SB1" in SITES


def test_windows_lie_where_the_released_program_cuts_them(monkeypatch):
    """They end at T0, a frame, or half a second later if the ego moves; the front window 1.5 s after."""
    ends, entries = {}, []

    def rendered(scene, rng):
        entries.append(scene.entry_s)
        return SimpleNamespace(audio=np.arange(round(scene.duration_s * RATE_HZ)))

    def feature(cut):
        assert len(cut) == round(RATE_HZ)
        ends.setdefault(len(entries), []).append(cut[-1] / RATE_HZ - entries[-1])
        return np.zeros(60)

    monkeypatch.setattr("worldstate.studies.streets.simulated_windows.simulate_recording", rendered)
    monkeypatch.setattr("worldstate.studies.streets.simulated_windows.window_feature", feature)
    table = simulated_windows(20, 1, sites=("SA1", "DA1"))
    hidden = np.array([found[0] for found in ends.values()])
    moving = np.array([name == "DA1" for name in table.environments[table.labels != "front"]])
    assert (np.abs(hidden[~moving] - 0.05) <= 0.0502).all()
    assert (np.abs(hidden[moving] - 0.55) <= 0.0502).all()
    assert np.ptp(hidden[moving]) > 0.08
    later = [found[1] - found[0] for found in ends.values() if len(found) == 2]
    assert len(later) == 80
    np.testing.assert_allclose(later, 1.5, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("group", "sites"), [("static", ("SA1", "SB1")), ("dynamic", ("DA1", "DB1"))])
def test_the_command_compares_the_windows_of_a_table(group, sites, tmp_path, capsys, monkeypatch):
    """Simulated windows of one seed against those of another, which take the part of the real ones."""
    monkeypatch.setattr(command, "WINDOWS", 8)
    monkeypatch.setattr(command, "SEEDS", (1,))
    write_features(tmp_path / "real.csv", simulated_windows(8, seed=9, sites=sites))
    words = ["realism", str(tmp_path / "real.csv"), "--group", group, "--out", str(tmp_path / "r"), "--json"]
    assert main(words) == 0
    report = json.loads(capsys.readouterr().out)
    assert json.loads((tmp_path / "r" / "realism.json").read_text()) == report
    assert set(report["realism"]) == {"1"}
    assert set(report["realism"]["1"]) == {"medians", "transfers", "c2st"}
    assert report["realism"]["1"]["c2st"]["all"] < 0.75


def test_a_table_without_the_group_is_refused_before_the_work(tmp_path, capsys):
    write_features(tmp_path / "real.csv", windows(np.random.default_rng(0), n=2))
    assert main(["realism", str(tmp_path / "real.csv"), "--group", "dynamic"]) == 2
    assert "dynamic" in capsys.readouterr().err
