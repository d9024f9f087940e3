"""Weight, sum and squares of what was observed, and what they say of its mean and spread."""

import math
from dataclasses import dataclass

from worldstate.ground.checks import in_range


@dataclass(frozen=True, slots=True)
class NormalPrior:
    """What is believed of a quantity at a place where it was never observed.

    Examples
    --------
    >>> NormalPrior(mean=0.56, mean_std=0.1, spread=0.02).passes
    0.04
    """

    mean: float
    mean_std: float  # Of the place's own mean
    spread: float  # Of single observations about it
    freedom: float = 2.0  # Observations that the spread counts as

    @property
    def passes(self) -> float:
        """How many observations the mean counts as."""
        return round((self.spread / self.mean_std) ** 2, 12)


@dataclass(frozen=True, slots=True)
class Moments:
    """Sufficient statistics of a normal quantity; sums fade, so weights are no whole numbers.

    Examples
    --------
    >>> seen = Moments().plus(0.50).plus(0.54)
    >>> [round(value, 3) for value in seen.posterior(NormalPrior(0.56, 0.1, 0.02))]
    [0.521, 0.014, 0.02]
    """

    weight: float = 0.0
    total: float = 0.0
    squares: float = 0.0

    def __post_init__(self) -> None:
        in_range("weight", self.weight, 0.0, 1e12)

    def plus(self, value: float, weight: float = 1.0) -> "Moments":
        """Return them with one observation more."""
        return Moments(
            self.weight + weight, self.total + weight * value, self.squares + weight * value * value
        )

    def faded(self, factor: float) -> "Moments":
        """Return them with everything weighed less."""
        return Moments(factor * self.weight, factor * self.total, factor * self.squares)

    def posterior(self, prior: NormalPrior) -> tuple[float, float, float]:
        r"""Return mean, its standard deviation, and the spread of single observations.

        .. math:: m = \frac{k_0 m_0 + \sum x}{k_0 + n}, \quad
            s^2 = \frac{\nu_0 s_0^2 + \sum (x - \bar x)^2}{\nu_0 + n}, \quad \sigma_m = s / \sqrt{k_0 + n}
        """
        counted = prior.passes + self.weight
        mean = (prior.passes * prior.mean + self.total) / counted
        # Of a single observation it is zero, but for rounding.
        within = max(self.squares - self.total**2 / self.weight, 0.0) if self.weight > 0.0 else 0.0
        spread = math.sqrt((prior.freedom * prior.spread**2 + within) / (prior.freedom + self.weight))
        return mean, spread / math.sqrt(counted), spread

    def log_predictive(self, value: float, prior: NormalPrior) -> float:
        """Return the log density of the next observation, a Student t, nats."""
        mean, mean_std, spread = self.posterior(prior)
        freedom, scale = prior.freedom + self.weight, math.hypot(spread, mean_std)
        away = (value - mean) / scale
        return (
            math.lgamma(0.5 * (freedom + 1.0))
            - math.lgamma(0.5 * freedom)
            - 0.5 * math.log(freedom * math.pi)
            - math.log(scale)
            - 0.5 * (freedom + 1.0) * math.log1p(away * away / freedom)
        )
