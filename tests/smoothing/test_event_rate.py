"""Rates by count and exposure: scipy's Gamma density, exponential times, times whose end nobody saw."""

import numpy as np
import pytest
from scipy.stats import gamma

from worldstate.ground.errors import InvalidArgumentError
from worldstate.smoothing.event_rate import EventRate

USUAL_HZ = 0.4


def rate_of(times_s: np.ndarray, longest_s: float = np.inf) -> EventRate:
    rate = EventRate()
    for time_s in times_s.tolist():
        rate = rate.after(min(time_s, longest_s), happened=time_s <= longest_s)
    return rate


def test_mean_and_interval_are_those_of_the_gamma_density():
    rate = EventRate(12.0, 40.0)
    density = gamma(13.0, scale=1.0 / (40.0 + 1.0 / USUAL_HZ))
    assert rate.mean_hz(USUAL_HZ) == pytest.approx(density.mean())
    assert rate.interval_hz(USUAL_HZ) == pytest.approx((density.ppf(0.05), density.ppf(0.95)))


def test_without_an_event_the_rate_is_the_usual_one():
    assert EventRate().mean_hz(USUAL_HZ) == USUAL_HZ


@pytest.mark.parametrize("longest_s", [np.inf, 6.0])
def test_the_interval_holds_the_rate_of_exponential_times_as_often_as_it_says(longest_s):
    """Ends that nobody saw count as time, not as events; left out, the rate would be too high."""
    rng, true_hz, within = np.random.default_rng(5), 0.2, 0
    for _ in range(400):
        low_hz, high_hz = rate_of(rng.exponential(1.0 / true_hz, 30), longest_s).interval_hz(USUAL_HZ)
        within += low_hz <= true_hz <= high_hz
    assert 0.85 <= within / 400 <= 0.95


def test_what_no_time_can_be_is_refused():
    with pytest.raises(InvalidArgumentError):
        EventRate().after(-1.0)
