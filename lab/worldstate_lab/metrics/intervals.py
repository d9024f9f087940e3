"""Intervals of figures: recordings are assigned to folds, resampled, and weighted by their number of draws.

Recordings are drawn with replacement, by stratum; `stratified_draws([0] * n, rng)` draws minutes or passes of
one kind. A figure is computed on every draw, by its rows or by `draw_weights`, and `middle` is its interval:

>>> values = np.array([0.4, 0.9, 0.7, 0.8])
>>> drawn = values[stratified_draws([0] * 4, np.random.default_rng(0), draws=1000)].mean(axis=1)
>>> [round(end, 2) for end in middle(drawn)]
[0.53, 0.85]

Figures by group, such as a junction, are summarised by their mean and the worst of them. Exact intervals of
counts and shares are in `worldstate.operations.metrics.approach_table`.
"""

from collections.abc import Hashable, Iterator, Mapping, Sequence
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.cueing.risk_map import BINS
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.ground.checks import finite_array
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import AnyArray, BoolArray, FloatArray, IndexArray
from worldstate.operations.metrics.approach_table import auroc, poisson_interval
from worldstate.operations.training.training import recording_labels

# Twelve draws are outside each end of the interval.
DRAWS = 500
_TAIL = (1.0 - 0.95) / 2.0

# Folds are by recording, as in the paper.
FOLDS = 5

Interval = tuple[float, float]
Part = TypeVar("Part", IndexArray, FloatArray)


def stratified_draws(strata: Sequence[Hashable], rng: np.random.Generator, draws: int = DRAWS) -> IndexArray:
    """Draw recordings with replacement, as many of each stratum as there are, shape (draws, n).

    Element i of every draw is a recording of the stratum of recording i.

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
    # A stratum of one recording is in every draw: its spread cannot be estimated.
    for rows in map(np.array, members.values()):
        drawn[:, rows] = rng.choice(rows, (draws, rows.size))
    return drawn


def pooled_draws(
    parts: Sequence[Part], strata: Sequence[Hashable], rng: np.random.Generator, draws: int = DRAWS
) -> Iterator[Part]:
    """Yield the concatenated rows or values of the recordings in each draw.

    Examples
    --------
    >>> parts = [np.array([0, 1]), np.array([2])]
    >>> [one.tolist() for one in pooled_draws(parts, [0, 0], np.random.default_rng(0), draws=2)]
    [[2, 2], [2, 0, 1]]
    """
    for one in stratified_draws(strata, rng, draws).tolist():
        yield np.concatenate([parts[i] for i in one])


def middle(values: FloatArray) -> Interval:
    """Return the central 95 % of the draws, NaN if there are none.

    Examples
    --------
    >>> [round(end, 6) for end in middle(np.array([np.nan, *range(41)]))]
    [1.0, 39.0]
    """
    # Draws without the figure, such as a bearing error without a vehicle in view, are ignored.
    known = values[~np.isnan(values)]
    if not known.size:
        return float("nan"), float("nan")
    low, high = np.quantile(known, [_TAIL, 1.0 - _TAIL]).tolist()
    return low, high


def paired_gains(ours: Mapping[str, FloatArray], other: Mapping[str, FloatArray]) -> dict[str, Interval]:
    """Return the central 95 % of each figure's difference to another method on the same draws.

    Examples
    --------
    >>> ours = {"tpr": np.linspace(0.0, 40.0, 41)}
    >>> paired_gains(ours, {"tpr": ours["tpr"] - 2.0})
    {'tpr': (2.0, 2.0)}
    """
    # Both methods fail on the same hard recordings; in paired differences these errors cancel.
    return {figure: middle(values - other[figure]) for figure, values in ours.items()}


def recording_draws(table: FeatureTable, rng: np.random.Generator, draws: int = DRAWS) -> list[IndexArray]:
    """Return the windows of recordings drawn with replacement, within each label at each junction."""
    keys, labels = table.recording_keys, recording_labels(table)
    rows = [np.flatnonzero(keys == key) for key in labels]
    strata = [(key.split("/")[0], label) for key, label in labels.items()]
    return list(pooled_draws(rows, strata, rng, draws))


def poisson_upper(count: int, exposure: float) -> float:
    """Return the one-sided exact upper bound of a rate at a confidence of 0.9.

    Examples
    --------
    >>> round(poisson_upper(0, exposure=1.0), 2)
    2.3
    """
    # A two-sided interval has equal probabilities outside its two ends.
    return poisson_interval(count, exposure, 2.0 * 0.9 - 1.0)[1]


def random_detection(
    windows_s: ArrayLike, alarms: ArrayLike, scored_s: ArrayLike, times: ArrayLike = 1.0
) -> FloatArray:
    r"""Return the detection rate of as many alarms at uniformly random moments; NaN without an approach.

    .. math:: \sum_i t_i \left(1 - (1 - w_i / T)^N\right) / \sum_i t_i

    `windows_s` (n,) is w, the time before each T0 in which an onset counts; T is all scored time. For D
    samples of the approaches, `times` (D, n) is how often a sample contains each approach, and `alarms` and
    `scored_s` have shape (D,).

    Examples
    --------
    >>> float(random_detection([5.0, 2.5], alarms=2, scored_s=10.0))
    0.59375
    """
    number, total_s = (np.asarray(one, np.float64)[..., None] for one in (alarms, scored_s))
    share, weight = np.broadcast_arrays(np.asarray(windows_s) / total_s, np.asarray(times, np.float64))
    detected = 1.0 - (1.0 - np.clip(share, 0.0, 1.0)) ** number
    return ratio((weight * detected).sum(axis=-1), weight.sum(axis=-1))


def draw_weights(draws: IndexArray, recordings: int) -> FloatArray:
    """Return how often each recording is in each draw, shape (D, recordings).

    Examples
    --------
    >>> draw_weights(np.array([[0, 0, 2]]), recordings=3)
    array([[2., 0., 1.]])
    """
    return np.array([np.bincount(one, minlength=recordings) for one in draws], np.float64)


def pooled_share(hits: AnyArray, counts: AnyArray, draws: IndexArray) -> tuple[float, FloatArray]:
    """Return the hits over the counts of all recordings, and in every draw; NaN without counts.

    Shapes: hits, counts (n,), draws (D, n).

    Examples
    --------
    >>> pooled_share(np.array([1.0, 4.0]), np.array([2.0, 4.0]), draws=np.array([[0, 0], [0, 1]]))
    (0.8333333333333334, array([0.5       , 0.83333333]))
    """
    every = np.concatenate([np.arange(len(counts))[None], draws])
    shares = ratio(hits[every].sum(axis=1), counts[every].sum(axis=1))
    return float(shares[0]), shares[1:]


def ratio(above: FloatArray, below: FloatArray) -> FloatArray:
    """Return the quotient, NaN if the denominator is zero.

    Examples
    --------
    >>> ratio(np.array([1.0, 0.0]), np.array([2.0, 0.0]))
    array([0.5, nan])
    """
    quotient: FloatArray = np.divide(above, below, out=np.full(below.shape, np.nan), where=below > 0.0)
    return quotient


def weighted_areas(
    wins: FloatArray, windows: FloatArray, positive: BoolArray, weights: FloatArray
) -> FloatArray:
    r"""Return the AUROC with weight weights[d, r] for recording r, NaN if a label is missing, shape (..., D).

    Shapes: wins (..., P, Q) as from `rank_wins`, windows (..., R), positive (R,), weights (D, R). Wins are
    counted once per pair of recordings; a draw weights them, so its windows need not be ranked again.

    .. math:: w_P^T W w_Q / (w_P^T n_P \, w_Q^T n_Q)

    Examples
    --------
    >>> weighted_areas(np.array([[1.5]]), np.array([1.0, 2.0]), np.array([True, False]), np.ones((1, 2)))
    array([0.75])
    """
    high, low = weights[:, positive], weights[:, ~positive]
    pairs = (windows[..., positive] @ high.T) * (windows[..., ~positive] @ low.T)
    return ratio(((high @ wins) * low).sum(axis=-1), pairs)


def known_mean(values: FloatArray) -> FloatArray:
    """Return the mean over the first axis, without NaN.

    Examples
    --------
    >>> known_mean(np.array([[1.0, np.nan], [3.0, np.nan]]))
    array([ 2., nan])
    """
    # `nanmean` warns if a column is all NaN, which is a valid input here.
    known = np.isfinite(values)
    return ratio(np.where(known, values, 0.0).sum(axis=0), known.sum(axis=0))


def weighted_median(values: FloatArray, times: FloatArray) -> FloatArray:
    """Return the median of values (n,) with weights times[d, i], NaN if all are zero, shape (D,).

    Examples
    --------
    >>> weighted_median(np.array([5.0, 1.0, 2.0]), np.array([[1.0, 1.0, 1.0], [2.0, 1.0, 1.0]]))
    array([2. , 3.5])
    """
    if not values.size:
        return np.full(len(times), np.nan)
    order = np.argsort(values)
    kept = np.cumsum(times[:, order], axis=1)
    half = kept[:, -1:] / 2.0
    # For an even number, the mean of the two central values, like numpy's median of the repeated values.
    low, high = np.argmax(kept >= half, axis=1), np.argmax(kept > half, axis=1)
    median = (values[order][low] + values[order][high]) / 2.0
    return np.where(half[:, 0] > 0.0, median, np.nan)


def highest_share(values: FloatArray, times: FloatArray, share: float) -> BoolArray:
    """Return a mask of the values at or above the highest threshold that keeps a share, shape (D, n).

    Examples
    --------
    >>> highest_share(np.array([1.0, 3.0, 2.0]), np.ones((1, 3)), share=0.5)
    array([[False,  True,  True]])
    """
    if not values.size:
        return np.zeros(times.shape, bool)
    order = np.argsort(-values, kind="stable")
    kept = np.cumsum(times[:, order], axis=1)
    # Equal values are kept together. Sums of whole numbers are exact, but the product with the share is not.
    last = np.argmax(kept >= share * kept[:, -1:] - 1e-9, axis=1)
    return np.asarray(values >= values[order][last][:, None])


def deal_folds(
    labels: Sequence[str], groups: Sequence[str], rng: np.random.Generator, folds: int = FOLDS
) -> IndexArray:
    """Assign recordings to folds so that each has its share of every label in every group, shape (n,).

    There are never more folds than recordings of the rarer kind, hazard-free or approach.

    Examples
    --------
    >>> labels = ["none", "left"] * 4
    >>> deal_folds(labels, ["SA1"] * 8, np.random.default_rng(0), folds=2)
    array([0, 1, 0, 0, 1, 1, 1, 0])
    """
    free = np.array([label == "none" for label in labels], dtype=bool)
    counts = int((~free).sum()), int(free.sum())
    if min(*counts, folds) < 2:
        raise InvalidArgumentError(
            f"recordings: expected at least two approaches, two hazard-free ones and two folds, "
            f"got {counts[0]} approaches, {counts[1]} hazard-free ones and {folds} folds"
        )
    keys = [(~free[i], labels[i], groups[i], rng.random()) for i in range(len(labels))]
    order = sorted(range(len(labels)), key=keys.__getitem__)
    fold_of = np.empty(len(labels), dtype=np.intp)
    # Assignment continues where the last stratum ended; otherwise the first folds would get every remainder.
    fold_of[order] = np.arange(len(labels)) % min(*counts, folds)
    return fold_of


# The standard error of the mean is then a twentieth of the standard deviation between draws.
_FLOOR_DRAWS = 400


def calibration_error_sampling(
    risk: ArrayLike, rng: np.random.Generator, draws: int = _FLOOR_DRAWS
) -> tuple[float, float]:
    r"""Return mean and standard deviation of the ECE for labels drawn from the given risks.

    The mean is the sampling floor at this number of windows.

    .. math:: ECE = \frac1n \sum_b \Big| \sum_{i \in b} (y_i - r_i) \Big|, \qquad P(y_i = 1) = r_i

    Shapes: risk (n,).

    References
    ----------
    J. Bröcker and L. A. Smith, "Increasing the reliability of reliability diagrams", Weather and Forecasting
    22, 2007.

    Examples
    --------
    >>> mean, deviation = calibration_error_sampling(np.full(400, 0.5), np.random.default_rng(0))
    >>> round(mean, 2), round(deviation, 3)
    (0.02, 0.016)
    """
    predicted = finite_array("risk", risk, (None,))
    index = np.minimum((predicted * BINS).astype(np.intp), BINS - 1)
    labels = rng.random((draws, predicted.size)) < predicted
    membership = (index[:, None] == np.arange(BINS)).astype(np.float64)
    errors = np.abs((labels - predicted) @ membership).sum(axis=1) / predicted.size
    return float(errors.mean()), float(errors.std())


def auroc_by_group(scores: FloatArray, positive: BoolArray, groups: AnyArray) -> dict[str, float]:
    """Return the area of each group that has both labels, sorted by name.

    Shapes: scores, positive (n,), groups (n,).

    Examples
    --------
    >>> scores, positive = np.array([0.1, 0.9, 0.5]), np.array([False, True, True])
    >>> auroc_by_group(scores, positive, np.array(["a", "a", "b"]))
    {'a': 1.0}
    """
    areas = {str(name): auroc(scores[groups == name], positive[groups == name]) for name in np.unique(groups)}
    return {name: area for name, area in areas.items() if area is not None}


def worst_group(values: Mapping[str, float], worse: Literal["low", "high"]) -> tuple[str, float]:
    """Return name and figure of the worst group, the first of equals; ("", NaN) if no group has a figure.

    Examples
    --------
    >>> worst_group({"SA1": 0.9, "SB1": 0.6, "SC1": float("nan")}, worse="low")
    ('SB1', 0.6)
    """
    # Comparisons with NaN are false, so the result of min and max would depend on the order.
    known = {name: value for name, value in values.items() if not np.isnan(value)}
    if not known:
        return "", float("nan")
    name = (min if worse == "low" else max)(known, key=known.__getitem__)
    return name, known[name]
