"""Hazard awareness beside vision alone, and false alarms beside those of a clean camera, state by state."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.abduction.cueing.cueing_policy import sustained_alarm
from worldstate.abduction.cueing.neyman_pearson import neyman_pearson_threshold
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import AnyArray, BoolArray, FloatArray, IndexArray
from worldstate.operations.metrics.recording_draws import middle
from worldstate.operations.metrics.recording_folds import deal_folds
from worldstate.operations.recordings.advisories import detection, false_alarms_per_hour, rising_edges
from worldstate.operations.recordings.hop_stream import HOP_S, UNQUERIED
from worldstate.operations.recordings.hop_table import HopTable
from worldstate.operations.recordings.stream_statistic import stream_statistic

from .degraded_detections import CLEAN, OFF
from .staged_degradation import StagedHops

DRAWS = 1000

Interval = tuple[float, float]


@dataclass(frozen=True, slots=True)
class SweepSettings:
    """How thresholds are set.

    Parameters
    ----------
    reference_prior : tuple of float
        Prior of the statistic.
    alpha : float
        Share of hazard-free windows in alarm.
    sustain_hops : int
        Consecutive hops that the statistic of an advisory has to hold.
    folds : int
        Recording-level folds.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> SweepSettings((0.25,) * 4).alpha
    0.02
    """

    reference_prior: tuple[float, ...]
    alpha: float = 0.02
    sustain_hops: int = 3
    folds: int = 5

    def __post_init__(self) -> None:
        in_range("alpha", self.alpha, 0.0, 1.0, open_high=True)
        in_range("sustain_hops", self.sustain_hops, 1, 1000)
        in_range("folds", self.folds, 2, 1000)


@dataclass(frozen=True, slots=True)
class SweepRow:
    """One state of the camera; None where the recordings hold nothing to form it from."""

    state: str  # Its name
    degradation: float  # Mean d that was estimated
    miss_rate: float | None  # Mean beta of the channel where it was asked after T0
    # Share of the hops after T0, vehicle in view, in which it is detected, as 1 - beta counts it.
    vision_only: float
    any_detection: float  # Share of them in which anything that moves is detected
    awareness: float  # Share of them in which it is detected or P(hidden) + P(visible) is above its threshold
    awareness_interval: Interval  # Its middle 95 % over recordings drawn again
    # Awareness in the hops in which it is not detected: what the sound holds by itself.
    unseen_awareness: float | None
    detected: float  # Share of approaches with an advisory in the 5 s before T0, and by how much in the mean
    lead_time_s: float | None
    false_alarms_per_hour: float  # Advisories on hazard-free recordings
    # Times that the awareness rises on them, for sound or for a false detection.
    false_awareness_per_hour: float
    # Share of their hops in awareness: where the hours are few, steadier than the count of its rises.
    false_awareness: float


def degradation_sweep(
    recordings: Sequence[StagedHops], settings: SweepSettings, rng: np.random.Generator
) -> list[SweepRow]:
    r"""Judge every state of the camera by the same thresholds.

    Both are set on other recordings' hazard-free hops: gamma(alpha) of the advisory's statistic with the
    clean camera, as that statistic only falls when absence says less; and that of P(hidden) + P(visible)
    without a camera, as that only rises.

    Parameters
    ----------
    recordings : sequence of mapping of str to HopTable
        Approaches with a T0 and hazard-free recordings, all in the same states.
    settings : SweepSettings
        How thresholds are set.
    rng : numpy.random.Generator
        Deals folds and draws the intervals.

    Returns
    -------
    list of SweepRow
        One a state, in the order of the first recording's.

    Raises
    ------
    InvalidArgumentError
        If states differ, no vehicle is ever in view after T0, or there are fewer than two approaches
        or two hazard-free recordings.

    Examples
    --------
    Twenty made-up recordings in two states of the camera; half are approaches with line of sight from 4 s on:

    >>> def staged(i):
    ...     time_s, hazard = 1.0 + 0.1 * np.arange(60), i % 2 == 1
    ...     view = hazard & (time_s > 4.0)
    ...     scores = np.random.default_rng(i).normal(0.0, 0.3, (60, 4)) + np.array([0.0, 0.0, 0.0, 3.0])
    ...     scores[hazard & (time_s > 2.0), 0] += 8.0
    ...     columns = {"time_s": time_s, "there": view, "log_likelihoods": scores, "answer": 1 + view}
    ...     columns |= {"seen": view, "found": view, "miss_rate": np.full(60, 0.5)}
    ...     columns |= {"clutter_rate": np.full(60, 0.01), "degradation": np.zeros(60)}
    ...     columns["presence"] = 0.5 * (1 + (hazard & (time_s > 2.0)))
    ...     clean = HopTable(columns, str(i), "left" if hazard else "none", 4.0 if hazard else np.nan)
    ...     blind = dict.fromkeys(("seen", "found", "answer"), np.zeros(60, dtype=bool))
    ...     return {"clean": clean, "off": clean.replace(**blind)}
    >>> recordings, rng = [staged(i) for i in range(20)], np.random.default_rng(0)
    >>> rows = degradation_sweep(recordings, SweepSettings((0.25,) * 4), rng)
    >>> [(row.state, row.vision_only) for row in rows]
    [('clean', 1.0), ('off', 0.0)]
    """
    if not recordings or any(list(one) != list(recordings[0]) for one in recordings):
        raise InvalidArgumentError("recordings: expected at least one, all in the same states")
    clean = [one[CLEAN] for one in recordings]
    if not any(one.after_sight().any() for one in clean):
        raise InvalidArgumentError("recordings: expected an approach that comes into view")
    sites = [str(one.about.get("site", "")) for one in clean]
    folds = deal_folds([one.label for one in clean], sites, rng, settings.folds)
    judges = {
        fold: _Judge([r for r, f in zip(recordings, folds, strict=True) if f != fold], settings)
        for fold in np.unique(folds).tolist()
    }
    pairs = [(one, judges[fold]) for one, fold in zip(recordings, folds.tolist(), strict=True)]
    draws = _draws(clean, rng)
    return [_row(state, [judge(one[state]) for one, judge in pairs], draws) for state in recordings[0]]


@dataclass(frozen=True, slots=True, eq=False)
class _Judged:
    """One recording in one state with the decisions on it."""

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


class _Judge:
    """The two thresholds of a fold, set on the recordings of the others."""

    def __init__(self, others: Sequence[StagedHops], settings: SweepSettings) -> None:
        free = [one for one in others if one[CLEAN].hazard_free]
        self._settings = settings
        prior, alpha = settings.reference_prior, settings.alpha
        calm = [stream_statistic(one[CLEAN], prior) for one in free]
        self._gamma = neyman_pearson_threshold(calm, alpha, settings.sustain_hops)
        self._presence = neyman_pearson_threshold([one[OFF].presence for one in free], alpha)

    def __call__(self, one: HopTable) -> _Judged:
        statistic = stream_statistic(one, self._settings.reference_prior)
        alarm = sustained_alarm(statistic >= self._gamma, self._settings.sustain_hops)
        return _Judged(one, alarm, np.asarray(one.presence >= self._presence))


def _row(state: str, judged: Sequence[_Judged], draws: Sequence[IndexArray]) -> SweepRow:
    free = [one for one in judged if one.recording.hazard_free]
    approaches = [one for one in judged if not one.recording.hazard_free]
    aware = [one.in_sight(one.aware) for one in judged]
    seen = np.concatenate([one.in_sight(one.recording.seen) for one in judged])
    found_again = np.concatenate([one.in_sight(one.recording.found) for one in judged])
    unseen = np.concatenate([one.in_sight(one.heard) for one in judged])[~found_again]
    found = [detection(_onsets_s(one), one.recording.t0_s) for one in approaches]
    leads = [one.lead_time_s for one in found if one.lead_time_s is not None]
    drawn = [np.concatenate([aware[i] for i in chosen]).mean() for chosen in draws]
    return SweepRow(
        state=state,
        degradation=float(np.mean([one.recording.degradation.mean() for one in judged])),
        miss_rate=_mean(np.concatenate([_asked_miss_rates(one) for one in judged])),
        vision_only=float(found_again.mean()),
        any_detection=float(seen.mean()),
        awareness=float(np.concatenate(aware).mean()),
        awareness_interval=middle(np.array(drawn)),
        unseen_awareness=_mean(unseen),
        detected=float(np.mean([one.detected for one in found])),
        lead_time_s=_mean(np.array(leads)),
        false_alarms_per_hour=false_alarms_per_hour([one.alarm for one in free], HOP_S),
        false_awareness_per_hour=false_alarms_per_hour([one.raised for one in free], HOP_S),
        false_awareness=float(np.concatenate([one.raised for one in free]).mean()),
    )


def _asked_miss_rates(one: _Judged) -> FloatArray:
    asked = one.recording.answer != UNQUERIED
    return np.asarray(one.recording.miss_rate[asked & one.recording.after_sight()])


def _onsets_s(one: _Judged) -> list[float]:
    return [float(time_s) for time_s in one.recording.time_s[rising_edges(one.alarm)]]


def _mean(values: FloatArray | BoolArray) -> float | None:
    return float(np.mean(values)) if values.size else None


def _draws(recordings: Sequence[HopTable], rng: np.random.Generator) -> list[IndexArray]:
    """Approaches in view, drawn with replacement."""
    shown = np.array([i for i, one in enumerate(recordings) if one.after_sight().any()], dtype=np.intp)
    return [rng.choice(shown, size=shown.size) for _ in range(DRAWS)]
