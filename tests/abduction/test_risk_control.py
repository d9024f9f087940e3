"""Risk control over units not yet seen, and how many windows a stream is worth."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mapie.risk_control.methods import find_best_predict_param, get_r_hat_plus
from scipy.signal import lfilter

from worldstate.abduction.cueing.cueing_policy import sustained_statistic
from worldstate.abduction.cueing.risk_map import correlation_time_hops
from worldstate.abduction.cueing.thresholds import neyman_pearson_threshold, risk_controlling
from worldstate.ground.errors import InvalidArgumentError

WINDOWS, PHI = 91, 0.9


def autoregressive(rng, recordings, windows=WINDOWS, phi=PHI):
    """Recordings of a stationary Gaussian AR(1), unit variance; correlation time (1 + phi) / (1 - phi)."""
    shocks = rng.normal(size=(recordings, windows)) * math.sqrt(1.0 - phi**2)
    shocks[:, 0] = rng.normal(size=recordings)
    return lfilter([1.0], [1.0, -phi], shocks, axis=1)


# Correlation time of "the last 3 hops of the AR(1) were at or above the (1 - alpha) level", in hops:
# measured once on 4e6 hops of the law, and held against a shorter run by the test below.
ALARM_TIME_HOPS = {0.02: 7.7, 0.05: 9.6}


@pytest.mark.parametrize("alpha", [0.02, 0.05])
def test_the_correlation_time_of_the_alarm_is_that_of_the_law(alpha):
    stream = autoregressive(np.random.default_rng(0), 40, 20_000)
    held = np.stack([sustained_statistic(s, 3) for s in stream])[:, 2:]
    alarm = (held >= np.quantile(held, 1.0 - alpha)).astype(float)
    assert correlation_time_hops(alarm) == pytest.approx(ALARM_TIME_HOPS[alpha], rel=0.1)


@given(st.floats(0.0, 0.9))
@settings(deadline=None, max_examples=15)
def test_correlation_time_of_an_autoregression(phi):
    streams = autoregressive(np.random.default_rng(1), 30, 4000, phi)
    assert correlation_time_hops(streams) == pytest.approx((1 + phi) / (1 - phi), rel=0.15)


def losses(rng, units, thresholds=30, largest=3.0):
    """Losses of units that rise towards lower thresholds, each at its own, now and then falling again."""
    at = rng.uniform(0.0, thresholds, (units, 1))
    rising = np.maximum(np.arange(thresholds) - at, 0.0) * rng.exponential(0.3, (units, 1))
    return np.minimum(rising * rng.choice([1.0, 0.0], rising.shape), largest)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 40), st.floats(0.05, 2.5))
def test_the_expected_loss_of_a_unit_left_out_is_within_the_budget_whatever_the_losses(seed, units, alpha):
    table = losses(np.random.default_rng(seed), units)
    kept = [risk_controlling(np.delete(table, unit, axis=0), alpha, 3.0) for unit in range(units)]
    lost = [row[k - 1] if k else 0.0 for row, k in zip(table, kept, strict=True)]
    assert np.mean(lost) <= alpha + 1e-9


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(5, 40), st.floats(0.1, 0.9))
def test_a_controlled_risk_is_that_of_another_implementation(seed, units, alpha):
    table = np.maximum.accumulate(losses(np.random.default_rng(seed), units), axis=1)
    table[:, 0], numbers = 0.0, np.arange(table.shape[1], dtype=float)
    _, bound = get_r_hat_plus(table / 3.0, numbers, "crc", None, None, None)
    if bound[0] < alpha < bound[-1]:
        theirs = find_best_predict_param(numbers, bound, np.array([alpha]))
        assert risk_controlling(table, 3.0 * alpha, 3.0) == theirs[0] + 1


def test_nothing_is_known_of_no_windows():
    for of in (lambda: neyman_pearson_threshold([], 0.1), lambda: correlation_time_hops([])):
        with pytest.raises(InvalidArgumentError, match="window"):
            of()
