r"""How often something happens while it can: a count in a time, and the Gamma density of its rate.

With the usual rate :math:`\lambda_0` as one event in :math:`1 / \lambda_0` seconds, and n events in a time T,

.. math:: \lambda \mid n, T \sim \Gamma\Big(1 + n,\ \frac{1}{\lambda_0} + T\Big), \qquad
          E \lambda = \lambda_0 \frac{1 + n}{1 + \lambda_0 T}
"""

from dataclasses import dataclass

from worldstate.ground.checks import in_range

# One event: a minute of watching outweighs it. Streets differ by a factor of three either way.
_USUAL_EVENTS = 1.0


@dataclass(frozen=True, slots=True)
class EventRate:
    """Events, and the time in which they could have happened; sums fade, so counts are no whole numbers.

    Examples
    --------
    >>> seen = EventRate().after(3.0).after(5.0).after(1.5, happened=False)
    >>> round(seen.mean_hz(0.5), 3), [round(value, 2) for value in seen.interval_hz(0.5)]
    (0.261, [0.07, 0.55])
    """

    count: float = 0.0
    exposure_s: float = 0.0

    def __post_init__(self) -> None:
        in_range("count", self.count, 0.0, 1e12)
        in_range("exposure_s", self.exposure_s, 0.0, 1e12)

    def after(self, time_s: float, *, happened: bool = True) -> "EventRate":
        """Return it after one more time, at the end of which the event happened or watching ended."""
        return EventRate(self.count + happened, self.exposure_s + time_s)

    def faded(self, factor: float) -> "EventRate":
        """Return it with everything weighed less."""
        return EventRate(factor * self.count, factor * self.exposure_s)

    def plus(self, other: "EventRate") -> "EventRate":
        """Return both together."""
        return EventRate(self.count + other.count, self.exposure_s + other.exposure_s)

    def mean_hz(self, usual_hz: float) -> float:
        """Return the expected rate; where nothing was seen it is the usual one."""
        return usual_hz * (_USUAL_EVENTS + self.count) / (_USUAL_EVENTS + usual_hz * self.exposure_s)

    def interval_hz(self, usual_hz: float, share: float = 0.9) -> tuple[float, float]:
        """Return the ends of the interval that holds the rate with a probability, as much beyond either."""
        from scipy.special import gammaincinv

        tail, shape = 0.5 * (1.0 - share), _USUAL_EVENTS + self.count
        time_s = _USUAL_EVENTS / usual_hz + self.exposure_s
        low, high = (float(gammaincinv(shape, at)) / time_s for at in (tail, 1.0 - tail))
        return low, high
