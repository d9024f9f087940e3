"""Decimation of one channel: what it keeps, and what it removes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.frontend.spectra.decimator import Decimator

RATE = 47_998


def line(frequency_hz: float, seconds: float, rate: float) -> np.ndarray:
    return np.cos(2 * np.pi * frequency_hz / rate * np.arange(round(seconds * rate)) + 0.3)


@settings(deadline=None, max_examples=40)
@given(
    cuts=st.lists(st.integers(0, 6000), max_size=8),
    rate=st.sampled_from([1_000, 2_500.0, 8_000, 47_998]),
    share=st.floats(0.0, 1.0),
)
def test_decimation_keeps_the_band_where_it_was(cuts: list[int], rate: float, share: float) -> None:
    """A tone in the band comes out as itself, sampled at the promised instants, whatever the blocks."""
    decimator, frequency = Decimator(rate, 300.0), 300.0 * share
    sound = line(frequency, 6000 / rate, rate)
    heard = np.concatenate([decimator.push(block) for block in np.split(sound, sorted(cuts))])
    assert len(heard) == (6000 - decimator.n_taps) // decimator.factor + 1
    instants = (np.arange(len(heard)) * decimator.factor + 0.5 * (decimator.n_taps - 1)) / rate
    np.testing.assert_allclose(heard, np.cos(2 * np.pi * frequency * instants + 0.3), atol=3e-4)


@pytest.mark.parametrize("frequency_hz", [835.0, 1230.0, 1500.0, 5000.0, 23_000.0])
def test_what_would_fold_into_the_band_is_gone(frequency_hz: float) -> None:
    decimator = Decimator(RATE, 400.0)
    assert decimator.rate_hz - 400.0 < 835.0
    assert np.abs(decimator.push(line(frequency_hz, 0.5, RATE))).max() < 2e-4
