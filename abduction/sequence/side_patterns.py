r"""What either arm of a street sounds like before somebody comes into view: sums over the passes heard.

Patterns x of the three seconds before T0, weighed by the chance a that anybody was heard to come. Every pass
counts by its mean weight; means are drawn together as by half a pass that was heard on either side,

.. math:: m_g = \frac{\sum_g a x + \tfrac{1}{2} \bar m}{n_g + \tfrac{1}{2}}, \qquad
          w = S^{-1} (m_{left} - m_{right}), \qquad b = -\tfrac{1}{2} w^\top (m_{left} + m_{right})

with S the scatter about these means, a tenth of it taken for the same in all directions. What is known to be
of one arm in n passes counts with the certainty :math:`(1 + \tfrac{1}{2} (1/n_{left} + 1/n_{right}))^{-1}`.
"""

from dataclasses import dataclass, replace

import numpy as np

from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray

from .street_sides import SECTORS, StreetSides

# Of 0, .3, .5 and 1 for the doubt, ten passes of exam seeds 1 and 2 took the side from right in .838 of the
# hops to .859, .878, .876 and .877 (docs/street.md).
_DRAWN_TOGETHER, _DOUBT = 0.5, 0.5
_ROUND = 0.1
# Below, both means are the same within rounding.
_LEAST_WEIGHT = 0.1
_SMALLEST = 1e-9  # Of patterns that never differ
_EMPTY = (0.0,) * SECTORS


@dataclass(frozen=True, slots=True, eq=False)
class PassSound:
    """How the sound of one pass arrived while the vehicle was hidden."""

    patterns: FloatArray  # shape (n, 12)
    weights: FloatArray  # shape (n,): Chance that anybody was heard to come
    heard_by: str


@dataclass(frozen=True, slots=True)
class SidePatterns:
    """Weights, sums and squares of patterns of both arms; left before right.

    Examples
    --------
    >>> rng, known = np.random.default_rng(0), SidePatterns()
    >>> slope = np.linspace(1.0, -1.0, SECTORS)
    >>> for arm, sign in (("left", 1.0), ("right", -1.0)):
    ...     sound = PassSound(sign * slope + rng.normal(0.0, 0.3, (30, SECTORS)), np.ones(30), "roof")
    ...     known = known.with_pass(arm, sound)
    >>> bool(known.sides().log_ratio(np.exp(np.repeat(slope, 5))[None])[0] > 1.0)
    True
    """

    heard_by: str = ""
    weights: tuple[float, float] = (0.0, 0.0)
    sums: tuple[tuple[float, ...], tuple[float, ...]] = (_EMPTY, _EMPTY)
    squares: tuple[tuple[float, ...], ...] = (_EMPTY,) * SECTORS

    def __post_init__(self) -> None:
        if {len(row) for row in (*self.sums, *self.squares, self.squares)} != {SECTORS}:
            raise InvalidArgumentError(f"patterns: expected {SECTORS} sectors in every row")

    def with_pass(self, arm: str, sound: PassSound) -> "SidePatterns":
        """Return them after one more pass; what another array heard before it is forgotten."""
        known = self if self.heard_by == sound.heard_by else SidePatterns(sound.heard_by)
        own = int(arm == "right")
        weighed = sound.weights[:, None] * sound.patterns / len(sound.weights)
        weights, sums = np.array(known.weights), np.array(known.sums)
        weights[own] += sound.weights.mean()
        sums[own] += weighed.sum(axis=0)
        return known._of(weights, sums, np.array(known.squares) + weighed.T @ sound.patterns)

    def faded(self, factor: float) -> "SidePatterns":
        """Return them with everything weighed less."""
        return self._of(*(factor * np.array(one) for one in (self.weights, self.sums, self.squares)))

    def _of(self, weights: FloatArray, sums: FloatArray, squares: FloatArray) -> "SidePatterns":
        (left, right), (of_left, of_right) = weights.tolist(), sums.tolist()
        rows = tuple(map(tuple, squares.tolist()))
        return replace(self, weights=(left, right), sums=(tuple(of_left), tuple(of_right)), squares=rows)

    def sides(self) -> StreetSides | None:
        """Return what they say of windows, None as long as one arm was hardly heard."""
        weights, sums = np.array(self.weights), np.array(self.sums)
        if weights.min() < _LEAST_WEIGHT:
            return None
        usual = (sums / weights[:, None]).mean(axis=0)
        means = (sums + _DRAWN_TOGETHER * usual) / (weights + _DRAWN_TOGETHER)[:, None]
        # Of sums about means that are not quite their own.
        crossed = sums.T @ means
        about = np.array(self.squares) - crossed - crossed.T + (means.T * weights) @ means
        scatter = about / weights.sum()
        even = max(float(np.trace(scatter)) / SECTORS, _SMALLEST)
        direction = np.linalg.solve(
            (1.0 - _ROUND) * scatter + _ROUND * even * np.eye(SECTORS), means[0] - means[1]
        )
        offset, certainty = -0.5 * direction @ means.sum(axis=0), 1.0 / (1.0 + _DOUBT * (1.0 / weights).sum())
        return StreetSides(direction, float(offset), float(certainty), self.heard_by)
