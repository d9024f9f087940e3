"""Detection rate, lead time and false-alarm rate of an alarm on approaches and hazard-free time.

All onsets and leads are computed here. A study makes one outcome per approach, keeps the alarm of each
hazard-free stream, and computes the figures from a table of both:

>>> calm = np.zeros(36_000, bool)
>>> calm[100:140] = True
>>> table = ApproachTable([onset_outcome([5.5, 6.0], t0_s=7.0), onset_outcome([], t0_s=7.0)], [calm])
>>> found = table.figures()
>>> found["detected"], found["lead_s"], found["lead_missed_as_0_s"], found["onsets_per_hour"]
(0.5, 1.5, 0.75, 1.0)

There are two definitions of a detection, one for each kind of data. A recording contains one approach, and
its first *onset* is decisive: `onset_outcome`. In a stream an alarm may continue from the approach before,
and either side may be in alarm, so the first *hop* in alarm is decisive: `hop_outcome`. Onsets more than 5 s
before T0, and hops more than 8 s (the risk's horizon) before it, are attributed to other events.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.sequence.sequence_inputs import HOP_S
from worldstate.abduction.sequence.sequence_model import COMING_S
from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.ground.values import SECONDS_PER_HOUR


def auroc(scores: ArrayLike, positive: ArrayLike) -> float | None:
    r"""Return the area under the ROC curve; None if one of the two labels does not occur.

    .. math:: P(s^+ > s^-) + P(s^+ = s^-) / 2

    Parameters
    ----------
    scores : array_like, shape (n,)
        Scores, larger for positives.
    positive : array_like of bool, shape (n,)
        Labels.

    Returns
    -------
    float or None
        In [0, 1].

    Raises
    ------
    InvalidArgumentError
        If the shapes differ or a score is not finite.

    Examples
    --------
    >>> auroc([0.1, 0.4, 0.4, 0.8], [False, True, False, True])
    0.875
    """
    values = finite_array("scores", scores, (None,))
    labels = finite_array("positive", positive, values.shape) > 0.5
    n_positive, n_negative = int(labels.sum()), int((~labels).sum())
    if not n_positive or not n_negative:
        return None
    return float(rank_wins([values[labels]], [values[~labels]])[0, 0]) / (n_positive * n_negative)


def rank_wins(positives: Sequence[FloatArray], negatives: Sequence[FloatArray]) -> FloatArray:
    r"""Return how often windows of recording p score above those of recording q, shape (P, Q).

    .. math:: W_{pq} = \sum_{i \in p, j \in q} [s_i > s_j] + [s_i = s_j] / 2

    The area under the ROC curve over any choice of recordings is then a ratio of sums, ties included.

    Examples
    --------
    >>> rank_wins([np.array([0.5, 0.9])], [np.array([0.5]), np.array([0.1, 0.7])])
    array([[1.5, 3. ]])
    """
    scores = np.concatenate([np.zeros(0), *positives])
    ends = np.cumsum([0, *map(len, positives)])
    wins = np.zeros((len(positives), len(negatives)))
    for q, one in enumerate(map(np.sort, negatives)):
        below = (np.searchsorted(one, scores, "left") + np.searchsorted(one, scores, "right")) / 2.0
        # Halves are exact in binary, so differences of the running sum are exact too.
        wins[:, q] = np.diff(np.concatenate([[0.0], np.cumsum(below)])[ends])
    return wins


Figures = dict[str, float | int | None]
LONGEST_LEAD_S, AFTER_S = 5.0, 6.0
NEAR_S = 1.5  # The sound of two vehicles with a smaller gap overlaps in one window
# A hop ends with a sample and T0 is a camera frame, so a hop that ends at T0 differs from it by 10 us or
# more.
SLACK_S = 1e-3
# With fewer, one recording changes a rate by more than 5 %, and most intervals are too wide to be useful.
FEWEST_RECORDINGS = 20


@dataclass(frozen=True, slots=True)
class StreamApproach:
    """Vehicles of one approach, in the order in which they come into view."""

    flow: str = "single"  # "single", "both" or "queue"
    entries_s: tuple[float, ...] = ()
    sides: tuple[int, ...] = ()
    kinds: tuple[str, ...] = ()
    quiet: bool = False  # Whether any of them is a quiet road user; no target is set for these


@dataclass(frozen=True, slots=True)
class ApproachOutcome:
    """Result of an alarm for one approach.

    Examples
    --------
    >>> ApproachOutcome(lead_s=1.7).detected, ApproachOutcome(lead_s=0.0).detected
    (True, False)
    """

    lead_s: float  # Time from the first alarm within the longest lead to T0; 0 if missed
    onsets: int = 0  # Onsets within the longest lead before T0
    onsets_earlier: int = 0  # Onsets before the longest lead
    onsets_after: int = 0  # Onsets in the 6 s after the last T0 (streams only)
    # Whether the side of the first vehicle, the other side, and the sides of all vehicles were in alarm, each
    # within the longest lead before its T0 (streams only).
    own_side: bool = False
    other_side: bool = False
    every_side: bool = False
    # Whether any side was in alarm in the last second before T0, and in the last hop before it (streams
    # only).
    last_second: bool = False
    at_t0: bool = False
    approach: StreamApproach = StreamApproach()

    @property
    def detected(self) -> bool:
        """Whether an alarm began before line of sight."""
        return self.lead_s > 0.0


def rising_edges(alarm: ArrayLike) -> IndexArray:
    """Return the hops at which an alarm begins; an initial alarm begins at the first hop.

    Examples
    --------
    >>> rising_edges([True, False, False, True, True])
    array([0, 3])
    """
    on = finite_array("alarm", alarm, (None,)) > 0.5
    return np.flatnonzero(on & ~np.concatenate([[False], on[:-1]]))


def onset_outcome(onsets_s: ArrayLike, t0_s: float) -> ApproachOutcome:
    """Compare the onsets of one recording with its line-of-sight entry, in seconds from its start.

    Examples
    --------
    >>> found = onset_outcome([0.5, 5.5, 6.75], t0_s=7.0)
    >>> found.lead_s, found.onsets, found.onsets_earlier
    (1.5, 2, 1)
    """
    lead_s = in_range("t0_s", t0_s, -np.inf, np.inf) - finite_array("onsets_s", onsets_s, (None,))
    early = lead_s > LONGEST_LEAD_S + SLACK_S
    counted = lead_s[(lead_s > SLACK_S) & ~early]
    return ApproachOutcome(float(counted.max(initial=0.0)), counted.size, int(early.sum()))


HORIZON_S = COMING_S[-1]  # Horizon of the risk: earlier alarms belong to other events


def hop_outcome(
    approach: StreamApproach, time_s: FloatArray, raised: BoolArray, longest_s: float = HORIZON_S
) -> ApproachOutcome:
    """Return the outcome of one approach in a stream, from time_s (n,) and the alarms of both sides (n, 2).

    Alarms more than `longest_s` before T0 are ignored.

    Examples
    --------
    >>> time_s = 0.1 * np.arange(100)
    >>> left = np.column_stack([time_s > 5.55, np.zeros(100, bool)])
    >>> found = hop_outcome(StreamApproach("single", (8.0,), (1,)), time_s, left)
    >>> round(found.lead_s, 1), found.own_side, found.other_side
    (2.4, False, True)
    """
    first_s, last_s = approach.entries_s[0], max(approach.entries_s)
    before, any_side = shortly_before(time_s, first_s, longest_s), np.asarray(raised.any(axis=1))
    alarms_s, onsets_s = time_s[before & any_side], time_s[rising_edges(any_side)]
    named = np.asarray(raised[before].any(axis=0))
    pairs = zip(approach.entries_s, approach.sides, strict=True)
    last = any_side[shortly_before(time_s, first_s, 1.0)]
    return ApproachOutcome(
        lead_s=first_s - float(alarms_s[0]) if alarms_s.size else 0.0,
        onsets=int(((onsets_s > first_s - longest_s) & (onsets_s < first_s)).sum()),
        onsets_after=int(((onsets_s >= last_s) & (onsets_s < last_s + AFTER_S)).sum()),
        own_side=bool(named[approach.sides[0]]),
        other_side=bool(named[1 - approach.sides[0]]),
        every_side=all(raised[shortly_before(time_s, t0_s, longest_s), side].any() for t0_s, side in pairs),
        last_second=bool(last.any()),
        at_t0=bool(last[-1:].any()),
        approach=approach,
    )


def shortly_before(time_s: FloatArray, entry_s: float, longest_s: float = HORIZON_S) -> BoolArray:
    """Return the hops in the last seconds before a T0, shape (n,)."""
    return np.asarray((time_s > entry_s - longest_s) & (time_s < entry_s - SLACK_S))


@dataclass(frozen=True, slots=True, eq=False)
class ApproachTable:
    """Outcomes of approaches, and alarms of hazard-free streams, shape (n,), or (n, 2) by side.

    Examples
    --------
    >>> table = ApproachTable([], [np.array([False, True, True, False]), np.array([True] * 5 + [False] * 3)])
    >>> table.onsets, round(table.figures()["onsets_per_hour"]), table.figures()["detected"]
    (2, 6000, None)
    """

    outcomes: Sequence[ApproachOutcome]
    hazard_free: Sequence[BoolArray]

    @property
    def hours(self) -> float:
        """Hours of evaluated hazard-free time."""
        return sum(map(len, self.hazard_free)) * HOP_S / SECONDS_PER_HOUR

    @property
    def onsets(self) -> int:
        """Number of false alarms: rising edges in hazard-free time."""
        return sum(rising_edges(alarm).size for alarm in self._alarms())

    def figures(self) -> Figures:
        """Return detection and false-alarm figures; None for those without data."""
        return self.detections() | self.false_alarms()

    def detections(self) -> Figures:
        """Return the detected share with exact 95 % interval, and the mean lead with and without misses."""
        detected = [one.detected for one in self.outcomes]
        low, high = share_interval(sum(detected), len(detected)) if detected else (None, None)
        return {
            "approaches": len(detected),
            "detected": mean_of(detected),
            "detected_low": low,
            "detected_high": high,
            "lead_s": mean_of([one.lead_s for one in self.outcomes if one.detected]),
            "lead_missed_as_0_s": mean_of([one.lead_s for one in self.outcomes]),
        }

    def standing(self) -> Figures:
        """Return the share of approaches in alarm in the last second, and in the last hop, before T0."""
        return {
            "advised_last_second": mean_of([one.last_second for one in self.outcomes]),
            "advised_at_t0": mean_of([one.at_t0 for one in self.outcomes]),
        }

    def sides(self) -> Figures:
        """Return the shares of singles announced from the other side, and of pairs on both sides."""
        singles, both = (self.of_flow(flow).outcomes for flow in ("single", "both"))
        gaps_s = (one.approach.entries_s[-1] - one.approach.entries_s[0] for one in both)
        near = [one.every_side for one, gap_s in zip(both, gaps_s, strict=True) if gap_s < NEAR_S]
        return {
            "singles": len(singles),
            "other_side_too": mean_of([one.other_side for one in singles]),
            "wrong_side_only": mean_of([one.other_side and not one.own_side for one in singles]),
            "both": len(both),
            "both_sides_found": mean_of([one.every_side for one in both]),
            "both_near": len(near),
            "both_near_found": mean_of(near),
        }

    def false_alarms(self) -> Figures:
        """Return onsets per hazard-free hour with the exact interval, and the share of that time in alarm."""
        if not self.hours:
            return {"hazard_free_hours": 0.0, "onsets_per_hour": None, "hazard_free_share": None}
        low, high = poisson_interval(self.onsets, self.hours)
        return {
            "hazard_free_hours": self.hours,
            "onsets_per_hour": self.onsets / self.hours,
            "hazard_free_share": mean_of(np.concatenate(self._alarms())),
            "onsets_low": low,
            "onsets_high": high,
        }

    def of_flow(self, flow: str) -> "ApproachTable":
        """Return the table with the approaches of one flow."""
        return ApproachTable([one for one in self.outcomes if one.approach.flow == flow], self.hazard_free)

    def loud(self) -> "ApproachTable":
        """Return the table without the approaches of quiet road users."""
        return ApproachTable([one for one in self.outcomes if not one.approach.quiet], self.hazard_free)

    def _alarms(self) -> list[BoolArray]:
        return [one if one.ndim == 1 else np.asarray(one.any(axis=1)) for one in self.hazard_free]


def mean_of(values: Sequence[float] | Sequence[bool] | FloatArray | BoolArray) -> float | None:
    """Return the mean, None for no values."""
    return float(np.mean(values)) if len(values) else None


def caution(count: int, what: str = "recordings") -> str | None:
    """Return a caution for figures from too few recordings; None from 20 on.

    Examples
    --------
    >>> caution(6), caution(20)
    ('6 recordings: figures from fewer than 20 cannot be read', None)
    """
    if count >= FEWEST_RECORDINGS:
        return None
    return f"{count} {what}: figures from fewer than {FEWEST_RECORDINGS} cannot be read"


def poisson_interval(count: float, exposure: float, confidence: float = 0.95) -> tuple[float, float]:
    r"""Return the exact interval of a Poisson rate, in alarms per hour if the exposure is in hours.

    .. math:: \left[\chi^2_{\alpha/2}(2n),\ \chi^2_{1-\alpha/2}(2n + 2)\right] / 2T

    Examples
    --------
    >>> low, high = poisson_interval(0, exposure=0.103)
    >>> low, round(high, 1)
    (0.0, 35.8)
    """
    # F. Garwood, "Fiducial limits for the Poisson distribution", Biometrika 28, 1936. One alarm more or less
    # changes the rate by 1 / T, so without any alarm the upper end shows how little data there are.
    from scipy.special import gammaincinv

    whole = in_range("count", count, 0, np.inf)
    time = in_range("exposure", exposure, 0.0, np.inf, open_low=True)
    tail = (1.0 - in_range("confidence", confidence, 0.0, 1.0, open_low=True, open_high=True)) / 2.0
    # A chi-square with 2 n degrees of freedom is twice a Gamma(n), whose inverse needs no scipy.stats.
    low = float(gammaincinv(whole, tail)) if whole else 0.0
    return low / time, float(gammaincinv(whole + 1.0, 1.0 - tail)) / time


def share_interval(count: int, of: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the exact interval of a share.

    Examples
    --------
    >>> low, high = share_interval(0, of=1000)
    >>> low, round(high, 4)
    (0.0, 0.0037)
    """
    # C. Clopper and E. Pearson, "The use of confidence or fiducial limits", Biometrika 26, 1934.
    from scipy.special import betaincinv

    whole = in_range("count", count, 0, in_range("of", of, 1, np.inf))
    tail = (1.0 - in_range("confidence", confidence, 0.0, 1.0, open_low=True, open_high=True)) / 2.0
    low = float(betaincinv(whole, of - whole + 1.0, tail)) if whole else 0.0
    return low, float(betaincinv(whole + 1.0, of - whole, 1.0 - tail)) if whole < of else 1.0
