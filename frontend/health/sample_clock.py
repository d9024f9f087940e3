r"""The true sample rate, measured against another clock.

.. math:: n_i = n_0 + f_s t_i + \epsilon_i, \qquad
          \hat f_s = \frac{\sum_i (t_i - \bar t)(n_i - \bar n)}{\sum_i (t_i - \bar t)^2}, \qquad
          \sigma^2_{\hat f} = \frac{s^2}{\sum_i (t_i - \bar t)^2}

least squares over the pairs (number of samples, capture time). A recorder at 47,998 Hz whose header says
48,000 is 42 ppm off: a clock with an error of one millisecond shows it after two minutes.
"""

import math
from dataclasses import dataclass

from worldstate.ground import InvalidArgumentError, NotUsable, in_range, seconds

# With fewer pairs their scatter, and so the standard deviation, is not known.
_MIN_READINGS = 10
# An error of four standard deviations is significant: one false report in 16,000.
_SIGNIFICANT = 4.0
# Crystals themselves are off by about as much; less changes neither bearing nor level.
_TOLERATED = 1e-5


@dataclass(frozen=True, slots=True)
class RateEstimate:
    """A measured sample rate.

    Examples
    --------
    >>> RateEstimate(47_998.0, 0.1, 48_000.0).is_wrong, RateEstimate(47_999.8, 0.1, 48_000.0).is_wrong
    (True, False)
    """

    rate_hz: float  # Estimate and standard deviation
    std_hz: float
    nominal_hz: float  # Rate in the header of the stream

    @property
    def error(self) -> float:
        """Relative error of the nominal rate."""
        return self.rate_hz / self.nominal_hz - 1.0

    @property
    def is_wrong(self) -> bool:
        """Whether the nominal rate is off by more than 10 ppm and four standard deviations."""
        limit = max(_SIGNIFICANT * self.std_hz / self.nominal_hz, _TOLERATED)
        return abs(self.error) > limit


def rate_from_duration(
    n_samples: int, duration_s: float, duration_std_s: float, nominal_hz: float
) -> RateEstimate:
    r"""Estimate the sample rate from the duration of a recording by another clock, such as a camera's.

    .. math:: \hat f_s = n / T, \qquad \sigma_{\hat f} = \hat f_s\, \sigma_T / T
    """
    in_range("duration_s", duration_s, 0.0, math.inf, open_low=True, open_high=True)
    in_range("duration_std_s", duration_std_s, 0.0, math.inf, open_low=True, open_high=True)
    rate = n_samples / duration_s
    return RateEstimate(rate, rate * duration_std_s / duration_s, nominal_hz)


class SampleClock:
    r"""Estimate of the sample rate from capture times, in constant memory.

    .. math:: \hat f_s = f_{nom} + \frac{S_{te}}{S_{tt}}, \qquad e_n = n - f_{nom} t_n

    with the centred sums S over the pairs of time t and excess e over the nominal rate.

    Parameters
    ----------
    nominal_hz : float
        Rate in the header of the stream, Hz.

    References
    ----------
    B. P. Welford, "Note on a method for calculating corrected sums of squares and products", Technometrics 4,
    1962 (the running sums); N. Draper and H. Smith, *Applied Regression Analysis*, 1966, chapter 1 (the
    line).

    Examples
    --------
    >>> clock = SampleClock(nominal_hz=48_000.0)
    >>> for second in range(200):
    ...     clock.read(n_samples=47_998 * second, captured_ns=10**9 * second)
    >>> round(clock.estimate().rate_hz, 3)
    47998.0
    """

    def __init__(self, nominal_hz: float) -> None:
        self._nominal_hz = nominal_hz
        self._origin: tuple[int, int] | None = None
        self._latest = (0, 0)
        self._n = 0
        self._mean_t = self._mean_e = 0.0
        self._tt = self._te = self._ee = 0.0

    def read(self, n_samples: int, captured_ns: int) -> None:
        """Take the capture time of the sample that is `n_samples` from the start.

        Parameters
        ----------
        n_samples : int
            Number of samples so far.
        captured_ns : int
            Capture time of the last of them by the other clock, nanoseconds.

        Raises
        ------
        InvalidArgumentError
            If either clock runs backwards.

        Examples
        --------
        >>> clock = SampleClock(nominal_hz=48_000.0)
        >>> clock.read(n_samples=4800, captured_ns=100_000_000)
        >>> clock.estimate()
        NotUsable(reason='needs 10 readings of a clock, got 1')
        """
        if self._origin is None:
            self._origin = n_samples, captured_ns
        elif n_samples < self._latest[0] or captured_ns < self._latest[1]:
            before = f"{self._latest[0]} samples at {self._latest[1]}"
            raise InvalidArgumentError(
                f"captured_ns: expected a clock that runs on after {before}, got {n_samples} at {captured_ns}"
            )
        self._latest = n_samples, captured_ns
        time_s = seconds(captured_ns - self._origin[1])
        # Only the excess over the nominal rate is summed up: no digits are lost over days.
        self._add(time_s, n_samples - self._origin[0] - self._nominal_hz * time_s)

    def _add(self, t: float, e: float) -> None:
        self._n += 1
        dt, de = t - self._mean_t, e - self._mean_e
        self._mean_t += dt / self._n
        self._mean_e += de / self._n
        self._tt += dt * (t - self._mean_t)
        self._te += dt * (e - self._mean_e)
        self._ee += de * (e - self._mean_e)

    def estimate(self) -> RateEstimate | NotUsable:
        r"""Return the rate over all readings so far, at least ten at different times.

        .. math:: \hat f_s = f_{nom} + \frac{S_{te}}{S_{tt}}, \qquad
                  \sigma^2 = \frac{S_{ee} - S_{te}^2 / S_{tt}}{(n - 2)\, S_{tt}}

        Returns
        -------
        RateEstimate or NotUsable
            Hz, with its standard deviation.

        Examples
        --------
        >>> clock = SampleClock(nominal_hz=1000.0)
        >>> for second in range(10):
        ...     clock.read(n_samples=1001 * second, captured_ns=10**9 * second)
        >>> clock.estimate().is_wrong
        True
        """
        if self._n < _MIN_READINGS or self._tt <= 0.0:
            return NotUsable(f"needs {_MIN_READINGS} readings of a clock, got {self._n}")
        slope = self._te / self._tt
        variance = max(self._ee - slope * self._te, 0.0) / (self._n - 2)
        return RateEstimate(self._nominal_hz + slope, math.sqrt(variance / self._tt), self._nominal_hz)
