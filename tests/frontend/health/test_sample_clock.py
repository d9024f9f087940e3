"""The sample rate by another clock: least squares, its standard deviation, and what counts as wrong."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.health.channel_health import ArrayHealth
from worldstate.frontend.health.sample_clock import RateEstimate, SampleClock, rate_from_duration
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.values import NotUsable


def read(
    true_hz: float, nominal_hz: float, n: int, jitter_s: float, seed: int
) -> tuple[SampleClock, np.ndarray]:
    rng = np.random.default_rng(seed)
    samples = 4800 * np.arange(1, n + 1)
    times = 10**18 + np.round(1e9 * (samples / true_hz + np.abs(rng.normal(0, jitter_s, n)))).astype(np.int64)
    times = np.maximum.accumulate(times)
    clock = SampleClock(nominal_hz)
    for count, time in zip(samples, times, strict=True):
        clock.read(int(count), int(time))
    return clock, np.stack([(times - times[0]) / 1e9, samples], axis=1)


@settings(deadline=None, max_examples=20)
@given(true_hz=st.floats(47_900, 48_100), n=st.integers(20, 300), seed=st.integers(0, 99))
def test_it_is_the_least_squares_line(true_hz: float, n: int, seed: int) -> None:
    clock, pairs = read(true_hz, 48_000.0, n, 1e-3, seed)
    slope, covariance = np.polyfit(pairs[:, 0], pairs[:, 1] - 48_000.0 * pairs[:, 0], 1, cov=True)
    estimate = clock.estimate()
    assert isinstance(estimate, RateEstimate)
    assert estimate.rate_hz == pytest.approx(48_000.0 + slope[0], abs=1e-5)
    assert estimate.std_hz == pytest.approx(np.sqrt(covariance[0, 0]), rel=1e-4)


def test_forty_two_millionths_show_within_minutes_and_not_within_seconds() -> None:
    long, short = (read(47_998.0, 48_000.0, n, 1e-3, 1)[0].estimate() for n in (1800, 50))
    assert isinstance(long, RateEstimate)
    assert isinstance(short, RateEstimate)
    assert long.is_wrong
    assert long.rate_hz == pytest.approx(47_998.0, abs=0.2)
    assert not short.is_wrong


def test_a_right_header_is_hardly_ever_called_wrong() -> None:
    estimates = [read(48_000.0, 48_000.0, 600, 2e-3, seed)[0].estimate() for seed in range(100)]
    scores = [(e.rate_hz - 48_000.0) / e.std_hz for e in estimates if isinstance(e, RateEstimate)]
    assert len(scores) == 100
    assert not any(e.is_wrong for e in estimates if isinstance(e, RateEstimate))
    assert 0.7 < np.std(scores) < 1.3


def test_days_lose_no_digits() -> None:
    clock = SampleClock(48_000.0)
    for hour in range(240):
        clock.read(hour * 3600 * 47_998, 1_800_000_000_000_000_000 + hour * 3_600_000_000_000)
    estimate = clock.estimate()
    assert isinstance(estimate, RateEstimate)
    assert estimate.rate_hz == pytest.approx(47_998.0, abs=1e-6)


def test_too_few_readings_and_a_clock_that_runs_back() -> None:
    clock = SampleClock(48_000.0)
    clock.read(0, 1000)
    assert isinstance(clock.estimate(), NotUsable)
    with pytest.raises(InvalidArgumentError, match="captured_ns"):
        clock.read(10, 999)
    with pytest.raises(InvalidArgumentError, match="captured_ns"):
        clock.read(-1, 2000)


def test_a_duration_is_a_clock() -> None:
    assert rate_from_duration(28_798_800, 600.0, 0.001, 48_000.0).is_wrong
    assert not rate_from_duration(28_798_800, 600.0, 0.02, 48_000.0).is_wrong
    with pytest.raises(InvalidArgumentError, match="duration_s"):
        rate_from_duration(48_000, 0.0, 0.1, 48_000.0)


def test_a_stream_measures_its_rate_and_nothing_else_changes() -> None:
    array = MicrophoneArray([[0, 0.1, 0], [0, 0.0, 0], [0, -0.1, 0]])
    sound = np.random.default_rng(0).standard_normal((40_000, 3))
    timed, plain = FrontEnd(array, 8000), FrontEnd(array, 8000)
    frames = [
        frame
        for k, block in enumerate(np.split(sound, 50))
        for frame in timed.process(block, captured_ns=round((k + 1) * 800 / 7900 * 1e9))
    ]
    health = frames[-1].health
    assert isinstance(health, ArrayHealth)
    assert isinstance(health.sample_rate, RateEstimate)
    assert health.sample_rate.rate_hz == pytest.approx(7900.0, abs=1e-3)
    assert not health.is_healthy
    np.testing.assert_array_equal(frames[-1].srp, plain.process(sound)[-1].srp)
