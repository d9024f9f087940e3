"""How often vehicles come into view from a side, learned while a camera looks."""

import math
from dataclasses import dataclass

from worldstate.ground.values import replaced

from .street_model import StreetModel


@dataclass(frozen=True, slots=True)
class ArrivalRate:
    r"""Arrivals from one side, and the time in which they would have been seen: Gamma prior, Poisson count.

    .. math:: \lambda \mid n, T \sim \Gamma\Big(a + n,\ \frac{a}{\lambda_0} + T\Big), \qquad
              \log \frac{E \lambda}{\lambda_0} = \log \frac{a + n}{a + \lambda_0 T}

    with n arrivals in a time T of watching, both forgotten slowly, and the usual rate :math:`\lambda_0`.
    """

    count: float = 0.0
    watched_s: float = 0.0

    def watched_for(self, step_s: float, street: StreetModel) -> "ArrivalRate":
        """Return the rate after a time watched."""
        kept = math.exp(-step_s / street.traffic_s)
        return ArrivalRate(self.count * kept, self.watched_s * kept + step_s)

    def with_one_more(self) -> "ArrivalRate":
        """Return the rate after one more arrival."""
        return replaced(self, count=self.count + 1.0)

    def shift_nats(self, usual_hz: float, street: StreetModel) -> float:
        """Return by how much the log-odds of a vehicle coming differ from usual, in steps of .1 nats.

        Examples
        --------
        >>> quiet, busy, street = ArrivalRate(0.0, 600.0), ArrivalRate(6.0, 240.0), StreetModel()
        >>> [one.shift_nats(0.01, street) for one in (quiet, busy, ArrivalRate())]
        [-0.5, 0.5, 0.0]
        """
        like = street.traffic_like
        nats = math.log((like + self.count) / (like + usual_hz * self.watched_s))
        # The chain is computed anew for every prior: a few are enough.
        return round(min(max(nats, -street.traffic_nats), street.traffic_nats), 1)
