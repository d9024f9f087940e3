"""Cramer-Rao bounds against the paper, numerical Fisher matrices and errors of estimators."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.adapters.files.array_file import write_array_xml
from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.frontend.array.steering import Steering, one_blas_thread
from worldstate.frontend.bounds.cramer_rao import (
    bearing_crb_rad2,
    broadside_rad,
    endfire_information,
    radial_speed_crb_m2_s2,
    tone_crb_hz2,
)
from worldstate.frontend.direction.bearing import find_peaks, srp_phat

SOUND_M_S = 343.0
positions_strategy = st.integers(0, 2**32 - 1).map(
    lambda seed: np.random.default_rng(seed).uniform(-0.5, 0.5, (9, 3))
)


@settings(max_examples=40, deadline=None)
@given(positions=positions_strategy, azimuth=st.floats(-3.1, 3.1), snr=st.floats(0.01, 100.0))
def test_information_equals_a_numerical_fisher_matrix(positions, azimuth, snr):
    """Oracle: 2 SNR Re(d^H (I - a a^H / M) d), the derivative of the steering vector by differences."""
    frequency, h = 700.0, 1e-5

    def steer(azimuth):
        u = [np.cos(azimuth), np.sin(azimuth), 0.0]
        return np.exp(2j * np.pi * frequency / SOUND_M_S * (positions @ u))

    a, d = steer(azimuth), (steer(azimuth + h) - steer(azimuth - h)) / (2 * h)
    information = 2 * 30 * snr * (d.conj() @ d - abs(a.conj() @ d) ** 2 / 9).real
    got = bearing_crb_rad2(positions, azimuth, frequency, snr, 30)
    assert 1 / got == pytest.approx(information, rel=1e-4)


def test_information_of_bins_adds_and_a_random_signal_costs():
    positions = roof_array_56().positions_m
    each = [1 / bearing_crb_rad2(positions, 0.3, f, s, 5) for f, s in [(500.0, 2.0), (900.0, 0.1)]]
    both = bearing_crb_rad2(positions, 0.3, [500.0, 900.0], [2.0, 0.1], 5)
    assert 1 / both == pytest.approx(sum(each))
    random = bearing_crb_rad2(positions, 0.3, 900.0, 0.1, 5, random_signal=True)
    assert random == pytest.approx((1 + 1 / 5.6) / each[1])
    assert bearing_crb_rad2(positions, 0.3, 900.0, 0.0, 5) == np.inf


@settings(max_examples=30, deadline=None)
@given(azimuth=st.floats(-np.pi, np.pi))
def test_information_falls_towards_endfire_as_in_the_corollary(azimuth):
    positions = roof_array_56().positions_m
    share = endfire_information(positions, azimuth)
    assert share == pytest.approx(np.cos(azimuth) ** 2, abs=1e-12)
    broadside = bearing_crb_rad2(positions, 0.0, 1000.0, 1.0, 1)
    if share > 1e-6:
        assert bearing_crb_rad2(positions, azimuth, 1000.0, 1.0, 1) == pytest.approx(broadside / share)


@settings(max_examples=30, deadline=None)
@given(positions=positions_strategy, azimuth=st.floats(-np.pi, np.pi))
def test_broadside_is_the_direction_of_most_information(positions, azimuth):
    best = broadside_rad(positions)
    assert -np.pi / 2 < best <= np.pi / 2
    assert endfire_information(positions, best) == pytest.approx(1.0)
    assert endfire_information(positions, azimuth) <= 1.0 + 1e-12


@pytest.mark.parametrize(
    ("every", "azimuth_deg", "snr_db"),
    [(1, 0.0, 15.0), (1, 0.0, 25.0), (4, 0.0, 15.0), (4, 0.0, 25.0), (1, 45.0, 15.0), (1, 80.0, 15.0)],
)
def test_srp_phat_meets_the_bearing_bound(every, azimuth_deg, snr_db):
    """The error is within 1.5 dB of the bound, also towards endfire, and not below it by over 3 sigma."""
    array, trials, snapshots = MicrophoneArray(roof_array_56().positions_m[::every]), 300, 20
    rng, snr = np.random.default_rng(trials), 10 ** (snr_db / 10)
    grid, middle = np.radians(np.arange(-90.0, 91.0)), np.radians(azimuth_deg)
    steering, errors = Steering.towards(array, [1000.0], grid), []
    with one_blas_thread():
        for _ in range(trials):
            # The truth covers one step of the grid, also where interpolation is worst.
            truth = middle + np.radians(rng.uniform(-0.5, 0.5))
            wave = np.exp(2j * np.pi * rng.uniform(size=(snapshots, 1, 1)))
            noise = rng.normal(size=(2, snapshots, 1, array.n_microphones)) / np.sqrt(2 * snr)
            heard = wave * array.steering(1000.0, truth)[:, :, 0] + noise[0] + 1j * noise[1]
            spectrum = srp_phat(heard.astype(np.complex64), steering)
            errors.append(find_peaks(spectrum, grid, max_peaks=1)[0].azimuth_rad - truth)
    bound = bearing_crb_rad2(array.positions_m, middle, 1000.0, snr, snapshots)
    excess_db = 10 * np.log10(np.mean(np.square(errors)) / bound)
    assert 10 * np.log10(1 - 3 * np.sqrt(2 / trials)) < excess_db < 1.5


def test_tone_bound_equals_a_numerical_fisher_matrix():
    """Amplitude, phase and frequency of a real tone, eta = A^2 / (2 sigma^2)."""
    n, rate, frequency, sigma = 400, 1000.0, 123.0, 0.7
    t = (np.arange(n) - 0.5 * (n - 1)) / rate
    angle = 2 * np.pi * frequency * t + 0.3
    H = np.column_stack([np.cos(angle), -np.sin(angle), -2 * np.pi * t * np.sin(angle)])
    variance = np.linalg.inv(H.T @ H / sigma**2)[2, 2]
    assert tone_crb_hz2(1 / (2 * sigma**2), n, rate) == pytest.approx(variance, rel=0.01)
    assert radial_speed_crb_m2_s2(variance, frequency) == pytest.approx((343 / 123) ** 2 * variance)


def test_the_bounds_command_prints_the_numbers_of_the_paper(capsys):
    assert main(["array", "bounds", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["horizontal_moment_m2"] == pytest.approx(3.03, abs=0.005)
    assert found["sigma_deg"]["0"] == pytest.approx(1.80, abs=0.01)
    assert found["sigma_deg"]["60"] == pytest.approx(2 * found["sigma_deg"]["0"])
    assert found["alias_hz"] == pytest.approx(1.9e3, rel=0.03)
    assert main(["array", "bounds", "--snr-db", "0"]) == 0
    assert "S_xx               3.03 m^2" in capsys.readouterr().out


def test_an_array_that_faces_left_has_no_bearing_ahead(tmp_path, capsys):
    turned = MicrophoneArray(roof_array_56().positions_m[::3][:, [1, 0, 2]])
    write_array_xml(tmp_path / "mics.xml", turned)
    assert main(["array", "bounds", "--json", "--array", str(tmp_path / "mics.xml")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["broadside_deg"] == pytest.approx(90.0)
    assert found["sigma_deg"]["0"] is None
