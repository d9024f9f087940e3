"""How many independent windows a stream is worth."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from worldstate.abduction.cueing.cueing_policy import sustained_statistic
from worldstate.abduction.cueing.risk_map import correlation_time_hops
from worldstate.abduction.cueing.thresholds import neyman_pearson_threshold
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


def test_nothing_is_known_of_no_windows():
    for of in (lambda: neyman_pearson_threshold([], 0.1), lambda: correlation_time_hops([])):
        with pytest.raises(InvalidArgumentError, match="window"):
            of()
