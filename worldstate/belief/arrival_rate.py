"""How often vehicles come into view from a side, learned while a camera looks."""

import math
from dataclasses import dataclass, replace

from worldstate.ground import nanoseconds

from .street_model import StreetModel


@dataclass(frozen=True, slots=True)
class ArrivalRate:
    r"""Arrivals from one side, and the time in which they would have been seen: Gamma prior, Poisson count.

    .. math:: \lambda \mid n, T \sim \Gamma\Big(a + n,\ \frac{a}{\lambda_0} + T\Big), \qquad
              \log \frac{E \lambda}{\lambda_0} = \log \frac{a + n}{a + \lambda_0 T}

    with n arrivals in a time T of watching, both forgotten slowly, and the usual rate :math:`\lambda_0`. Of
    the arrivals f came right behind another one; with the usual share c, as sure as b arrivals would make it,

    .. math:: P(\text{another one follows}) = \frac{c b + f}{b + n}
    """

    count: float = 0.0
    watched_s: float = 0.0
    followed: float = 0.0

    def later(self, step_s: float, watched: bool, street: StreetModel) -> "ArrivalRate":
        """Return the rate after a time, watched or not."""
        if not watched:
            return self
        kept = math.exp(-step_s / street.traffic_s)
        return ArrivalRate(self.count * kept, self.watched_s * kept + step_s, self.followed * kept)

    def after(self, since_last_ns: float, street: StreetModel) -> "ArrivalRate":
        """Return the rate after one more arrival, so long after the last one."""
        is_follower = since_last_ns <= nanoseconds(street.follows_s)
        return replace(self, count=self.count + 1.0, followed=self.followed + is_follower)

    def follower_share(self, street: StreetModel) -> float:
        """P(another one comes right behind one), in hundredths."""
        # What is forgotten depends in its last digits on how a time is divided into steps.
        return round(
            (street.follows * street.follows_like + self.followed) / (street.follows_like + self.count), 2
        )

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
