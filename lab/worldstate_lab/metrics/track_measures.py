"""Measures of tracks in bearing: those of the LOCATA challenge and of CLEAR-MOT, and GOSPA.

C. Evers et al., "The LOCATA challenge: acoustic source localization and tracking", IEEE/ACM TASLP 28, 2020;
K. Bernardin and R. Stiefelhagen, "Evaluating multiple object tracking performance: the CLEAR MOT metrics",
EURASIP Journal on Image and Video Processing, 2008.

Prominence gating gives the accuracy of bearings with a camera reference as a function of the share kept.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.adapters.camera.box_linking import gated_pairs
from worldstate.ground.checks import check_shape, finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray, IntArray
from worldstate.ground.values import NotUsable, wrap_angle
from worldstate.operations.recordings.hop_table import HopTable

# The paper's points: 3.4 degrees for all bearings, 2.4 degrees at 16 % coverage.
PUBLISHED = ((1.0, 3.4), (0.16, 2.4))
PUBLISHED_COVERAGE = PUBLISHED[1][0]
# Maximum number of thresholds of a curve, evenly spaced in coverage.
_MOST_POINTS = 200


@dataclass(frozen=True, slots=True, eq=False)
class GatingCurve:
    r"""Coverage and median error of bearings as functions of a threshold on their prominence.

    .. math:: c(\rho_0) = \frac{\#\{i : \rho_i \ge \rho_0\}}{n}, \qquad
              e(\rho_0) = \mathrm{median}\{|\epsilon_i| : \rho_i \ge \rho_0\}

    Parameters
    ----------
    threshold : ndarray, shape (T,)
        Smallest prominence kept, ascending.
    coverage : ndarray, shape (T,)
        Share of the bearings kept, in (0, 1].
    median_error_rad : ndarray, shape (T,)
        Median absolute error of the bearings kept, radians.

    Examples
    --------
    >>> curve = gating_curve([1.1, 1.2, 2.0, 3.0], [0.4, 0.3, 0.02, 0.01])
    >>> curve.coverage, curve.median_error_rad
    (array([1.  , 0.75, 0.5 , 0.25]), array([0.16 , 0.02 , 0.015, 0.01 ]))
    """

    threshold: FloatArray
    coverage: FloatArray
    median_error_rad: FloatArray

    def at_coverage(self, share: float) -> tuple[float, float]:
        r"""Return the highest threshold that keeps at least a share of the bearings, and the error there.

        .. math:: \rho^* = \max\{\rho_0 : c(\rho_0) \ge s\}

        Parameters
        ----------
        share : float
            In (0, 1].

        Returns
        -------
        threshold, median_error_rad : float
            Prominence, and radians.

        Raises
        ------
        InvalidArgumentError
            If the share is out of range.

        Examples
        --------
        >>> gating_curve([1.1, 1.2, 2.0, 3.0], [0.5, 0.25, 0.125, 0.125]).at_coverage(0.5)
        (2.0, 0.125)
        """
        least = in_range("share", share, 0.0, 1.0, open_low=True)
        last = int(np.flatnonzero(self.coverage >= least - 1e-12)[-1])
        return float(self.threshold[last]), float(self.median_error_rad[last])


def gating_curve(prominence: ArrayLike, error_rad: ArrayLike) -> GatingCurve:
    r"""Compute coverage and median error over the prominence threshold from bearings with known errors.

    .. math:: c(\rho_0) = \frac{\#\{i : \rho_i \ge \rho_0\}}{n}, \qquad
              e(\rho_0) = \mathrm{median}\{|\epsilon_i| : \rho_i \ge \rho_0\}

    Parameters
    ----------
    prominence : array_like, shape (n,)
        Peak-to-median ratios; n >= 1.
    error_rad : array_like, shape (n,)
        Bearing minus truth, wrapped here.

    Returns
    -------
    GatingCurve
        One point for each occurring prominence, or an evenly spaced choice; the first keeps all.

    Raises
    ------
    InvalidArgumentError
        If a shape is wrong, there are no bearings, or a value is not finite.

    References
    ----------
    The results of the paper (gating by the peak-to-median ratio); C. K. Chow, "On optimum recognition error
    and reject tradeoff", IEEE Trans. IT 16, 1970 (the curve).

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> prominence = 1.0 + rng.exponential(0.5, 2000)
    >>> curve = gating_curve(prominence, rng.standard_normal(2000) * 0.1 / (prominence - 0.9))
    >>> len(curve.threshold), bool(curve.median_error_rad[150] < 0.5 * curve.median_error_rad[0])
    (200, True)
    """
    ratios = finite_array("prominence", prominence, (None,))
    errors = np.abs(wrap_angle(finite_array("error_rad", error_rad, ratios.shape)))
    if not len(ratios):
        raise InvalidArgumentError("prominence: expected at least one bearing, got none")
    order = np.argsort(ratios, kind="stable")
    ratios, errors = ratios[order], errors[order]
    # Equal prominences are kept or dropped together.
    starts = np.flatnonzero(np.diff(ratios, prepend=-np.inf))
    if len(starts) > _MOST_POINTS:
        starts = starts[np.linspace(0, len(starts) - 1, _MOST_POINTS).round().astype(np.intp)]
    medians = np.array([np.median(errors[start:]) for start in starts])
    return GatingCurve(ratios[starts], 1.0 - starts / len(ratios), medians)


def bearing_curve(checks: HopTable) -> GatingCurve | NotUsable:
    """Return the gating curve of the bearings that have a moving box as reference."""
    seen = np.isfinite(checks.error_rad)
    if not seen.any():
        return NotUsable("no bearing with a moving box in view")
    return gating_curve(checks.prominence[seen], checks.error_rad[seen])


def gated_median_deg(checks: HopTable) -> float:
    """Return the median error of the most prominent 16 %; NaN if no bearing has a reference."""
    curve = bearing_curve(checks)
    return np.nan if isinstance(curve, NotUsable) else np.degrees(curve.at_coverage(PUBLISHED_COVERAGE)[1])


# A miss costs half of it. At 20 degrees, a common choice for bearing trackers, no output (10) scores better
# than any estimate with an error of 10 degrees or more. At 60, a miss costs as much as the gate of the track
# measures.
CUTOFF_RAD = math.radians(60.0)


@dataclass(frozen=True, slots=True, eq=False)
class Gospa:
    """GOSPA at one instant: the total to the power p is the sum of its three parts.

    Examples
    --------
    >>> one = gospa_bearing([0.1, 2.0], [0.0], cutoff_rad=1.0)
    >>> round(one.total_rad, 3), one.missed, one.false, one.pairs.tolist()
    (0.6, 0.0, 0.5, [[0, 0]])
    """

    total_rad: float
    localisation: float  # Sum of the p-th powers of the errors of the pairs
    missed: float  # Half of the cut-off to the power p for each truth without an estimate
    false: float  # The same for each estimate without a truth
    pairs: IndexArray  # shape (k, 2): Rows of the matched estimate and truth


def gospa_bearing(
    estimates_rad: ArrayLike, truths_rad: ArrayLike, cutoff_rad: float = CUTOFF_RAD, order: float = 1.0
) -> Gospa:
    r"""Return the GOSPA (alpha = 2) between bearings, shapes (n,) and (m,); angles wrap.

    .. math:: d = \Big[\min_\gamma \sum_{(i,j) \in \gamma} d(x_i, y_j)^p
              + \frac{c^p}{2} \big(n + m - 2 |\gamma|\big)\Big]^{1/p}

    Examples
    --------
    >>> round(math.degrees(gospa_bearing([math.radians(179)], [math.radians(-179)]).total_rad), 6)
    2.0
    """
    # A. S. Rahmathullah, A. F. Garcia-Fernandez and L. Svensson, "Generalized optimal sub-pattern assignment
    # metric", FUSION 2017. With alpha = 2 a pair at the cut-off costs as much as one miss and one false
    # target, so the assignment may use pairs only, each limited to the cut-off.
    estimates = finite_array("estimates_rad", estimates_rad, (None,))
    truths = finite_array("truths_rad", truths_rad, (None,))
    power = in_range("order", order, 1.0, math.inf)
    cut = in_range("cutoff_rad", cutoff_rad, 0.0, math.inf, open_low=True) ** power
    cost = _bearing_errors(estimates, truths) ** power
    pairs = gated_pairs(cost, cost <= cut, cut)
    parts = (
        float(cost[pairs[:, 0], pairs[:, 1]].sum()),
        cut / 2.0 * (truths.size - len(pairs)),
        cut / 2.0 * (estimates.size - len(pairs)),
    )
    return Gospa(sum(parts) ** (1.0 / power), *parts, pairs)


# The gate of the LOCATA challenge.
GATE_RAD = math.radians(30.0)
# Angles are at most pi: a match within the gate always costs less than a miss, and a match kept from the
# previous hop (CLEAR-MOT) less than both.
_MISS, _HOLD = 1e3, 1e6
# Two tracks on the same side of two sources cost the same in both assignments, and round-off would swap their
# identities at random: a small part of the squared error decides by the order of the sources.
_TIE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class TrackRows:
    """Estimates, one row per hop and track.

    Examples
    --------
    >>> TrackRows(np.array([0, 1]), np.array([7, 7]), np.array([0.1, 0.2])).track
    array([7, 7])
    """

    hop: IntArray  # shape (n,): Number of the hop
    track: IntArray  # shape (n,): Identity
    azimuth_rad: FloatArray  # shape (n,)

    def __post_init__(self) -> None:
        finite_array("azimuth_rad", self.azimuth_rad, (len(self.hop),))
        check_shape("track", self.track.shape, self.hop.shape)


@dataclass(frozen=True, slots=True, eq=False)
class TruthRows:
    """Sources, one row per hop and source.

    Examples
    --------
    >>> TruthRows(np.array([0]), np.array([1]), np.array([0.1]), np.array([True])).active
    array([ True])
    """

    hop: IntArray  # shape (n,): Number of the hop
    source: IntArray  # shape (n,): Identity
    azimuth_rad: FloatArray  # shape (n,)
    active: BoolArray  # shape (n,): Whether a track is expected

    def __post_init__(self) -> None:
        finite_array("azimuth_rad", self.azimuth_rad, (len(self.hop),))
        check_shape("source", self.source.shape, self.hop.shape)
        check_shape("active", self.active.shape, self.hop.shape)


@dataclass(frozen=True, slots=True)
class TrackMeasures:
    """Means over active periods (runs of hops in which one source is active); NaN without an active source.

    Examples
    --------
    >>> hops = np.arange(10)
    >>> truth = TruthRows(hops, np.ones(10, int), np.zeros(10), np.ones(10, bool))
    >>> late = TrackRows(hops[3:], np.full(7, 4), np.full(7, 0.1))
    >>> said = track_measures(late, truth, hop_s=0.1)
    >>> round(said.latency_s, 3), said.detection, said.swap_rate_hz, round(said.azimuth_error_rad, 3)
    (0.3, 0.7, 0.0, 0.1)
    """

    latency_s: float  # Time from the start of a period to its first track; the whole period if there is none
    swap_rate_hz: float  # Changes of the track of a source, per second
    fragmentation_rate_hz: float  # Swaps and returns of a lost track, per second
    azimuth_error_rad: float  # Mean absolute error within the gate
    detection: float  # Share of the hops of a period with a track
    identity_switches: int  # Identity switches of CLEAR-MOT, which keeps a match while it is within the gate
    fragmentations: int
    active_s: float  # Total length of all periods


_NOTHING_ACTIVE = TrackMeasures(math.nan, math.nan, math.nan, math.nan, math.nan, 0, 0, 0.0)


def track_measures(
    estimates: TrackRows, truths: TruthRows, hop_s: float, gate_rad: float = GATE_RAD
) -> TrackMeasures:
    """Compare tracks with sources, matched hop by hop within a gate.

    Examples
    --------
    A track that is lost for one hop and comes back under another name:

    >>> hops = np.arange(10)
    >>> truth = TruthRows(hops, np.ones(10, int), np.zeros(10), np.ones(10, bool))
    >>> there = hops != 5
    >>> said = track_measures(TrackRows(hops[there], (hops > 5)[there] * 1, np.zeros(9)), truth, 0.1)
    >>> said.swap_rate_hz, said.fragmentation_rate_hz, said.identity_switches, said.fragmentations
    (1.0, 2.0, 1, 1)
    """
    period_s = in_range("hop_s", hop_s, 0.0, math.inf, open_low=True)
    gate = in_range("gate_rad", gate_rad, 0.0, math.pi)
    free, kept = (_match(estimates, truths, gate, keep=keep) for keep in (False, True))
    if not free.source.size:
        return _NOTHING_ACTIVE
    swaps, returns = free.swaps(), free.returns(free.period)
    return TrackMeasures(
        latency_s=float(free.latency_hops().mean()) * period_s,
        swap_rate_hz=free.rate(swaps) / period_s,
        fragmentation_rate_hz=free.rate(swaps, returns) / period_s,
        azimuth_error_rad=free.azimuth_error_rad(),
        detection=free.rate(np.flatnonzero(free.matched)),
        identity_switches=kept.swaps().size,
        fragmentations=kept.returns(kept.source).size,
        active_s=free.matched.size * period_s,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Matched:
    """The active rows by source and hop, each with its matched track."""

    source: IntArray
    period: IndexArray  # Number of the active period
    place: IndexArray  # Position within the period, in hops
    matched: BoolArray
    track: IntArray  # Number of the matched track, if any
    error_rad: FloatArray

    def swaps(self) -> IndexArray:
        """Return the rows at which a source has another track than at its last match."""
        # As in the challenge and in CLEAR-MOT, a new identity after misses or pauses counts as a swap.
        rows = np.flatnonzero(self.matched)
        changed: BoolArray = (np.diff(self.source[rows]) == 0) & (np.diff(self.track[rows]) != 0)
        return rows[1:][changed]

    def returns(self, stretch: IntArray | IndexArray) -> IndexArray:
        """Return the rows at which a source is matched again after misses in the same run of rows."""
        # The released code of the challenge also counts the first match after a late start. The article
        # defines only interrupted tracks, and a late start is already part of the latency.
        rows = np.flatnonzero(self.matched)
        resumed: BoolArray = (np.diff(rows) > 1) & (np.diff(stretch[rows]) == 0)
        return rows[1:][resumed]

    def latency_hops(self) -> IndexArray:
        """Return the hops of each period before its first match, or all of them if there is none."""
        # If left out, or set to 0 as in the released code, a source that is never found would lower the
        # latency.
        first = np.bincount(self.period)
        np.minimum.at(first, self.period[self.matched], self.place[self.matched])
        return first

    def azimuth_error_rad(self) -> float:
        """Return the mean over periods of the mean error; periods without a match are left out."""
        counts = np.bincount(self.period[self.matched])
        sums = np.bincount(self.period[self.matched], self.error_rad[self.matched])
        return float(np.mean(sums[counts > 0] / counts[counts > 0])) if counts.size else math.nan

    def rate(self, *events: IndexArray) -> float:
        """Return the number of events per hop, mean over periods."""
        hops = np.bincount(self.period)
        happened = np.bincount(self.period[np.concatenate(events)], minlength=hops.size)
        return float(np.mean(happened / hops))


def _match(estimates: TrackRows, truths: TruthRows, gate: float, *, keep: bool) -> _Matched:
    track, error = _match_hops(estimates, truths, gate, keep)
    order = np.lexsort((truths.hop, truths.source))
    order = order[truths.active[order]]
    hop, source = truths.hop[order], truths.source[order]
    begins = (np.diff(source, prepend=source[:1] - 1) != 0) | (np.diff(hop, prepend=0) != 1)
    period = np.cumsum(begins) - 1
    return _Matched(
        source=source,
        period=period,
        place=np.arange(hop.size) - np.flatnonzero(begins)[period],
        matched=np.isfinite(error[order]),
        track=track[order],
        error_rad=error[order],
    )


def _match_hops(
    estimates: TrackRows, truths: TruthRows, gate: float, keep: bool
) -> tuple[IntArray, FloatArray]:
    """Return track and error of every truth, NaN if it has none."""
    track, error = np.zeros(truths.hop.size, np.int64), np.full(truths.hop.size, np.nan)
    there = _rows_by_hop(np.arange(estimates.hop.size), estimates.hop)
    active = _rows_by_hop(np.flatnonzero(truths.active), truths.hop)
    last: set[tuple[int, int, int]] = set()
    for hop in sorted(active.keys() & there.keys()):
        rows, said = active[hop], there[hop]
        sources, names = truths.source[rows].tolist(), estimates.track[said].tolist()
        # Matches of the previous hop are kept, as in CLEAR-MOT; after a miss the nearest track is taken.
        held = np.array([[(hop - 1, source, name) in last for name in names] for source in sources])
        cost = _bearing_errors(truths.azimuth_rad[rows], estimates.azimuth_rad[said])
        within = cost <= gate
        price = cost + _TIE * cost**2 - _HOLD * (keep & held & within)
        pairs = gated_pairs(price, within, _MISS)
        ours, theirs = rows[pairs[:, 0]], said[pairs[:, 1]]
        track[ours], error[ours] = estimates.track[theirs], cost[pairs[:, 0], pairs[:, 1]]
        last = {(hop, sources[i], names[j]) for i, j in pairs.tolist()}
    return track, error


def _rows_by_hop(rows: IndexArray, hop: IntArray) -> dict[int, IndexArray]:
    rows = rows[np.argsort(hop[rows], kind="stable")]
    values, starts = np.unique(hop[rows], return_index=True)
    # The piece before the first start is empty, and the only one if there are no rows.
    return dict(zip(values.tolist(), np.split(rows, starts)[1:], strict=True))


def _bearing_errors(truths_rad: FloatArray, estimates_rad: FloatArray) -> FloatArray:
    """Return the absolute angle of every estimate from every truth, shape (truths, estimates)."""
    return np.abs(wrap_angle(truths_rad[:, None] - estimates_rad))
