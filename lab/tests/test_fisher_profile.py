"""Signature shape and the band-wise Fisher profile."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import ttest_ind
from worldstate_lab.signatures.clip_signatures import (
    band_profile,
    discriminative_range_hz,
    fisher_profile,
    level_invariant_shape,
)

from worldstate.ground.errors import InvalidArgumentError

energies = arrays(np.float64, (5, 16), elements=st.floats(-50, 50))


@settings(max_examples=50, deadline=None)
@given(energies, st.floats(-40, 40))
def test_shape_removes_the_level_and_nothing_else(energy, gain):
    shape = level_invariant_shape(energy)
    np.testing.assert_allclose(level_invariant_shape(energy + gain), shape, atol=1e-9)
    np.testing.assert_allclose(shape.mean(axis=1), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.diff(shape, axis=1), np.diff(energy, axis=1), atol=1e-9)


def test_profile_is_welchs_t_squared_over_n():
    rng = np.random.default_rng(0)
    vehicle, background = rng.normal(0.5, 2.0, (30, 16)), rng.normal(0.0, 0.7, (30, 16))
    t = ttest_ind(vehicle, background, equal_var=False).statistic
    np.testing.assert_allclose(fisher_profile(vehicle, background), t**2 / 30)


@settings(max_examples=30, deadline=None)
@given(energies, energies, st.floats(0.1, 10), st.floats(-5, 5))
def test_profile_is_symmetric_and_ignores_scale(one, zero, scale, shift):
    one, zero = np.round(one, 1), np.round(zero, 1)
    profile = fisher_profile(one, zero)
    np.testing.assert_array_equal(fisher_profile(zero, one), profile)
    spread = one.var(axis=0) + zero.var(axis=0) > 1e-3
    moved = fisher_profile(scale * one + shift, scale * zero + shift)
    np.testing.assert_allclose(moved[spread], profile[spread], rtol=1e-6, atol=1e-9)


def test_constant_bands():
    one, other = np.array([[1.0, 2.0]] * 2), np.array([[1.0, 3.0]] * 2)
    np.testing.assert_array_equal(fisher_profile(one, other), [0.0, np.inf])


def test_profile_finds_the_band_of_vehicle_sound():
    rng = np.random.default_rng(1)
    edges = np.geomspace(50.0, 8000.0, 17)
    heard = (edges[:-1] > 290) & (edges[1:] < 1900)
    background = rng.normal(0.0, 1.0, (400, 16)) + rng.normal(0, 3, (400, 1))
    vehicle = rng.normal(0.0, 1.0, (400, 16)) + rng.normal(0, 3, (400, 1)) + 2.0 * heard
    with_level = fisher_profile(vehicle, background)
    profile = fisher_profile(level_invariant_shape(vehicle), level_invariant_shape(background))
    assert profile[heard].min() > 3 * with_level[heard].max()
    low, high = discriminative_range_hz(profile, edges)
    assert (low, high) == (edges[:-1][heard][0], edges[1:][heard][-1])


@pytest.mark.parametrize(("windows", "vehicle"), [(0, 0), (3, 1), (3, 2)])
def test_windows_of_a_single_kind_have_no_profile(windows, vehicle):
    sounds = [(np.zeros((24_000, 1), np.float32), 24_000.0)] * windows
    with pytest.raises(InvalidArgumentError, match="two with a vehicle and two without"):
        band_profile(sounds, np.arange(windows) < vehicle)
