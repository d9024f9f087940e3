"""Rate at which vehicles come into view from a side, learned while a camera looks."""

import math
from dataclasses import dataclass

from worldstate.ground.values import replaced

from .street_model import StreetModel


@dataclass(frozen=True, slots=True)
class ArrivalRate:
    r"""Arrivals from one side and the time of observation: Gamma prior, Poisson count.

    .. math:: \lambda \mid n, T \sim \Gamma\Big(a + n,\ \frac{a}{\lambda_0} + T\Big), \qquad
              \log \frac{E \lambda}{\lambda_0} = \log \frac{a + n}{a + \lambda_0 T}

    with n arrivals in an observed time T, both slowly forgotten, and the usual rate :math:`\lambda_0`.
    """

    count: float = 0.0
    watched_s: float = 0.0

    def watched_for(self, step_s: float, street: StreetModel) -> "ArrivalRate":
        """Return the rate after more observed time."""
        kept = math.exp(-step_s / street.traffic_s)
        return ArrivalRate(self.count * kept, self.watched_s * kept + step_s)

    def with_one_more(self) -> "ArrivalRate":
        """Return the rate after one more arrival."""
        return replaced(self, count=self.count + 1.0)

    def shift_nats(self, usual_hz: float, street: StreetModel) -> float:
        """Return the log-odds of an arrival minus the usual ones, in steps of 0.1 nats.

        Examples
        --------
        >>> quiet, busy, street = ArrivalRate(0.0, 600.0), ArrivalRate(6.0, 240.0), StreetModel()
        >>> [one.shift_nats(0.01, street) for one in (quiet, busy, ArrivalRate())]
        [-0.5, 0.5, 0.0]
        """
        like = street.traffic_like
        nats = math.log((like + self.count) / (like + usual_hz * self.watched_s))
        # The chain is computed for every new prior; rounding keeps the number of priors small.
        return round(min(max(nats, -street.traffic_nats), street.traffic_nats), 1)
