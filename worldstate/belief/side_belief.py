"""Belief over the approach sides at one time, the source of all values per side, and their arrivals."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from worldstate.ground.values import replaced

from .street_model import StreetModel


@dataclass(frozen=True, slots=True)
class SideBelief:
    """Marginals over the approach sides; sides do not exclude each other.

    Examples
    --------
    >>> either = SideBelief((0.5, 0.4), (0.0, 0.1), (0.5, 0.4), 0.8, (0.8, 0.0, 0.2), both=0.1)
    >>> [round(either.existence(side), 2) for side in (0, 1, None)]
    [0.5, 0.5, 0.9]
    """

    hidden: tuple[float, ...]  # shape (K,): P(a vehicle is hidden on a side)
    emerged: tuple[float, ...]  # shape (K,): P(a vehicle from there is in view)
    risks: tuple[float, ...]  # shape (K,): P(a vehicle comes into view there within eight seconds)
    risk: float  # P(a vehicle comes into view on any side)
    hypotheses: tuple[float, float, float]  # P(hidden), P(visible), P(none) of eq. (6)
    both: float = 0.0  # P(vehicles are hidden on two sides)

    def hidden_on(self, side: int | None) -> float:
        """Return P(a vehicle is hidden on a side); None means any side."""
        return sum(self.hidden) - self.both if side is None else self.hidden[side]

    def existence(self, side: int | None) -> float:
        """Return P(a vehicle of a side exists); None means any side."""
        emerged = sum(self.emerged) if side is None else self.emerged[side]
        # The sum of two exponentials can exceed one by rounding if nothing else is possible.
        return min(self.hidden_on(side) + emerged, 1.0)

    def hidden_share(self, side: int | None) -> float:
        """Return P(hidden | exists) of the vehicle believed there."""
        existence = self.existence(side)
        return min(self.hidden_on(side) / existence, 1.0) if existence > 0.0 else 1.0

    def side_shares(self, least: float) -> tuple[float, ...]:
        """Return P(side | one vehicle of unknown side exists), zero below the least, shape (K,)."""
        shares = [self.existence(side) for side in range(len(self.hidden))]
        total = sum(shares)
        shares = [share if share >= least * total else 0.0 for share in shares]
        total = sum(shares)
        return tuple([share / total for share in shares])

    def beside(self, nothing: float) -> "SideBelief":
        r"""Return the belief if P(no vehicle is in view) is e.

        .. math:: P(none) \leftarrow \min(P(none), e), \qquad P(vis) \text{ gains the difference}

        Examples
        --------
        >>> quiet = SideBelief((0.1, 0.1), (0.0, 0.0), (0.1, 0.1), 0.2, (0.2, 0.3, 0.5))
        >>> [round(one, 2) for one in quiet.beside(0.02).hypotheses]
        [0.2, 0.78, 0.02]
        """
        hidden, visible, none = self.hypotheses
        return replaced(self, hypotheses=(hidden, visible + max(none - nothing, 0.0), min(none, nothing)))

    def at_least(self, announced: Sequence[float]) -> "SideBelief":
        r"""Return the belief with the vehicles that messages announce, by side.

        .. math:: r_k \leftarrow \max(r_k, a_k), \qquad
                  P(hid) \leftarrow \max\Big(P(hid),\ 1 - \prod_k (1 - a_k)\Big)

        Sound on a side may come from the announced vehicle; vehicles announced on two sides are two. The
        other explanations shrink in proportion.

        Examples
        --------
        >>> quiet = SideBelief((0.1, 0.1), (0.0, 0.0), (0.1, 0.1), 0.2, (0.2, 0.4, 0.4))
        >>> told = quiet.at_least((0.6, 0.0))
        >>> told.risks, [round(one, 2) for one in told.hypotheses]
        ((0.6, 0.1), [0.6, 0.2, 0.2])
        """
        if not any(announced):
            return self
        some = 1.0 - math.prod(1.0 - one for one in announced)
        hidden, visible, none = self.hypotheses
        now = max(hidden, some)
        kept = (1.0 - now) / (1.0 - hidden) if hidden < 1.0 else 0.0
        return replaced(
            self,
            risks=tuple(map(max, self.risks, announced)),
            risk=max(self.risk, some),
            hypotheses=(now, visible * kept, none * kept),
        )


@dataclass(frozen=True, slots=True)
class ArrivalRate:
    r"""Rate at which vehicles come into view from a side, learned while a camera looks.

    It has a Gamma prior and a Poisson count:

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
