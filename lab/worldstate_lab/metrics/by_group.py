"""Figures by group, such as a junction: areas, rates of decisions, their mean and the worst of them."""

from collections.abc import Mapping
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import AnyArray, BoolArray
from worldstate.operations.metrics.approach_table import auroc


def auroc_by_group(scores: ArrayLike, positive: ArrayLike, groups: ArrayLike) -> dict[str, float]:
    """Return the area of each group that has both labels, in the order of their names.

    Shapes: scores, positive (n,), groups (n,).

    Examples
    --------
    >>> auroc_by_group([0.1, 0.9, 0.5], [False, True, True], ["a", "a", "b"])
    {'a': 1.0}
    """
    values, labels, names = np.asarray(scores), np.asarray(positive), np.asarray(groups)
    areas = {str(name): auroc(values[names == name], labels[names == name]) for name in np.unique(names)}
    return {name: area for name, area in areas.items() if area is not None}


def macro(by_group: Mapping[str, float]) -> float:
    """Return the mean over groups.

    Examples
    --------
    >>> macro({"SA1": 1.0, "SB1": 0.5})
    0.75
    """
    if not by_group:
        raise InvalidArgumentError("groups: expected at least one with hazard and hazard-free windows")
    return float(np.mean(list(by_group.values())))


def rate(decisions: BoolArray, among: BoolArray) -> float | None:
    """Return the share of decisions among the chosen rows, None where there are none.

    Examples
    --------
    >>> rate(np.array([True, False, True]), np.array([True, True, False]))
    0.5
    """
    return float(decisions[among].mean()) if among.any() else None


def worst_rate(alarms: BoolArray, hazard_free: BoolArray, sites: AnyArray) -> float:
    r"""Return the share of hazard-free windows that are in alarm at the junction where it is largest.

    .. math:: \max_s \frac{\sum_i a_i f_i [s_i = s]}{\sum_i f_i [s_i = s]}

    Shapes: alarms, hazard_free, sites (n,).

    Examples
    --------
    >>> free = np.ones(4, dtype=bool)
    >>> worst_rate(np.array([True, False, False, False]), free, np.array([0, 0, 1, 1]))
    0.5
    """
    rates = [rate(alarms, hazard_free & (sites == site)) for site in np.unique(sites[hazard_free])]
    return max(one for one in rates if one is not None)


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
