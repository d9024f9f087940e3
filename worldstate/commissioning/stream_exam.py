"""What a sequence model is worth on streams: approaches detected, alarms an hour, calibration, times.

An approach is one vehicle, two that come from both sides at once, or one with another behind it. It is
detected where an alarm stands at some hop of the five seconds before the first T0, and its lead is counted
from the first such hop; the next approach lies farther away than that. An onset is a rising edge of the alarm
of either side in a stream without hazards.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.abduction.cueing.calibration_error import brier_skill, expected_calibration_error
from worldstate.abduction.cueing.conformal import risk_controlling
from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.abduction.sequence.sequence_model import (
    HORIZONS_S,
    LONGEST_S,
    SequenceAlarm,
    SequencePosterior,
    held,
    smoothed_log_odds,
)
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.operations.metrics.alarm_rate import poisson_interval, share_interval
from worldstate.operations.metrics.roc import auroc
from worldstate.operations.metrics.time_to_visible import visible_errors
from worldstate.operations.recordings.advisories import (
    LONGEST_LEAD_S,
    SECONDS_PER_HOUR,
    SLACK_S,
    rising_edges,
)
from worldstate.operations.recordings.hop_stream import HOP_S

from .heard_stream import HeardStream
from .stream_labels import QUIET_KINDS, StreamTruth

TOGETHER_S, FOLLOWING_S, AFTER_S = 4.0, 6.0, 6.0
# A junction counts for no more than so many times the onsets that are asked for. Up to 2, 3, 4 and 6 times at
# 20 an hour leave .22, .17, .13 and .08 of other junctions above that, and detect .888, .881, .870 and .849.
LOUDEST = 3.0
_CALIBRATED_S = (1.0, 2.0, 3.0)
# The ten hops before T0, without T0 itself: there the vehicle is as good as in view.
_LAST_SECOND_S = np.arange(1, 11) * HOP_S


@dataclass(frozen=True, slots=True)
class StreamApproach:
    """Vehicles that belong together, the first to come into view first."""

    flow: str  # "single", "both" or "queue"
    entries_s: tuple[float, ...]
    sides: tuple[int, ...]
    kinds: tuple[str, ...]

    @property
    def quiet(self) -> bool:
        """Whether any of them is a quiet road user, which has no target of its own."""
        return any(kind in QUIET_KINDS for kind in self.kinds)


@dataclass(frozen=True, slots=True, eq=False)
class ExaminedStream:
    """A stream, what a model believed of it, and the alarm that was set without it."""

    heard: HeardStream
    truth: StreamTruth
    posterior: SequencePosterior
    alarm: SequenceAlarm


def approaches(heard: HeardStream) -> list[StreamApproach]:
    """Collect the approaches of a stream by the flows that its vehicles arrived in."""
    vehicles = heard.vehicles
    order = np.argsort(vehicles.entry_s)
    left = [i for i in order.tolist() if vehicles.hazard[i] and np.isfinite(vehicles.entry_s[i])]
    found = []
    while left:
        first = left.pop(0)
        flow, entry_s = vehicles.flow[first], vehicles.entry_s[first]
        with_it = [i for i in left if _belongs(flow, vehicles.flow[i], vehicles.entry_s[i] - entry_s)]
        # A follower's leader is the only one of its arm so shortly before it.
        with_it = [i for i in with_it if (vehicles.arm[i] == vehicles.arm[first]) == (flow == "queue")]
        left = [i for i in left if i not in with_it]
        every = [first, *with_it]
        found.append(
            StreamApproach(
                flow if flow in ("both", "queue") else "single",
                tuple(vehicles.entry_s[every].tolist()),
                tuple(SIDES.index(arm) for arm in vehicles.arm[every]),
                tuple(vehicles.kind[every].tolist()),
            )
        )
    return found


def _belongs(flow: str, other: str, later_s: float) -> bool:
    if flow == "both":
        return other == "both" and later_s < TOGETHER_S
    return flow == "queue" and other == "follows" and later_s < FOLLOWING_S


def alarm_for(quiet: Sequence[SequencePosterior], onsets_per_hour: float) -> SequenceAlarm:
    """Return the lowest threshold at which hazard-free streams have no more onsets an hour."""
    thresholds, onsets, hours = _onsets(quiet)
    rates = np.maximum.accumulate(onsets.sum(axis=0)) / hours.sum()
    return SequenceAlarm(float(thresholds[np.sum(rates <= onsets_per_hour) - 1]), onsets_per_hour)


def alarm_elsewhere(quiet: Sequence[Sequence[SequencePosterior]], onsets_per_hour: float) -> SequenceAlarm:
    """Return the lowest threshold that a junction not among these may be expected to have no more onsets at.

    Takes the hazard-free streams of each junction, of two at least.
    """
    thresholds, *counted = _onsets([one for there in quiet for one in there])
    first = np.cumsum([0, *map(len, quiet[:-1])])
    onsets, hours = (np.add.reduceat(one, first) for one in counted)
    kept = risk_controlling(onsets / hours[:, None], onsets_per_hour, LOUDEST * onsets_per_hour)
    if not kept:
        raise InvalidArgumentError(f"quiet: expected {LOUDEST - 1:g} junctions at least, got {len(quiet)}")
    return SequenceAlarm(float(thresholds[kept - 1]), onsets_per_hour)


def _onsets(quiet: Sequence[SequencePosterior]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return thresholds from one that nothing reaches downwards, onsets of each stream at each, and hours."""
    louder = [smoothed_log_odds(one).max(axis=1) for one in quiet]
    if not louder:
        raise InvalidArgumentError("quiet: expected at least one hazard-free stream, got none")
    pooled = np.sort(np.concatenate(louder))
    # In steps of a share of the hops: onsets rise with every step but for hops that join alarms.
    ranks = np.unique(np.geomspace(1, 0.3 * pooled.size, 200).astype(np.intp))
    thresholds = np.concatenate([pooled[-1:] + 1e-6, pooled[-ranks]])
    onsets = [[rising_edges(held(one >= level)).size for level in thresholds.tolist()] for one in louder]
    hours = np.array([one.size for one in louder]) * HOP_S / SECONDS_PER_HOUR
    return thresholds, np.array(onsets, np.float64), hours


def examine(streams: Sequence[ExaminedStream]) -> dict[str, float | int | None]:
    """Return the figures of some streams together, ready for a table and for JSON."""
    told = [one for stream in streams for one in _outcomes(stream)]
    loud = [one for one in told if not one.approach.quiet]
    found: dict[str, float | int | None] = {"approaches": len(loud), **_detections(loud)}
    for flow in ("single", "both", "queue"):
        found[f"detected_{flow}"] = mean_of([one.detected for one in loud if one.approach.flow == flow])
    found["detected_quiet"] = mean_of([one.detected for one in told if one.approach.quiet])
    singles = [one for one in loud if one.approach.flow == "single"]
    found["other_side_too"] = mean_of([one.other_side for one in singles])
    found["wrong_side_only"] = mean_of([one.other_side and not one.own_side for one in singles])
    found["both_sides_found"] = mean_of([one.every_side for one in loud if one.approach.flow == "both"])
    found["onsets_after"] = mean_of([one.onsets_after for one in loud])
    found |= _ranking(streams) | _false_alarms(streams) | _worst(streams)
    return found | _calibration(streams) | _times(streams) | _by_kind(told)


@dataclass(frozen=True, slots=True)
class AlarmOutcome:
    """What alarms made of one approach, from five seconds before its first T0 to six after its last."""

    approach: StreamApproach
    lead_s: float  # 0 where missed
    own_side: bool
    other_side: bool
    every_side: bool
    onsets_after: int

    @property
    def detected(self) -> bool:
        """Whether an alarm stood before the first T0."""
        return self.lead_s > 0.0


def alarm_outcomes(heard: HeardStream, time_s: FloatArray, raised: BoolArray) -> list[AlarmOutcome]:
    """Return the outcome of every approach that lies whole within the hops, whoever raised the alarms.

    Shapes: time_s (n,), raised (n, 2).
    """
    any_side = np.asarray(raised.any(axis=1))
    onsets_s = time_s[rising_edges(any_side)]
    told = []
    for one in approaches(heard):
        first, last = one.entries_s[0], max(one.entries_s)
        if first - LONGEST_LEAD_S < time_s[0] or last + AFTER_S > time_s[-1]:
            continue
        before = shortly_before(time_s, first)
        alarms_s = time_s[before & any_side]
        by_side = np.asarray(raised[before].any(axis=0))
        told.append(
            AlarmOutcome(
                approach=one,
                lead_s=first - float(alarms_s[0]) if alarms_s.size else 0.0,
                own_side=bool(by_side[one.sides[0]]),
                other_side=bool(by_side[1 - one.sides[0]]),
                every_side=all(
                    raised[shortly_before(time_s, entry_s), side].any()
                    for entry_s, side in zip(one.entries_s, one.sides, strict=True)
                ),
                onsets_after=int(((onsets_s >= last) & (onsets_s < last + AFTER_S)).sum()),
            )
        )
    return told


def _outcomes(stream: ExaminedStream) -> list[AlarmOutcome]:
    raised = np.asarray(stream.alarm.raised(stream.posterior))
    return alarm_outcomes(stream.heard, stream.heard.hops.time_s, raised)


def _loud(streams: Sequence[ExaminedStream]) -> list[AlarmOutcome]:
    return [one for stream in streams for one in _outcomes(stream) if not one.approach.quiet]


def shortly_before(time_s: FloatArray, entry_s: float) -> BoolArray:
    """Return the hops of the five seconds before a T0, shape (n,)."""
    return np.asarray((time_s > entry_s - LONGEST_LEAD_S) & (time_s < entry_s - SLACK_S))


def _detections(told: Sequence[AlarmOutcome]) -> dict[str, float | None]:
    hits, n = sum(one.detected for one in told), len(told)
    low, high = share_interval(hits, n) if n else (None, None)
    return {
        "detected": mean_of([one.detected for one in told]),
        "detected_low": low,
        "detected_high": high,
        "lead_s": mean_of([one.lead_s for one in told if one.detected]),
        "lead_missed_as_0_s": mean_of([one.lead_s for one in told]),
    }


def _ranking(streams: Sequence[ExaminedStream]) -> dict[str, float | None]:
    """Return the mean AUROC over the last second before T0, and that at single times before it."""
    times = {f"auroc_{before:g}s_before": np.array([before]) for before in _CALIBRATED_S}
    asked = {"auroc_last_second": _LAST_SECOND_S, **times}
    areas = {name: float(auroc_before(streams, before_s).mean()) for name, before_s in asked.items()}
    return {name: area if np.isfinite(area) else None for name, area in areas.items()}


def _by_kind(told: Sequence[AlarmOutcome]) -> dict[str, float | int | None]:
    """Return three figures for each kind that came alone, quiet ones too."""
    # With a bicycle comes a car in half of the others, and the car is what is heard.
    alone = [one for one in told if len(one.approach.kinds) == 1]
    found: dict[str, float | int | None] = {}
    for kind in sorted({one.approach.kinds[0] for one in alone}):
        leads = [one.lead_s for one in alone if one.approach.kinds[0] == kind]
        detected = [lead for lead in leads if lead > 0.0]
        found[f"approaches_{kind}"] = len(leads)
        found[f"detected_{kind}"] = len(detected) / len(leads)
        found[f"lead_{kind}_s"] = mean_of(detected)
    return found


def _false_alarms(streams: Sequence[ExaminedStream]) -> dict[str, float | None]:
    quiet = [one for one in streams if one.heard.hazard_free]
    found = quiet_figures([np.asarray(one.alarm.raised(one.posterior)) for one in quiet])
    hours, rate = found["hazard_free_hours"], found["onsets_per_hour"]
    if not hours or rate is None:
        return found
    low, high = poisson_interval(round(rate * hours), hours)
    return found | {"onsets_low": low, "onsets_high": high}


def quiet_figures(raised: Sequence[BoolArray]) -> dict[str, float | None]:
    """Return the onsets an hour of streams in which nobody comes, and the share of their hops in alarm.

    Shapes: raised (hops, 2).
    """
    alarms = [np.asarray(one.any(axis=1)) for one in raised]
    hours = sum(map(len, alarms)) * HOP_S / SECONDS_PER_HOUR
    if not hours:
        return {"hazard_free_hours": 0.0, "onsets_per_hour": None, "hazard_free_share": None}
    onsets = sum(rising_edges(one).size for one in alarms)
    share = mean_of(np.concatenate(alarms))
    return {"hazard_free_hours": hours, "onsets_per_hour": onsets / hours, "hazard_free_share": share}


def _worst(streams: Sequence[ExaminedStream]) -> dict[str, float | None]:
    """Return what is detected at the junction with the least of it, and the most onsets of any junction."""
    sites = np.array([one.heard.site for one in streams])
    there = [[streams[i] for i in np.flatnonzero(sites == site).tolist()] for site in np.unique(sites)]
    shares = [mean_of([one.detected for one in _loud(here)]) for here in there]
    rates = [_false_alarms(here)["onsets_per_hour"] for here in there]
    return {
        "detected_worst_junction": min((one for one in shares if one is not None), default=None),
        "onsets_per_hour_worst_junction": max((one for one in rates if one is not None), default=None),
    }


def _calibration(streams: Sequence[ExaminedStream]) -> dict[str, float | None]:
    within = np.concatenate([one.posterior.within().reshape(-1, len(HORIZONS_S)) for one in streams])
    coming_s = np.concatenate([one.truth.coming_s.reshape(-1) for one in streams])
    found: dict[str, float | None] = {}
    for horizon_s in _CALIBRATED_S:
        said, true = within[:, HORIZONS_S.index(horizon_s)], coming_s <= horizon_s
        found[f"skill_{horizon_s:g}s"] = brier_skill(said, true)
        found[f"ece_{horizon_s:g}s"] = expected_calibration_error(said, true)
    return found


def _times(streams: Sequence[ExaminedStream]) -> dict[str, float | None]:
    stated = np.concatenate([one.posterior.time_to_visible_s().reshape(-1, 3) for one in streams])
    return time_figures(stated, np.concatenate([one.truth.coming_s.reshape(-1) for one in streams]))


def time_figures(stated: FloatArray, coming_s: FloatArray) -> dict[str, float | None]:
    """Return how true the times are of those who come within five seconds; None where none is stated.

    Shapes: stated (n, 3), coming_s (n,).
    """
    comes = coming_s <= LONGEST_S
    errors = visible_errors(stated[comes], coming_s[comes])
    if not errors.count:
        return {"time_rmse_of_constant": None, "time_coverage": None, "time_width_s": None}
    return {
        "time_rmse_of_constant": errors.rmse_s / errors.constant_rmse_s,
        "time_coverage": errors.coverage,
        "time_width_s": errors.width_s,
    }


def mean_of(values: Sequence[float] | Sequence[bool] | BoolArray) -> float | None:
    """Return the mean, None of nothing."""
    return float(np.mean(values)) if len(values) else None


def warned_before(streams: Sequence[ExaminedStream], before_s: FloatArray) -> FloatArray:
    """Return the share of approaches whose alarm stood that long before T0 or earlier, shape (times,)."""
    leads = np.array([one.lead_s for one in _loud(streams)])
    return np.array([np.mean(leads > before) if leads.size else np.nan for before in before_s])


def auroc_before(streams: Sequence[ExaminedStream], before_s: FloatArray) -> FloatArray:
    """Return the AUROC of what alarms are read from, so long before T0 against hazard-free hops, (times,)."""
    quiet = [smoothed_log_odds(one.posterior).max(axis=1) for one in streams if one.heard.hazard_free]
    if not quiet:
        return np.full(len(before_s), np.nan)
    none = np.concatenate(quiet)
    areas = []
    for before in before_s:
        scores = np.concatenate([_scores_at(one, before) for one in streams])
        labels = np.concatenate([np.ones(scores.size, bool), np.zeros(none.size, bool)])
        area = auroc(np.concatenate([scores, none]), labels)
        areas.append(np.nan if area is None else area)
    return np.array(areas)


def _scores_at(stream: ExaminedStream, before_s: float) -> FloatArray:
    time_s, scores = stream.heard.hops.time_s, smoothed_log_odds(stream.posterior).max(axis=1)
    entries = [one.entries_s[0] for one in approaches(stream.heard) if not one.quiet]
    at = np.searchsorted(time_s, np.array(entries) - before_s + SLACK_S) - 1
    return np.asarray(scores[at[(at >= 0)]])
