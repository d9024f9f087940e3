"""The belief of all approach sides at one time: everything that a snapshot says of them is read from here."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class SideBelief:
    """Marginals of what is on the approach sides; sides do not exclude each other.

    Examples
    --------
    >>> both = SideBelief((0.9, 0.8), (0.0, 0.1), (0.9, 0.8), 0.95, (0.95, 0.0, 0.05))
    >>> [round(both.existence(side), 2) for side in (0, 1)]
    [0.9, 0.9]
    """

    hidden: tuple[float, ...]  # shape (K,): P(a vehicle is hidden on a side)
    emerged: tuple[float, ...]  # shape (K,): P(in view, come from there)
    risks: tuple[float, ...]  # shape (K,): P(one comes into view there within eight seconds)
    risk: float  # P(one comes into view anywhere)
    hypotheses: tuple[float, float, float]  # P(hidden), P(visible), P(none) of eq. (6)

    def existence(self, side: int) -> float:
        """Return the probability that there is such a vehicle."""
        # The sum of two exponentials exceeds one by rounding where nothing else is possible.
        return min(self.hidden[side] + self.emerged[side], 1.0)

    def hidden_share(self, side: int) -> float:
        """Return P(hidden | exists)."""
        either = self.hidden[side] + self.emerged[side]
        return self.hidden[side] / either if either > 0.0 else 1.0

    def at_least(self, announced: Sequence[float]) -> "SideBelief":
        r"""Return the belief with the vehicles that messages announce, by side.

        .. math:: r_k \leftarrow \max(r_k, a_k), \qquad
                  P(hid) \leftarrow \max\Big(P(hid),\ 1 - \prod_k (1 - a_k)\Big)

        What is heard on a side may be the announced vehicle, while those of two sides are two. The other
        explanations shrink alike.

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
        return replace(
            self,
            risks=tuple(map(max, self.risks, announced)),
            risk=max(self.risk, some),
            hypotheses=(now, visible * kept, none * kept),
        )
