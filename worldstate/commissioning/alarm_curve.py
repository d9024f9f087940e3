r"""Alarm curve: onsets of the filter on hazard-free streams, at every threshold.

An onset is the hop at which an alarm of either side begins. Rates differ between junctions: :math:`\kappa` is
the square of their coefficient of variation. The mean rate at K other junctions, estimated from n onsets at J
junctions, is as uncertain as the rate of one Poisson process after

.. math:: m = \Big( \frac{1}{n} + \frac{\kappa}{J} + \frac{\kappa}{K} \Big)^{-1}

onsets, whose exact interval is used.

Source: J. Hilbe, "Negative binomial regression", 2011.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator

import numpy as np

from worldstate.abduction.co_evidence import Unqueried
from worldstate.abduction.road_users import DomainGuard, DomainVerdict, Foreign, beyond, neutral
from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.abduction.sequence.sequence_model import HELD_HOPS, AlarmCurve, SequenceAlarm, SequenceModel
from worldstate.abduction.sequence.sequence_reader import LEAST_HOPS, TOO_FEW, SequenceReading
from worldstate.abduction.sequence.street_sides import StreetListener
from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.abduction.signature.site_estimate import SiteSignature
from worldstate.adapters.acoustic import asked_again, beside_foreign
from worldstate.belief.street_model import FilterSettings, StreetModel
from worldstate.core.filter import WorldFilter
from worldstate.frontend.spectra.sound_character import MEASURES
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.ground.values import SECONDS_PER_HOUR, NotUsable, nanoseconds
from worldstate.measurement.measurement import Approach, Bearing, CoEvidenceChannel, Heard, Measurement
from worldstate.operations.corpus.approach_meter import alarm_level
from worldstate.operations.metrics.approach_table import poisson_interval, rising_edges
from worldstate.operations.recordings.hop_table import HOP_S
from worldstate.state import WorldState

from .guard_training import heard_characters
from .heard_stream import HeardStream

# With fewer expected onsets a threshold depends on chance alone.
LEAST_ONSETS = 3.0
# A junction counts for at most this many times the requested onsets. If 20 per hour are requested, limits of
# 2, 3, 4 and 6 leave 22, 17, 13 and 8 % of other junctions above 20, and 88.8, 88.1, 87.0 and 84.9 % of
# approaches are detected.
LOUDEST = 3.0
# Junctions of a route; the rate at a single one may differ by a factor of three in either direction
ELSEWHERE = 4
UNREACHED = SequenceAlarm(1e6, 1.0)  # No alarm reaches this threshold, so it has no effect
_LEAST, _QUANTILE = 1e-9, 0.75
_POINTS, _MOST_SHARE = 200, 0.3  # Number of thresholds; the lowest is reached by this share of the hops
HELD_HOURS = HELD_HOPS * HOP_S / SECONDS_PER_HOUR


def measurements(
    heard: HeardStream,
    windows: EnsembleModel,
    sequence: SequenceModel,
    evidence: FloatArray,
    vision: CoEvidenceChannel | None = None,
    street: StreetListener | None = None,
    guard: DomainGuard | None = None,
) -> Iterator[Measurement]:
    """Yield one measurement per hop, like the acoustic adapter.

    `street` corrects the sides and learns from the passes that the filter reports to it.
    """
    domains = _judged(heard, guard)
    if guard is not None:
        foreign = np.array([isinstance(one, Foreign) for one in domains])
        evidence = evidence.copy()
        evidence[foreign, : len(SIDES)] = beyond(evidence[foreign, : len(SIDES)], guard.margin)
    hops, signature, groups = heard.hops, SiteSignature(windows), sequence.posterior(evidence).groups
    for i in range(len(hops)):
        told = groups[i]
        if street is not None and i + 1 >= LEAST_HOPS:
            told = street.turned(told, hops.feature[i])
        reading = SequenceReading(told, sequence.share, sequence.margin_s, sequence.alarm)
        said, domain = signature.evidence(hops.feature[i]), domains[i]
        share = Heard(float(hops.heard[i]), str(hops.unheard[i]) or None, float(hops.excess_db[i]))
        if isinstance(domain, Foreign) and guard is not None:
            said, share = neutral(said, guard.margin), beside_foreign(domain, share)
        measurement = Measurement(
            stamp_ns=nanoseconds(float(hops.time_s[i])),
            signature=said,
            co_evidence=Unqueried("no camera"),
            bearing=_bearing(heard, i),
            approach=_approach(heard, i),
            sequence=reading if i + 1 >= LEAST_HOPS else TOO_FEW,
            heard=share,
            domain=domain,
        )
        yield asked_again(measurement, vision)


def _judged(heard: HeardStream, guard: DomainGuard | None) -> list[DomainVerdict | None]:
    """Return the guard's verdict on every hop; None before it has enough sound."""
    if guard is None:
        return [None] * len(heard.hops)
    rows, usable = heard_characters(heard)
    told = iter(rows[:, : len(MEASURES)])
    return [guard.judge(next(told)) if one else None for one in usable]


def _bearing(heard: HeardStream, i: int) -> Bearing | NotUsable:
    hops = heard.hops
    if not np.isfinite(hops.bearing_rad[i]):
        return NotUsable("no peak above noise")
    return Bearing(float(hops.bearing_rad[i]), float(hops.bearing_std_rad[i]), float(hops.prominence[i]))


def _approach(heard: HeardStream, i: int) -> Approach | NotUsable:
    rate_hz, std_hz = float(heard.hops.looming_hz[i]), float(heard.hops.looming_std_hz[i])
    return Approach(rate_hz, std_hz) if np.isfinite(rate_hz) else NotUsable("no looming above noise")


def stream_states(
    heard: HeardStream,
    windows: EnsembleModel,
    sequence: SequenceModel,
    evidence: FloatArray,
    guard: DomainGuard | None = None,
    street: StreetModel | None = None,
) -> Iterator[WorldState]:
    """Yield the snapshot of every hop of a stream without a camera, with the parameters `street`."""
    world = WorldFilter(settings=FilterSettings(street=street or StreetModel()))
    for measurement in measurements(heard, windows, sequence, evidence, guard=guard):
        world = world.update(measurement)
        yield world.state


def advised(states: Iterable[WorldState]) -> BoolArray:
    """Return whether each side, left and right, has an advisory at every hop, shape (n, 2)."""
    told = ({cue.direction for cue in one.cues if cue.advisory is not None} for one in states)
    return np.array([[side in sides for side in SIDES] for sides in told])


def alarm_levels(states: Iterable[WorldState], street: StreetModel | None = None) -> FloatArray:
    """Return the highest threshold that raises the alarm of each side at every hop, shape (n, 2).

    The states must have the alarm `UNREACHED` and the parameters `street`. The value is the filter's log-odds
    minus the current increase of its threshold. It is minus infinity if there was too little sound, or if the
    risk contradicts an alarm.
    """
    denied = (street or StreetModel()).death
    levels = [[alarm_level(state, side, denied, UNREACHED) for side in SIDES] for state in states]
    return np.array([[-np.inf if one is None else one for one in hop] for hop in levels])


def check_hours(name: str, hours: float, onsets_per_hour: float) -> None:
    """Raise an error if there are too few hours to set an alarm."""
    if hours * onsets_per_hour < LEAST_ONSETS:
        wanted = f"{LEAST_ONSETS / onsets_per_hour:.2f} hours for {onsets_per_hour:g} onsets per hour"
        problem = f"expected {wanted}, got {hours:.2f}; use more sound, or allow more onsets"
        raise InvalidArgumentError(f"{name}: {problem}")


def raised_at(levels: FloatArray, threshold_nats: float) -> BoolArray:
    """Return whether any side is in alarm at every hop, (n,): at least 1 s unless the risk contradicts it."""
    sides = levels.reshape(len(levels), -1)
    at = np.arange(len(sides))[:, None]
    last, denied = (
        np.maximum.accumulate(np.where(is_so, at, -HELD_HOPS - 1), axis=0)
        for is_so in (sides >= threshold_nats, np.isneginf(sides))
    )
    return np.asarray(((at - last <= HELD_HOPS) & (denied < last)).any(axis=1))


def measured_curve(quiet: Iterable[tuple[str, FloatArray]], *, elsewhere: bool = False) -> AlarmCurve:
    r"""Count onsets and hops in alarm on hazard-free streams, at decreasing thresholds.

    With `elsewhere`, the rate of a point is the smallest budget b that is expected to hold at another
    junction (A. Angelopoulos et al., "Conformal risk control", ICLR 2024, eq. 4),

    .. math:: \frac{1}{J + 1} \Big( L b + \sum_{j=1}^J \min(r_j, L b) \Big) \le b, \qquad L = 3

    with the maximum rate r of onsets per hour at junction j up to this threshold. The interval of the mean
    rate is extended to this budget. Without `elsewhere`, the rate is that of all hours together.

    Parameters
    ----------
    quiet : iterable of (str, ndarray of shape (hops, sides))
        Junction and `alarm_levels` of every stream; shape (hops,) for a single level.
    elsewhere : bool
        Whether the rate is for another junction.

    Raises
    ------
    InvalidArgumentError
        If there is no stream, or with `elsewhere` if there are fewer than two junctions.
    """
    there = defaultdict[str, list[FloatArray]](list)
    for junction, levels in quiet:
        there[junction].append(levels)
    if not there or (elsewhere and len(there) < LOUDEST - 1.0):
        raise InvalidArgumentError(f"quiet: expected at least {LOUDEST - 1:g} junctions, got {len(there)}")
    streams = [one for some in there.values() for one in some]
    first = np.cumsum([0, *map(len, list(there.values())[:-1])])
    thresholds = _thresholds(np.concatenate(streams))
    raised = [[raised_at(one, level) for level in thresholds.tolist()] for one in streams]
    onsets = np.add.reduceat([[rising_edges(on).size for on in stream] for stream in raised], first)
    hops = np.add.reduceat([len(one) for one in streams], first)
    share = np.sum([[on.sum() for on in stream] for stream in raised], axis=0) / hops.sum()
    hours = hops * HOP_S / SECONDS_PER_HOUR
    # Onsets may decrease at lower thresholds, because neighbouring alarms merge.
    worst = np.maximum.accumulate(onsets / hours[:, None], axis=1)
    counted = np.maximum.accumulate(onsets.sum(axis=0))
    rates = budgets_elsewhere(worst) if elsewhere else counted / hours.sum()
    # No alarm is shorter than a second, so larger budgets have no meaning.
    known = rates <= SECONDS_PER_HOUR
    thresholds, rates, counted, share = (one[known] for one in (thresholds, rates, counted, share))
    fewer = 1.0 + _variation(onsets, hours) * (1.0 / ELSEWHERE + 1.0 / len(hours)) * counted
    intervals = [poisson_interval(*one) for one in zip(counted / fewer, hours.sum() / fewer, strict=True)]
    onsets_between = np.maximum.accumulate(intervals, axis=0).T
    onsets_between[1] = np.maximum(onsets_between[1], rates)
    # Alarms at other junctions have the same mean length; before the first alarm, it is the holding time.
    lasts = np.divide(share * hours.sum(), counted, np.full(share.shape, HELD_HOURS), where=counted > 0)
    share_between = np.maximum.accumulate(np.minimum(onsets_between * lasts, 1.0), axis=1)
    (low, high), (share_low, share_high) = onsets_between, share_between
    every = (rates, low, high, share, share_low, share_high)
    return AlarmCurve(thresholds, *every, float(hours.sum()), LEAST_ONSETS)


def _thresholds(levels: FloatArray) -> FloatArray:
    """Return decreasing thresholds; no level reaches the first one."""
    highest = levels.reshape(len(levels), -1).max(axis=1)
    known = np.sort(highest[np.isfinite(highest)])[::-1]
    ranks = np.unique(np.geomspace(1, max(_MOST_SHARE * highest.size, 1), _POINTS).astype(np.intp))
    reached = known[ranks[ranks <= known.size] - 1]
    return np.unique([*reached, known.max(initial=0.0) + 1.0])[::-1]


def budgets_elsewhere(worst: FloatArray) -> FloatArray:
    """Return the smallest budget that is expected to hold at another junction, at every threshold.

    If the rates of the m loudest junctions are limited to L budgets, the budget is the sum of the other rates
    over J + 1 - L (m + 1). The smallest such budget is returned.

    Shapes: worst (junctions, thresholds), the maximum rate of onsets per hour so far.
    """
    junctions = len(worst)
    fewer = np.sort(worst, axis=0)[::-1]
    others = fewer.sum(axis=0) - np.concatenate([np.zeros((1, fewer.shape[1])), np.cumsum(fewer, axis=0)])
    left = junctions + 1 - LOUDEST * np.arange(1, junctions + 2)
    # With two junctions no rate is limited, so the budget is finite only without onsets at both.
    least = (others[left >= 0.0] / np.maximum(left[left >= 0.0, None], _LEAST)).min(axis=0)
    # More onsets never require a smaller budget, but sums over many junctions are rounded.
    return np.asarray(np.maximum.accumulate(np.maximum(least, 0.0)))


def _variation(onsets: FloatArray, hours: FloatArray) -> float:
    """Return the squared coefficient of variation of the junctions' rates beyond chance, by moments."""
    expected = onsets.sum(axis=0) / hours.sum() * hours[:, None]
    known = expected.min(axis=0) >= 1.0
    if len(hours) < 2 or not known.any():
        return 0.0
    expected, counts, others = expected[:, known], onsets[:, known], 1.0 - hours[:, None] / hours.sum()
    excess = (np.square(counts - expected) / others - expected).sum(axis=0) / np.square(expected).sum(axis=0)
    # A dozen junctions determine it poorly. With the upper quartile over the thresholds, the interval for one
    # other junction contains its rate in 88 to 94 % of 1500 draws of gamma distributions; with the median, in
    # 80 to 92 %.
    return max(float(np.quantile(excess, _QUANTILE)), 0.0)
