r"""How often somebody comes from an arm, learned while it is watched: a Gamma prior and a Poisson count.

.. math:: \lambda \mid n, T \sim \Gamma\Big(a + n,\ \frac{a}{\lambda_0} + T\Big), \qquad
          \log \frac{E \lambda}{\lambda_0} = \log \frac{a + n}{a + \lambda_0 T}

with n arrivals in a time T of watching, both forgotten slowly, and the usual rate :math:`\lambda_0`.
"""

import math
from dataclasses import dataclass

# As sure of the usual rate as two arrivals would make it: streets differ by a factor of three either way.
_SHAPE = 2.0
_FORGOTTEN_S = 3600.0  # Traffic changes with the hour
# A prior slides the alarm: by +2 nats from 15 to 58 onsets an hour, by -1 to a detection of .73 for .94.
_MOST_NATS = 0.5
_STEP_NATS = 0.1  # The chain is computed anew for every prior: a few are enough


@dataclass(frozen=True, slots=True)
class ArrivalRate:
    """Arrivals from one side, and the time in which they would have been seen."""

    count: float = 0.0
    watched_s: float = 0.0

    def later(self, step_s: float, watched: bool) -> "ArrivalRate":
        """Return the rate after a time, watched or not."""
        kept = math.exp(-step_s / _FORGOTTEN_S) if watched else 1.0
        return ArrivalRate(self.count * kept, self.watched_s * kept + (step_s if watched else 0.0))

    def shift_nats(self, usual_hz: float) -> float:
        """Return by how much the log-odds of somebody coming differ from usual, in steps of .1 nats.

        Examples
        --------
        >>> quiet, busy = ArrivalRate(0.0, 600.0), ArrivalRate(6.0, 240.0)
        >>> quiet.shift_nats(0.01), busy.shift_nats(0.01), ArrivalRate().shift_nats(0.01)
        (-0.5, 0.5, 0.0)
        """
        nats = math.log((_SHAPE + self.count) / (_SHAPE + usual_hz * self.watched_s))
        return round(min(max(nats, -_MOST_NATS), _MOST_NATS) / _STEP_NATS) * _STEP_NATS
