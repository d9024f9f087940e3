r"""Prediction from the last seconds: whether and when a vehicle comes into view on each side.

Boosted trees classify every hop and side into groups: a vehicle that comes into view within a given number of
seconds, a distant vehicle that becomes louder or quieter, a visible vehicle, one that has left the view, one
that comes on the other side, or no vehicle. With q the posterior of the groups at the share of hazards in
training,

.. math:: P(T \le h) = \sum_{g:\, T_g \le h} q_g, \qquad
          \hat T = \frac{\sum_{g\ \mathrm{coming}} q_g t_g}{\sum_{g\ \mathrm{coming}} q_g}
"""

from dataclasses import dataclass, field, fields, replace
from typing import ClassVar

import numpy as np

from worldstate.ground import TINY
from worldstate.ground.checks import freeze_arrays, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import ADDED, Layout, Probability
from worldstate.ground.typing import AnyArray, BoolArray, FloatArray, IndexArray

from .sequence_inputs import INPUTS, SIDES, sequence_inputs

# Limits on the work that a foreign file can cause; a tree has at most 64 leaves, one per bit of a word.
MOST_TREES, MOST_NODES, MOST_INPUTS = 4096, 127, 512


@dataclass(frozen=True, slots=True, eq=False)
class BoostedTrees:
    r"""Trees of several classes, padded to equal length.

    .. math:: P(c \mid x) = \mathrm{softmax}_c \Big( b_c + \sum_{t \in T_c} v_t(x) \Big)

    with v_t the value of the leaf that x reaches in tree t.

    Source: J. H. Friedman, "Greedy function approximation: a gradient boosting machine", Ann. Statist. 29,
    2001.

    A node is either a test, ``x[split] <= threshold``, that leads to the node `yes` or `no`, or a leaf, which
    leads to itself. A child has one parent and a higher number than its parent.

    All tests are evaluated at once; equal tests of several trees are evaluated once. The leaves of a tree
    are ordered from `yes` to `no`. The result "no" excludes the leaves on the `yes` side; x reaches the first
    leaf that remains. Source: C. Lucchese et al., "QuickScorer: a fast algorithm to rank documents with
    additive ensembles of regression trees", SIGIR 2015.

    Examples
    --------
    >>> stump = dict(split=[[0, 0, 0]], threshold=[[0.5, 0, 0]], yes=[[1, 1, 2]], no=[[2, 1, 2]])
    >>> trees = BoostedTrees(**stump, value=[[0.0, -1.0, 1.0]], tree_class=[0], baseline=[0.0, 0.0])
    >>> trees.scores(np.array([[0.2], [0.7]])).tolist()
    [[-1.0, 0.0], [1.0, 0.0]]
    """

    split: IndexArray  # shape (trees, nodes): Number of the tested input
    threshold: FloatArray  # shape (trees, nodes)
    yes: IndexArray  # shape (trees, nodes): Next node if the input is not above the threshold
    no: IndexArray  # shape (trees, nodes): Next node otherwise
    value: FloatArray  # shape (trees, nodes): Values of leaves
    tree_class: IndexArray  # shape (trees,): Class to whose score a tree contributes
    baseline: FloatArray  # shape (classes,)
    # Different tests of all trees: input and threshold, (different tests,). Per tree and test: its index
    # among them, and a mask of the leaves that remain after "no", (tests, trees). Values of the leaves.
    _ordered: tuple[IndexArray, FloatArray, IndexArray, AnyArray, FloatArray] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        grid = trees, nodes = np.shape(self.split)
        if not (0 < trees <= MOST_TREES and 0 < nodes <= MOST_NODES):
            most = f"at most {MOST_TREES} trees of {MOST_NODES} nodes"
            raise InvalidArgumentError(f"split: expected {most}, got {grid}")
        for name in ("split", "yes", "no", "tree_class"):
            object.__setattr__(self, name, np.array(getattr(self, name), np.intp))
            getattr(self, name).flags.writeable = False
        freeze_arrays(self, threshold=grid, value=grid, baseline=(len(self.baseline),))
        here = np.arange(nodes)
        for name in ("yes", "no"):
            to = getattr(self, name)
            # With links to earlier nodes an evaluation might never end; a leaf leads to itself.
            if to.shape != grid or (to < here).any() or (to >= nodes).any():
                raise InvalidArgumentError(f"{name}: expected the numbers of later nodes, shape {grid}")
        if ((self.yes == here) != (self.no == here)).any():
            raise InvalidArgumentError("no: expected a leaf to lead to itself on both ways")
        if self.split.shape != grid or self.split.min() < 0 or self.split.max() >= MOST_INPUTS:
            raise InvalidArgumentError(f"split: expected numbers of inputs below {MOST_INPUTS}")
        known = np.arange(len(self.baseline))
        if self.tree_class.shape != (trees,) or not np.isin(self.tree_class, known).all():
            raise InvalidArgumentError(f"tree_class: expected {trees} numbers of classes")
        self._order_leaves(self.yes != here)

    def _order_leaves(self, asks: BoolArray) -> None:
        """Assign a bit to every leaf and a mask to every test; asks has shape (trees, nodes)."""
        (trees, nodes), tree = asks.shape, np.arange(len(asks))
        led_to = np.concatenate([(way + nodes * tree[:, None])[asks] for way in (self.yes, self.no)])
        if np.bincount(led_to, minlength=1).max() > 1:
            raise InvalidArgumentError("yes, no: expected one way to every node")
        count, first = np.ones((trees, nodes), np.intp), np.full((trees, nodes), -1)
        for k in range(nodes - 1, -1, -1):
            below = count[tree, self.yes[:, k]] + count[tree, self.no[:, k]]
            count[:, k] = np.where(asks[:, k], below, 1)
        first[:, 0] = 0
        for k in range(nodes):
            on = tree[asks[:, k] & (first[:, k] >= 0)]
            yes = self.yes[on, k]
            first[on, yes], first[on, self.no[on, k]] = first[on, k], first[on, k] + count[on, yes]
        reached, most = asks & (first >= 0), int(count[:, 0].max())
        row, node = np.nonzero(reached)
        at = np.cumsum(reached, axis=1)[row, node] - 1, row
        word = np.min_scalar_type(2**most - 1)
        shape = max(int(reached.sum(axis=1).max()), 1), trees
        # A tree with fewer tests than others is padded with tests that exclude no leaf.
        asked, limit = np.zeros(shape, np.intp), np.full(shape, np.inf)
        left, leaves = np.full(shape, 2**most - 1, word), np.zeros((trees, most))
        asked[at], limit[at] = self.split[row, node], self.threshold[row, node]
        every = np.stack([asked, limit], axis=-1).reshape(-1, 2)
        pairs, which = np.unique(every, axis=0, return_inverse=True)
        one = word.type(1)
        ruled_out = (one << count[row, self.yes[row, node]].astype(word)) - one
        left[at] &= ~(ruled_out << first[row, node].astype(word))
        row, node = np.nonzero(~asks & (first >= 0))
        leaves[row, first[row, node]] = self.value[row, node]
        tests = pairs[:, 0].astype(np.intp), np.ascontiguousarray(pairs[:, 1])
        object.__setattr__(self, "_ordered", (*tests, which.reshape(shape), left, leaves))

    def scores(self, X: FloatArray) -> FloatArray:
        """Return the sums before the softmax, shape (n, inputs) -> (n, classes)."""
        asked, limit, which, after_no, leaves = self._ordered
        classes, trees = len(self.baseline), len(leaves)
        ends = np.empty((len(X), trees), np.intp)
        # Row by row, so that the data of a row stay in the cache.
        for row, end in zip(X, ends, strict=True):
            yes = -(row.take(asked) <= limit).astype(after_no.dtype)
            left = np.bitwise_and.reduce(after_no | yes.take(which), axis=0)
            # A number with only its lowest bit set is a power of two.
            end[:] = np.frexp((left & -left).astype(np.float64))[1]
        ends += np.arange(trees) * leaves.shape[1] - 1
        # `bincount`, because a matrix product with ones takes longer, and its rounding of a row depends on
        # the number of rows.
        bins = np.arange(len(X))[:, None] * classes + self.tree_class
        sums = np.bincount(bins.ravel(), leaves.take(ends).ravel(), len(X) * classes)
        return np.asarray(self.baseline + sums.reshape(-1, classes))


# Upper limits of the groups of coming vehicles, seconds before line of sight; later ones are distant.
COMING_S = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 8.0)
OTHERS = ("seen", "other", "past", "rising", "falling", "none")
GROUPS = (*(f"coming_{end_s:g}s" for end_s in COMING_S), *OTHERS)
HORIZONS_S = (0.5, 1.0, 2.0, 3.0)
# Times are given for vehicles that come within this time; beyond it, the sound does not determine the time.
LONGEST_S = 5.0
STATED = COMING_S.index(LONGEST_S) + 1  # Number of groups with a time
_HORIZONS = [COMING_S.index(end_s) for end_s in HORIZONS_S]
TAIL = 0.05  # Probability beyond each end: intervals contain nine of ten
_LEVELS = np.array([[TAIL], [1.0 - TAIL]])
SMOOTHED_HOPS, HELD_HOPS = 3, 10


@dataclass(frozen=True, slots=True, eq=False)
class SequencePosterior:
    """Posterior of both sides at every hop."""

    groups: FloatArray  # shape (n, 2, groups)
    margin_s: float

    def within(self) -> FloatArray:
        """Return the probability that a vehicle comes into view within `HORIZONS_S`, shape (n, 2, 4)."""
        sums = np.cumsum(self.groups[..., : len(COMING_S)], axis=-1)[..., _HORIZONS]
        # Rounding may lead to a sum of probabilities above one, which readers of files reject.
        return np.asarray(np.minimum(sums, 1.0))

    def time_to_visible_s(self) -> FloatArray:
        """Return the time to visible of vehicles within five seconds: low, mean, high, shape (n, 2, 3).

        On the calibration data the interval contains nine of ten times.
        """
        mass = self.groups[..., :STATED]
        edges = np.array([0.0, *COMING_S[:STATED]])
        share = mass / np.maximum(mass.sum(axis=-1, keepdims=True), TINY)
        mean = share @ (0.5 * (edges[1:] + edges[:-1]))
        below = np.cumsum(share, axis=-1) - share
        # The part of every bin that is below the level, linear within the bin.
        parts = (_LEVELS - below[..., None, :]) / np.maximum(share[..., None, :], TINY)
        low, high = np.moveaxis(np.clip(parts, 0.0, 1.0) @ np.diff(edges), -1, 0)
        return np.stack([np.maximum(low - self.margin_s, 0.0), mean, high + self.margin_s], axis=-1)


@dataclass(frozen=True, slots=True)
class AlarmPromise:
    """Alarms of hazard-free streams at one threshold of a curve; the intervals are for other junctions.

    Parameters
    ----------
    onsets_per_hour : float
        Onsets of alarms per hour, the maximum over this and higher thresholds.
    onsets_low, onsets_high : float
        95 % interval of the mean rate at four other junctions; a single junction varies more.
    alpha, alpha_low, alpha_high : float
        Share of the hops in alarm with its interval.

    Examples
    --------
    >>> AlarmPromise(25.0, 17.5, 36.2, 0.012, 0.008, 0.017).alpha
    0.012
    """

    onsets_per_hour: float
    onsets_low: float
    onsets_high: float
    alpha: Probability
    alpha_low: Probability
    alpha_high: Probability


@dataclass(frozen=True, slots=True)
class SequenceAlarm:
    """Alarm of a side: smoothed and held log-odds that a vehicle comes into view within three seconds."""

    threshold_nats: float  # Threshold of the log-odds, averaged over 0.3 s
    onsets_per_hour: float  # Requested budget, or the expected rate if a share was requested
    asked_alpha: Probability | None = field(default=None, metadata=ADDED)  # Requested share of hops in alarm
    # Expected alarms at the threshold; None if no curve was measured
    promise: AlarmPromise | None = field(default=None, metadata=ADDED)


def _last(rates: FloatArray, most: float) -> int:
    """Return the last point whose rate does not exceed a number, within rounding."""
    return int(np.searchsorted(rates, most * (1.0 + TINY), side="right")) - 1


@dataclass(frozen=True, slots=True, eq=False)
class AlarmCurve:
    r"""Thresholds for budgets, measured on hazard-free streams: points with decreasing thresholds.

    .. math:: \gamma(b) = \min \{ \gamma_i : r_i \le b \}, \qquad
              \gamma(\alpha) = \min \{ \gamma_i : \alpha_i \le \alpha \}

    with r the onsets per hour, the maximum over this and higher thresholds, and alpha the share of hops in
    alarm.

    Raises
    ------
    InvalidArgumentError
        If the lengths of the arrays differ, the thresholds do not decrease or a rate decreases.

    Examples
    --------
    >>> low, high = ([1.0, 3.0, 9.0], [0.0, 0.0, 0.02]), ([9.0, 17.0, 38.0], [0.01, 0.02, 0.08])
    >>> points = [2.0, 0.0, -1.0], [4.0, 8.0, 20.0], low[0], high[0], [0.0, 0.01, 0.04], low[1], high[1]
    >>> curve = AlarmCurve(*points, hours=2.0, least_onsets=3.0)
    >>> curve.for_budget(10.0).threshold_nats, curve.for_alpha(0.04).onsets_per_hour
    (0.0, 20.0)
    >>> curve.for_budget(1.0)
    Traceback (most recent call last):
        ...
    worldstate...InvalidArgumentError: budget: expected 4 to 20 onsets per hour, ... supports, got 1
    """

    threshold_nats: FloatArray  # shape (points,)
    onsets_per_hour: FloatArray  # shape (points,): Maximum so far, as alarms merge at lower thresholds
    onsets_low: FloatArray  # shape (points,): 95 % interval at four other junctions
    onsets_high: FloatArray  # shape (points,)
    alpha: FloatArray  # shape (points,): Share of the hops in alarm
    alpha_low: FloatArray  # shape (points,)
    alpha_high: FloatArray  # shape (points,)
    hours: float  # Duration of the hazard-free streams
    # Fewest expected onsets in these hours; with fewer, the threshold would depend on chance
    least_onsets: float

    def __post_init__(self) -> None:
        thresholds, *names = (one.name for one in fields(self)[:-2])
        freeze_arrays(self, **dict.fromkeys([thresholds, *names], (len(self.threshold_nats),)))
        if not self.threshold_nats.size or (np.diff(self.threshold_nats) >= 0.0).any():
            raise InvalidArgumentError(f"{thresholds}: expected thresholds that fall")
        for name in names:
            if (np.diff(getattr(self, name), prepend=0.0) < 0.0).any():
                raise InvalidArgumentError(f"{name}: expected numbers from 0 on that do not fall")
        in_range("hours", self.hours, 0.0, np.inf, open_low=True)
        in_range("alpha_high", self.alpha_high[-1], 0.0, 1.0)

    def _promise(self, point: int) -> AlarmPromise:
        return AlarmPromise(*(float(getattr(self, one.name)[point]) for one in fields(AlarmPromise)))

    def for_budget(self, onsets_per_hour: float) -> SequenceAlarm:
        """Return the alarm with the lowest threshold within a budget of onsets per hour.

        Raises
        ------
        InvalidArgumentError
            If the hours of the curve are too few for this budget (`least_onsets`), or it exceeds the curve.
        """
        least = self.least_onsets / self.hours
        self._check("budget", onsets_per_hour, self.onsets_per_hour, least, "onsets per hour")
        return self.default(onsets_per_hour)

    def default(self, onsets_per_hour: float) -> SequenceAlarm:
        """Return the alarm for the budget of a new model file, without a limit on the hours."""
        point = max(_last(self.onsets_per_hour, onsets_per_hour), 0)
        return SequenceAlarm(float(self.threshold_nats[point]), onsets_per_hour, None, self._promise(point))

    def for_alpha(self, alpha: float) -> SequenceAlarm:
        """Return the alarm with the lowest threshold for a share of hazard-free hops in alarm.

        Raises
        ------
        InvalidArgumentError
            If the hours of the curve are too few for this share (`least_onsets`), or it exceeds the curve.
        """
        too_few = (1.0 - 2.0 * TINY) * self.least_onsets / self.hours
        known = self.alpha[_last(self.onsets_per_hour, too_few) + 1 :]
        self._check("alpha", alpha, self.alpha, float(known.min(initial=self.alpha[-1])), "of the hops")
        point = _last(self.alpha, alpha)
        promise = self._promise(point)
        return SequenceAlarm(float(self.threshold_nats[point]), promise.onsets_per_hour, alpha, promise)

    def _check(self, name: str, asked: float, values: FloatArray, least: float, unit: str) -> None:
        least, most = max(least, float(values[0])), float(values[-1])
        if not least <= asked <= most:
            known = f"{least:.3g} to {most:.3g} {unit}, which the model's curve supports"
            raise InvalidArgumentError(f"{name}: expected {known}, got {asked:g}")


@dataclass(frozen=True, slots=True, eq=False)
class SequenceModel:
    """Boosted trees over the groups, the groups' shares in training and a margin of the times."""

    LAYOUT: ClassVar = Layout(constants={"groups": list(GROUPS)})

    trees: BoostedTrees
    share: FloatArray  # shape (groups,): Shares of the groups in the training streams
    margin_s: float = 0.0  # Added to the trees' interval so that it contains nine of ten times
    alarm: SequenceAlarm | None = None  # The alarm in use; in a file, the default
    inputs: tuple[str, ...] = INPUTS  # An initial part of `INPUTS`: older models have fewer inputs
    curve: AlarmCurve | None = field(default=None, metadata=ADDED)  # Files of version 0.3 hold one alarm only

    def __post_init__(self) -> None:
        freeze_arrays(self, share=(len(GROUPS),))
        # The change to another prior divides by it.
        if (self.share <= 0.0).any():
            raise InvalidArgumentError(f"share: expected positive numbers, got {self.share.min()}")
        if self.inputs != INPUTS[: len(self.inputs)]:
            raise InvalidArgumentError(f"inputs: expected the first of {list(INPUTS)}, got {self.inputs}")
        read, groups = int(self.trees.split.max()) + 1, len(self.trees.baseline)
        if read > len(self.inputs) or groups != len(GROUPS):
            expected = f"{len(self.inputs)} inputs and {len(GROUPS)} groups"
            raise InvalidArgumentError(f"trees: expected {expected}, got {read} and {groups}")

    def asking(self, budget: float | None = None, alpha: float | None = None) -> "SequenceModel":
        """Return the model with the alarm for a budget of onsets per hour or a share of hazard-free hops.

        Raises
        ------
        InvalidArgumentError
            If both are given, or the curve does not support the value. Without a curve the only budget is
            that of the file's alarm.
        """
        if budget is not None and alpha is not None:
            raise InvalidArgumentError("budget, alpha: expected one of them, because both set the threshold")
        if self.curve is not None and alpha is not None:
            return replace(self, alarm=self.curve.for_alpha(alpha))
        if self.curve is not None and budget is not None:
            return replace(self, alarm=self.curve.for_budget(budget))
        only = None if self.alarm is None else self.alarm.onsets_per_hour
        if alpha is None and budget in (None, only):
            return self
        name, held = "budget" if alpha is None else "alpha", "none" if only is None else f"only {only:g}"
        problem = f"expected a model file with a curve of budgets, this one holds {held} onsets per hour"
        raise InvalidArgumentError(f"{name}: {problem}; `worldstate model make` writes a file with a curve")

    def posterior(self, columns: FloatArray) -> SequencePosterior:
        """Return the posterior at every hop of a stream from its `hop_columns` up to that hop."""
        return self.of_inputs(sequence_inputs(columns))

    def of_inputs(self, inputs: FloatArray) -> SequencePosterior:
        """Return the posterior from rows of inputs, shape (n, 2, inputs)."""
        scores = self.trees.scores(inputs.reshape(-1, inputs.shape[-1]))
        exponent = np.exp(scores - np.maximum.reduce(scores, 1)[:, None])
        groups = exponent / np.add.reduce(exponent, 1)[:, None]
        return SequencePosterior(groups.reshape(-1, len(SIDES), len(GROUPS)), self.margin_s)
