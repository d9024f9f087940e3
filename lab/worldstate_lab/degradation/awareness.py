"""Hazard awareness compared with vision alone, and false alarms compared with the clean recording."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from worldstate.abduction.cueing.cueing_policy import neyman_pearson_threshold, sustained_alarm
from worldstate.adapters.camera.camera_health import LEVELS
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import AnyArray, BoolArray, FloatArray, IndexArray
from worldstate.ground.values import SECONDS_PER_HOUR
from worldstate.operations.metrics.approach_table import (
    mean_of,
    onset_outcome,
    poisson_interval,
    rising_edges,
)
from worldstate.operations.recordings.hop_table import HOP_S, UNQUERIED, HopTable
from worldstate_lab.metrics.intervals import deal_folds, middle, pooled_share
from worldstate_lab.metrics.stream_statistic import stream_statistic

from .conditions import CLEAN, LENS, OFF, RAIN, RAIN_DB, ROOF, Condition, all_conditions

# One recording by name of the condition, with the columns of `staged_filter.filter_in_conditions`.
Staged = Mapping[str, HopTable]
Share = tuple[float, FloatArray]  # Over all recordings, and in every draw of them
# Share of hazard-free windows in alarm.
ALPHA = 0.02


class Estimate(NamedTuple):
    """A figure with the bounds of its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class AwarenessRow:
    """One condition; a figure is None if the recordings contain no data for it."""

    condition: Condition
    degradation: float  # Mean estimated d
    miss_rate: float | None  # Mean beta of the camera channel over its queries after T0
    vision: Estimate  # Share of the hops after T0 with the vehicle in view in which it is detected: 1 - beta
    any_detection: float  # Share of these hops in which any moving object is detected
    # Share of these hops in which it is detected or P(hidden) + P(visible) is above its threshold.
    awareness: Estimate
    # Awareness in the hops in which it is not detected: the contribution of the sound.
    unseen_awareness: float | None
    detected: float  # Share of approaches with an advisory in the 5 s before T0, and their mean lead time
    lead_time_s: float | None
    # Advisories on hazard-free recordings, and onsets of awareness on them, caused by sound or by a false
    # detection; intervals are those of a Poisson count.
    false_alarms_per_hour: Estimate
    false_awareness_per_hour: Estimate
    # Share of their hops in awareness: with few hours, less noisy than the count of onsets.
    false_awareness: float


@dataclass(frozen=True, slots=True)
class CommonCause:
    """Loss of awareness in rain, which degrades camera and microphones together, and in each effect alone.

    If the two sensors were degraded independently, as assumption (A1) states, the losses of awareness would
    add up.
    """

    level: int
    noise_db: float  # Noise relative to the recording's own level
    lens: Estimate  # Awareness with rain on the lens only
    roof: Estimate  # Awareness with rain on the roof only
    rain: Estimate  # Awareness with both
    additive: Estimate  # Clean awareness minus the loss of each effect alone
    optimism: Estimate  # `additive` minus `rain`: positive if (A1) is too optimistic


@dataclass(frozen=True, slots=True)
class Awareness:
    """All conditions, evaluated with the same thresholds."""

    rows: tuple[AwarenessRow, ...]
    common_cause: tuple[CommonCause, ...]
    hops_in_view: int  # Hops after T0 from which awareness is computed
    hazard_free_hours: float  # Hours from which false alarms are computed


def hazard_awareness(
    recordings: Sequence[Staged],
    prior: Sequence[float],
    sustain_hops: int,
    draws: IndexArray,
    rng: np.random.Generator,
) -> Awareness:
    """Evaluate every condition with the same thresholds.

    Both thresholds are set on hazard-free hops of other recordings. The threshold gamma(alpha) of the
    advisory's statistic is set on the clean recordings, because the statistic can only fall if absence is
    weaker evidence. That of P(hidden) + P(visible) is set without a camera, because this sum can only rise
    then. The statistic uses `prior` and must be above its threshold for `sustain_hops`. `draws` (draws,
    recordings) lists the recordings of each draw.
    """
    clean = [one[CLEAN] for one in recordings]
    if not any(one.after_sight().any() for one in clean):
        raise InvalidArgumentError("recordings: expected an approach that comes into view")
    sites = [str(one.about.get("site", "")) for one in clean]
    folds = deal_folds([one.label for one in clean], sites, rng).tolist()
    judges = {
        fold: _judge([r for r, f in zip(recordings, folds, strict=True) if f != fold], prior, sustain_hops)
        for fold in set(folds)
    }
    judged = {
        state.name: [judges[fold](one[state.name]) for one, fold in zip(recordings, folds, strict=True)]
        for state in all_conditions()
    }
    shares = {name: _shares(found, draws) for name, found in judged.items()}
    return Awareness(
        tuple(_row(state, judged[state.name], *shares[state.name]) for state in all_conditions()),
        tuple(_common_cause(level, shares) for level in range(1, len(LEVELS))),
        int(sum(one.after_sight().sum() for one in clean)),
        _hours(judged[CLEAN]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Judged:
    """One recording in one condition with the decisions on it."""

    recording: HopTable
    alarm: BoolArray
    heard: BoolArray

    @property
    def aware(self) -> BoolArray:
        """Awareness of the vehicle in view: a detection of another object does not count."""
        return np.asarray(self.recording.found | self.heard)

    @property
    def raised(self) -> BoolArray:
        """Awareness without a vehicle: any detection counts."""
        return np.asarray(self.recording.seen | self.heard)

    def in_sight(self, flags: AnyArray) -> BoolArray:
        """Return flags of the hops after T0 with the vehicle in view."""
        return np.asarray(flags[self.recording.after_sight()])


def _shares(judged: Sequence[_Judged], draws: IndexArray) -> tuple[Share, Share]:
    """Return the shares of detected and of aware hops after T0."""
    flags = [(one.in_sight(one.recording.found), one.in_sight(one.aware)) for one in judged]
    hops, found, aware = np.array([[f.size, f.sum(), a.sum()] for f, a in flags], np.float64).T
    return pooled_share(found, hops, draws), pooled_share(aware, hops, draws)


def _judge(others: Sequence[Staged], prior: Sequence[float], hops: int) -> Callable[[HopTable], _Judged]:
    """Set the two thresholds of a fold on the recordings of the other folds."""
    free = [one for one in others if one[CLEAN].hazard_free]
    calm = [stream_statistic(one[CLEAN], prior) for one in free]
    gamma = neyman_pearson_threshold(calm, ALPHA, hops)
    presence = neyman_pearson_threshold([one[OFF].presence for one in free], ALPHA)

    def judge(one: HopTable) -> _Judged:
        alarm = sustained_alarm(stream_statistic(one, prior) >= gamma, hops)
        return _Judged(one, alarm, np.asarray(one.presence >= presence))

    return judge


def _row(state: Condition, judged: Sequence[_Judged], vision: Share, awareness: Share) -> AwarenessRow:
    free = [one for one in judged if one.recording.hazard_free]
    outcomes = [
        onset_outcome(one.recording.time_s[rising_edges(one.alarm)], one.recording.t0_s)
        for one in judged
        if not one.recording.hazard_free
    ]
    seen = np.concatenate([one.in_sight(one.recording.seen) for one in judged])
    found = np.concatenate([one.in_sight(one.recording.found) for one in judged])
    heard = np.concatenate([one.in_sight(one.heard) for one in judged])
    return AwarenessRow(
        condition=state,
        degradation=float(np.mean([one.recording.degradation.mean() for one in judged])),
        miss_rate=mean_of(np.concatenate([_asked_miss_rates(one.recording) for one in judged])),
        vision=_estimate(*vision),
        any_detection=float(seen.mean()),
        awareness=_estimate(*awareness),
        unseen_awareness=mean_of(heard[~found]),
        detected=float(np.mean([one.detected for one in outcomes])),
        lead_time_s=mean_of([one.lead_s for one in outcomes if one.detected]),
        false_alarms_per_hour=_rate([one.alarm for one in free], _hours(judged)),
        false_awareness_per_hour=_rate([one.raised for one in free], _hours(judged)),
        false_awareness=float(np.concatenate([one.raised for one in free]).mean()),
    )


def _common_cause(level: int, shares: Mapping[str, tuple[Share, Share]]) -> CommonCause:
    names = (CLEAN, *(Condition(family, level).name for family in (LENS, ROOF, RAIN)))
    aware = [shares[name][1] for name in names]
    clean, lens, roof, rain = (np.array([value, *drawn]) for value, drawn in aware)
    additive = np.clip(lens + roof - clean, 0.0, 1.0)
    figures = (lens, roof, rain, additive, additive - rain)
    return CommonCause(level, RAIN_DB[level], *(_estimate(float(one[0]), one[1:]) for one in figures))


def _estimate(value: float, drawn: FloatArray) -> Estimate:
    return Estimate(value, *middle(drawn))


def _rate(alarms: Sequence[BoolArray], hours: float) -> Estimate:
    onsets = sum(rising_edges(alarm).size for alarm in alarms)
    return Estimate(onsets / hours, *poisson_interval(onsets, hours))


def _hours(judged: Sequence[_Judged]) -> float:
    return sum(len(one.alarm) for one in judged if one.recording.hazard_free) * HOP_S / SECONDS_PER_HOUR


def _asked_miss_rates(one: HopTable) -> FloatArray:
    return np.asarray(one.miss_rate[(one.answer != UNQUERIED) & one.after_sight()])
