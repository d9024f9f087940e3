"""Achieved variance beside its bound: the numbers behind the figures of `worldstate array bounds`."""

import json

import numpy as np
import pytest
from scipy.stats import norm

from worldstate.adapters.files.array_file import write_array_xml
from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.ground.errors import InvalidArgumentError
from worldstate.operations.arrays.efficiency import (
    Efficiency,
    bearing_trial,
    delay_trial,
    measure_over_snr,
    measure_toward_endfire,
    tone_trial,
)

ROOF = roof_array_56()
TRIALS = {
    "real tone": tone_trial(complex_signal=False),
    "complex tone": tone_trial(complex_signal=True),
    "delay": delay_trial(),
    "bearing, 56": bearing_trial(ROOF),
    "bearing, 14": bearing_trial(MicrophoneArray(ROOF.positions_m[::4])),
}


@pytest.mark.parametrize("name", TRIALS)
def test_high_snr_is_within_a_decibel_and_a_half(name: str) -> None:
    found = measure_over_snr(TRIALS[name], [15.0, 25.0], 300, np.random.default_rng(len(name)))
    low, _ = found.sampling_db()
    assert (found.ratio_db > low).all()
    assert (found.ratio_db < 1.5).all()


@pytest.mark.parametrize("name", ["real tone", "complex tone", "delay", "bearing, 14"])
def test_below_the_threshold_another_lobe_wins(name: str) -> None:
    found = measure_over_snr(TRIALS[name], [-15.0], 60, np.random.default_rng(0))
    assert found.ratio_db[0] > 10.0


def test_toward_endfire_the_variance_follows_the_bound() -> None:
    azimuths = np.radians([0.0, 45.0, 80.0])
    found = measure_toward_endfire(ROOF, azimuths, 15.0, 300, np.random.default_rng(1))
    np.testing.assert_allclose(found.bound, found.bound[0] / np.cos(azimuths) ** 2, rtol=1e-9)
    assert (found.ratio_db > found.sampling_db()[0]).all()
    assert (found.ratio_db < 1.5).all()
    assert found.mean_square[2] > 15.0 * found.mean_square[0]


def test_an_efficient_gaussian_estimator_stays_in_the_sampling_interval() -> None:
    """Of 2000 such means, 5.4 are expected outside."""
    means = np.mean(np.random.default_rng(2).standard_normal((2000, 50)) ** 2, axis=1)
    low, high = Efficiency("any", np.zeros(1), np.ones(1), np.ones(1), trials=50).sampling_db()
    outside = (10.0 * np.log10(means) < low) | (10.0 * np.log10(means) > high)
    assert 0 < outside.sum() < 16
    assert high == pytest.approx(10 * np.log10(1 + norm.ppf(0.99865) * np.sqrt(2 / 50)), abs=0.3)


def test_bad_settings_are_refused() -> None:
    with pytest.raises(InvalidArgumentError, match="trials"):
        measure_over_snr(TRIALS["delay"], [10.0], 1, np.random.default_rng(0))
    with pytest.raises(InvalidArgumentError, match="snr_db"):
        measure_over_snr(TRIALS["delay"], [np.nan], 10, np.random.default_rng(0))
    with pytest.raises(InvalidArgumentError, match="snapshot"):
        bearing_trial(ROOF, snapshots=0)


def test_the_command_knows_the_papers_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["array", "bounds", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["horizontal_moment_m2"] == pytest.approx(3.03, abs=0.005)
    assert found["sigma_deg"]["0"] == pytest.approx(1.80, abs=0.01)
    assert found["sigma_deg"]["60"] == pytest.approx(2 * found["sigma_deg"]["0"])
    assert found["alias_hz"] == pytest.approx(1.9e3, rel=0.03)
    assert main(["array", "bounds", "--snr-db", "0"]) == 0
    assert "S_xx               3.03 m^2" in capsys.readouterr().out


def test_figures_and_numbers_of_an_array_that_faces_left(tmp_path, capsys) -> None:
    turned = MicrophoneArray(ROOF.positions_m[::3][:, [1, 0, 2]])
    write_array_xml(tmp_path / "mics.xml", turned)
    words = ["--array", tmp_path / "mics.xml", "--snr-db", "20", "--trials", "40", "--out", tmp_path / "b"]
    command = ["array", "bounds", "--json", *map(str, words)]
    assert main(command) == 0
    first = json.loads(capsys.readouterr().out)
    assert first["broadside_deg"] == pytest.approx(90.0)
    assert first["sigma_deg"]["0"] is None
    assert all(abs(ratio) < 4.0 for (ratio,) in first["efficiency_db"].values())
    for name in ("efficiency.png", "endfire.png"):
        assert (tmp_path / "b" / name).read_bytes()[:4] == b"\x89PNG"
    written = json.loads((tmp_path / "b" / "bounds.json").read_text())
    assert written.items() <= first.items()
    assert main(command) == 0
    assert json.loads(capsys.readouterr().out) == first


def test_an_upright_line_has_no_bearing(tmp_path, capsys) -> None:
    write_array_xml(tmp_path / "mics.xml", MicrophoneArray([[0, 0, 0], [0, 0, 0.1]]))
    assert main(["array", "bounds", "--array", str(tmp_path / "mics.xml")]) == 2
    assert "horizontal extent" in capsys.readouterr().err
