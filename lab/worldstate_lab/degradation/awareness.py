"""Hazard awareness beside vision alone, and false alarms beside those of the clean recording."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from worldstate.abduction.cueing.cueing_policy import sustained_alarm
from worldstate.abduction.cueing.thresholds import neyman_pearson_threshold
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
from worldstate_lab.metrics.intervals import deal_folds, middle, ratio
from worldstate_lab.metrics.stream_statistic import stream_statistic

from .conditions import CLEAN, LENS, OFF, RAIN, RAIN_DB, ROOF, Condition, all_conditions

# One recording by the name of its condition, with the columns of `staged_filter.filter_in_conditions`.
Staged = Mapping[str, HopTable]


# Share of hazard-free windows in alarm.
ALPHA = 0.02


class Estimate(NamedTuple):
    """A figure with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class AwarenessRow:
    """One condition; None where the recordings hold nothing to form a figure from."""

    condition: Condition
    degradation: float  # Mean d that was estimated
    miss_rate: float | None  # Mean beta of the channel where it was asked after T0
    vision: Estimate  # Share of the hops after T0, vehicle in view, in which it is detected: 1 - beta
    any_detection: float  # Share of them in which anything that moves is detected
    # Share of them in which it is detected or P(hidden) + P(visible) is above its threshold.
    awareness: Estimate
    # Awareness in the hops in which it is not detected: what the sound holds by itself.
    unseen_awareness: float | None
    detected: float  # Share of approaches with an advisory in the 5 s before T0, and by how much in the mean
    lead_time_s: float | None
    # Advisories on hazard-free recordings, and the times that the awareness rises on them, for sound or for a
    # false detection; intervals are those of a Poisson count.
    false_alarms_per_hour: Estimate
    false_awareness_per_hour: Estimate
    # Share of their hops in awareness: where the hours are few, steadier than the count of its rises.
    false_awareness: float


@dataclass(frozen=True, slots=True)
class CommonCause:
    """What rain takes that soils the lens and drums on the roof at once, beside its two effects alone.

    Were the two sensors degraded independently, as assumption (A1) says, what each effect takes from the
    awareness would add up.
    """

    level: int
    noise_db: float  # Over the recording's own level
    lens: Estimate  # Awareness with a soiled lens
    roof: Estimate  # With rain on the roof
    rain: Estimate  # With both
    additive: Estimate  # Clean, less what each takes alone
    optimism: Estimate  # By how much that is above what is left: positive where (A1) says too much


@dataclass(frozen=True, slots=True)
class Awareness:
    """All conditions, judged by the same thresholds."""

    rows: tuple[AwarenessRow, ...]
    common_cause: tuple[CommonCause, ...]
    hops_in_view: int  # After T0, that awareness stands on
    hazard_free_hours: float  # That false alarms stand on

    def row(self, name: str) -> AwarenessRow:
        """Return the row of a condition by its name."""
        return next(row for row in self.rows if row.condition.name == name)


def hazard_awareness(
    recordings: Sequence[Staged],
    prior: Sequence[float],
    sustain_hops: int,
    draws: IndexArray,
    rng: np.random.Generator,
) -> Awareness:
    """Judge every condition by the same thresholds.

    Both are set on other recordings' hazard-free hops: gamma(alpha) of the advisory's statistic on the clean
    ones, as that only falls when absence says less; and that of P(hidden) + P(visible) without a camera, as
    that only rises. The statistic is formed at `prior` and has to hold for `sustain_hops`. `draws` (draws,
    recordings) says which recordings make each draw of an interval.
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
    counts = {name: _Counts(found, draws) for name, found in judged.items()}
    return Awareness(
        tuple(_row(state, judged[state.name], counts[state.name]) for state in all_conditions()),
        tuple(_common_cause(level, counts) for level in range(1, len(LEVELS))),
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
        """Of a vehicle that is there: a detection of something else is no awareness of it."""
        return np.asarray(self.recording.found | self.heard)

    @property
    def raised(self) -> BoolArray:
        """Where nothing is there, any detection raises awareness."""
        return np.asarray(self.recording.seen | self.heard)

    def in_sight(self, flags: AnyArray) -> BoolArray:
        """Return flags of the hops after T0 with the vehicle in view."""
        return np.asarray(flags[self.recording.after_sight()])


class _Counts:
    """Hops after T0 of every recording, and those of them detected and aware; shares on any draw."""

    def __init__(self, judged: Sequence[_Judged], draws: IndexArray) -> None:
        flags = [(one.in_sight(one.recording.found), one.in_sight(one.aware)) for one in judged]
        self._hops = np.array([found.size for found, _ in flags], dtype=float)
        self._found, self._aware = np.array([[f.sum(), a.sum()] for f, a in flags], dtype=float).T
        self._draws = draws

    def vision(self) -> tuple[float, FloatArray]:
        """Share that is detected, of all recordings and of every draw."""
        return self._share(self._found)

    def awareness(self) -> tuple[float, FloatArray]:
        """Share in awareness, of all recordings and of every draw."""
        return self._share(self._aware)

    def _share(self, part: FloatArray) -> tuple[float, FloatArray]:
        hops, drawn = self._hops[self._draws].sum(axis=1), part[self._draws].sum(axis=1)
        # A draw without anything in view has no share; `middle` leaves it out.
        return float(part.sum() / self._hops.sum()), ratio(drawn, hops)


def _judge(others: Sequence[Staged], prior: Sequence[float], hops: int) -> Callable[[HopTable], _Judged]:
    """Set the two thresholds of a fold on the recordings of the others."""
    free = [one for one in others if one[CLEAN].hazard_free]
    calm = [stream_statistic(one[CLEAN], prior) for one in free]
    gamma = neyman_pearson_threshold(calm, ALPHA, hops)
    presence = neyman_pearson_threshold([one[OFF].presence for one in free], ALPHA)

    def judge(one: HopTable) -> _Judged:
        alarm = sustained_alarm(stream_statistic(one, prior) >= gamma, hops)
        return _Judged(one, alarm, np.asarray(one.presence >= presence))

    return judge


def _row(state: Condition, judged: Sequence[_Judged], counts: _Counts) -> AwarenessRow:
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
        vision=_estimate(*counts.vision()),
        any_detection=float(seen.mean()),
        awareness=_estimate(*counts.awareness()),
        unseen_awareness=mean_of(heard[~found]),
        detected=float(np.mean([one.detected for one in outcomes])),
        lead_time_s=mean_of([one.lead_s for one in outcomes if one.detected]),
        false_alarms_per_hour=_rate([one.alarm for one in free], _hours(judged)),
        false_awareness_per_hour=_rate([one.raised for one in free], _hours(judged)),
        false_awareness=float(np.concatenate([one.raised for one in free]).mean()),
    )


def _common_cause(level: int, counts: Mapping[str, _Counts]) -> CommonCause:
    names = (CLEAN, *(Condition(family, level).name for family in (LENS, ROOF, RAIN)))
    shares = [counts[name].awareness() for name in names]
    clean, lens, roof, rain = (np.array([value, *drawn]) for value, drawn in shares)
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
