"""What is believed of the hidden vehicle of every side, whatever it was read from."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class HiddenBelief:
    """P(hidden) and P(in view, come from there), side by side; sides do not exclude each other.

    Examples
    --------
    >>> both = HiddenBelief((0.9, 0.8), (0.0, 0.1))
    >>> [round(both.existence(side), 2) for side in (0, 1)]
    [0.9, 0.9]
    """

    hidden: tuple[float, ...]
    emerged: tuple[float, ...]

    def existence(self, side: int) -> float:
        """Return the probability that there is such a vehicle."""
        # The sum of two exponentials exceeds one by rounding where nothing else is possible.
        return min(self.hidden[side] + self.emerged[side], 1.0)

    def hidden_share(self, side: int) -> float:
        """Return P(hidden | exists)."""
        either = self.hidden[side] + self.emerged[side]
        return self.hidden[side] / either if either > 0.0 else 1.0
