"""Intervals of figures by drawing recordings again and again, and the worst group beside the mean."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from worldstate.ground.typing import FloatArray, IndexArray

# Twelve draws lie beyond each end of the interval.
DRAWS = 500
COVERAGE = 0.95

Interval = tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class FigureDraws:
    """Figures of one method on every draw of recordings; the same draws for every method.

    Examples
    --------
    >>> ours = FigureDraws({"tpr": np.linspace(0.0, 40.0, 41)})
    >>> low, high = ours.interval("tpr")
    >>> round(low, 3), round(high, 3)
    (1.0, 39.0)
    >>> ours.gains(FigureDraws({"tpr": ours.values["tpr"] - 2.0}))
    {'tpr': (2.0, 2.0)}
    """

    values: Mapping[str, FloatArray]  # shape (draws,): For each figure

    def interval(self, figure: str) -> Interval:
        """Return the middle 95 %."""
        return middle(self.values[figure])

    def intervals(self) -> dict[str, Interval]:
        """Return the middle 95 % of every figure."""
        return {figure: self.interval(figure) for figure in self.values}

    def gains(self, other: "FigureDraws") -> dict[str, Interval]:
        """Return the middle 95 % of the difference to another method on the same draws."""
        # Both methods stumble over the same hard recordings: paired, those cancel.
        return {figure: middle(self.values[figure] - other.values[figure]) for figure in self.values}


def stratified_draws(strata: Sequence[Hashable], rng: np.random.Generator, draws: int = DRAWS) -> IndexArray:
    """Draw recordings with replacement, as many of each stratum as there are, shape (draws, n).

    Place i of every draw holds a recording of the stratum of recording i.

    Examples
    --------
    >>> stratified_draws(["left", "none", "left", "none"], np.random.default_rng(0), draws=2)
    array([[2, 1, 2, 1],
           [2, 1, 0, 1]])
    """
    members: dict[Hashable, list[int]] = {}
    for i, stratum in enumerate(strata):
        members.setdefault(stratum, []).append(i)
    drawn = np.empty((draws, len(strata)), dtype=np.intp)
    # A stratum of one recording is in every draw: its own spread cannot be known.
    for rows in map(np.array, members.values()):
        drawn[:, rows] = rng.choice(rows, (draws, rows.size))
    return drawn


def middle(values: FloatArray, coverage: float = COVERAGE) -> Interval:
    """Return the interval that leaves equal shares of the draws below and above, NaN where there are none.

    Examples
    --------
    >>> middle(np.array([np.nan, 0.0, 1.0, 2.0]), coverage=0.5)
    (0.5, 1.5)
    """
    # A figure that a draw does not have, such as a bearing without anything in view, is left out of it.
    known = values[~np.isnan(values)]
    if not known.size:
        return float("nan"), float("nan")
    tail = (1.0 - coverage) / 2.0
    low, high = np.quantile(known, [tail, 1.0 - tail]).tolist()
    return low, high


def worst_group(values: Mapping[str, float], worse: Literal["low", "high"]) -> tuple[str, float]:
    """Return name and figure of the worst group, the first of equals; ("", NaN) where none has a figure.

    Examples
    --------
    >>> worst_group({"SA1": 0.9, "SB1": 0.6, "SC1": float("nan")}, worse="low")
    ('SB1', 0.6)
    """
    # NaN compares as neither less nor greater, so that min and max would depend on the order.
    known = {name: value for name, value in values.items() if not np.isnan(value)}
    if not known:
        return "", float("nan")
    name = (min if worse == "low" else max)(known, key=known.__getitem__)
    return name, known[name]
