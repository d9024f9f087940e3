"""Ablations of the paper's statistic: one part changed at a time, on the same folds of recordings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from worldstate.abduction.cueing.cueing_policy import sustained_alarm
from worldstate.abduction.cueing.risk_map import (
    brier_score,
    expected_calibration_error,
    fit_isotonic,
)
from worldstate.abduction.cueing.thresholds import neyman_pearson_threshold
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.operations.metrics.approach_table import (
    ApproachTable,
    auroc,
    mean_of,
    onset_outcome,
    rising_edges,
)
from worldstate.operations.recordings.hop_table import HopTable
from worldstate_lab.methods.acoustic_rules import LOOMING_WEIGHTS, best_weight, labelled_windows
from worldstate_lab.metrics.intervals import calibration_error_sampling, deal_folds
from worldstate_lab.metrics.stream_statistic import (
    StatisticSwitches,
    log_joint,
    stream_statistic,
)


@dataclass(frozen=True, slots=True)
class AblationSwitches:
    """Which parts of the statistic are in use.

    Parameters
    ----------
    use_absence : bool
        (a) False: only the signature is used; the result of the camera query is ignored.
    calibrated : bool
        (b) False: the raw statistic is taken as the risk.
    approach_weights : tuple of float
        Candidate weights of looming. The one with the largest AUROC on the calibration folds is used.
        ``(0.0,)`` leaves looming out.
    alpha, sustain_hops : float, int
        Budget and number of hops of the sustained rule.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> AblationSwitches(use_absence=False).approach_weights
    (0.0,)
    """

    use_absence: bool = True
    calibrated: bool = True
    approach_weights: tuple[float, ...] = (0.0,)
    alpha: float = 0.02
    sustain_hops: int = 3

    def __post_init__(self) -> None:
        if not self.approach_weights:
            raise InvalidArgumentError("approach_weights: expected at least one")
        in_range("alpha", self.alpha, 0.0, 1.0, open_high=True)

    def statistic_with(self, weight: float) -> StatisticSwitches:
        """Return the switches of the statistic at one weight of looming."""
        return StatisticSwitches(use_absence=self.use_absence, approach_weight=weight)


@dataclass(frozen=True, slots=True)
class AblationRow:
    """One row of the table; a value is None if the streams contain no data for it."""

    auroc: float | None  # AUROC of windows before T0 against hazard-free windows
    detected: float | None  # Share of approaches announced before T0, and their mean lead time
    lead_time_s: float | None
    false_alarms_per_hour: float | None  # Rate on hazard-free recordings
    window_rate: float | None
    ece: float | None  # ECE of the risk on the same windows, with its sampling floor
    ece_floor: float | None
    brier: float | None
    # Share of the hops after T0 with the vehicle in view in which it is detected or P(hidden) + P(visible) is
    # above its threshold; below, the share in which it is detected.
    awareness: float | None
    vision_only: float | None
    approach_weight: float  # Mean of the chosen weights


@dataclass(frozen=True, slots=True, eq=False)
class _Scored:
    """One held-out recording with the statistic, alarm and risk set on the calibration folds."""

    stream: HopTable
    statistic: FloatArray
    risk: FloatArray
    alarm: BoolArray
    aware: BoolArray
    weight: float


def evaluate_ablation(
    streams: Sequence[HopTable],
    reference_prior: Sequence[float],
    rng: np.random.Generator,
    switches: AblationSwitches | None = None,
) -> AblationRow:
    """Evaluate one setting of the switches by recording-level folds.

    Parameters
    ----------
    streams : sequence of HopTable
        Approaches with a T0, and hazard-free recordings.
    reference_prior : sequence of float
        Prior of the statistic.
    rng : numpy.random.Generator
        Assigns recordings to folds and draws the floor of the ECE.
    switches : AblationSwitches, optional
        Parts in use; by default all.

    Raises
    ------
    InvalidArgumentError
        If there are fewer than two approaches or two hazard-free recordings.

    Returns
    -------
    AblationRow
        Detection, lead time, false alarms and calibration with these switches.

    Examples
    --------
    Twenty made-up recordings, half of them approaches that are heard from 6 s on:

    >>> def stream(i):
    ...     time_s, hazard = 1.0 + 0.1 * np.arange(100), bool(i % 2)
    ...     scores = np.random.default_rng(i).normal(0.0, 0.3, (100, 4)) + np.array([0.0, 0.0, 0.0, 3.0])
    ...     scores[50:, 0] += 8.0 * hazard
    ...     columns = {"time_s": time_s, "log_likelihoods": scores, "clutter_rate": np.zeros(100)}
    ...     columns |= dict.fromkeys(("answer", "seen", "there"), np.zeros(100, dtype=bool))
    ...     columns["miss_rate"] = np.ones(100)
    ...     return HopTable(columns, f"{i}", "left" if hazard else "none", 9.0 if hazard else np.nan)
    >>> row = evaluate_ablation([stream(i) for i in range(20)], (0.25,) * 4, np.random.default_rng(0))
    >>> row.detected
    1.0
    """
    chosen = switches or AblationSwitches()
    sites = [str(stream.about.get("site", "")) for stream in streams]
    folds = deal_folds([stream.label for stream in streams], sites, rng)
    scored: list[_Scored] = []
    for fold in np.unique(folds):
        others = [one for one, its in zip(streams, folds, strict=True) if its != fold]
        learned = _Learned(others, reference_prior, chosen)
        scored += [learned.score(one) for one, its in zip(streams, folds, strict=True) if its == fold]
    return _row(scored, rng)


def ablation_table(
    streams: Sequence[HopTable],
    reference_prior: Sequence[float],
    seed: int,
    switches: AblationSwitches | None = None,
) -> dict[str, AblationRow]:
    """Evaluate the full statistic, each part switched off, and looming added, on the same folds."""
    base = switches or AblationSwitches()
    rows = {
        "full": base,
        "signature_only": replace(base, use_absence=False),
        "raw_risk": replace(base, calibrated=False),
        "with_looming": replace(base, approach_weights=LOOMING_WEIGHTS),
    }
    return {
        name: evaluate_ablation(streams, reference_prior, np.random.default_rng(seed), row)
        for name, row in rows.items()
    }


class _Learned:
    """Weight, thresholds and risk map set on the calibration folds."""

    def __init__(
        self, streams: Sequence[HopTable], prior: Sequence[float], switches: AblationSwitches
    ) -> None:
        free = [stream for stream in streams if stream.hazard_free]
        parted = [*free, *(stream for stream in streams if stream.before_sight().any())]
        self._prior, self._switches = prior, switches
        self.weight = best_weight(parted, switches.approach_weights, self._statistic)
        scores = [self._statistic(stream, self.weight) for stream in parted]
        self.gamma = neyman_pearson_threshold(scores[: len(free)], switches.alpha, switches.sustain_hops)
        presence = [self._presence(stream) for stream in free]
        self.presence_gamma = neyman_pearson_threshold(presence, switches.alpha)
        self._risk_map = None
        if switches.calibrated and len(parted) > len(free):
            self._risk_map = fit_isotonic(*labelled_windows(parted, scores))

    def score(self, stream: HopTable) -> _Scored:
        statistic = self._statistic(stream, self.weight)
        risk = statistic if self._risk_map is None else self._risk_map(statistic)
        alarm = sustained_alarm(statistic >= self.gamma, self._switches.sustain_hops)
        aware = stream.seen | (self._presence(stream) >= self.presence_gamma)
        return _Scored(stream, statistic, risk, alarm, aware, self.weight)

    def _statistic(self, stream: HopTable, weight: float) -> FloatArray:
        return stream_statistic(stream, self._prior, self._switches.statistic_with(weight))

    def _presence(self, stream: HopTable) -> FloatArray:
        return presence_statistic(stream, self._prior, self._switches.statistic_with(0.0))


def _row(scored: Sequence[_Scored], rng: np.random.Generator) -> AblationRow:
    free = [one for one in scored if one.stream.hazard_free]
    approaches = [one for one in scored if one.stream.before_sight().any()]
    parted = [*free, *approaches]
    streams = [one.stream for one in parted]
    statistic, hazards = labelled_windows(streams, [one.statistic for one in parted])
    risk, _ = labelled_windows(streams, [one.risk for one in parted])
    found = ApproachTable(
        [onset_outcome(one.stream.time_s[rising_edges(one.alarm)], one.stream.t0_s) for one in approaches],
        [one.alarm for one in free],
    ).figures()
    both = bool(approaches) and bool(free)
    return AblationRow(
        auroc=auroc(statistic, hazards),
        detected=found["detected"],
        lead_time_s=found["lead_s"],
        false_alarms_per_hour=found["onsets_per_hour"],
        window_rate=found["hazard_free_share"],
        ece=expected_calibration_error(risk, hazards) if both else None,
        ece_floor=calibration_error_sampling(risk, rng)[0] if both else None,
        brier=brier_score(risk, hazards) if both else None,
        awareness=mean_of([f for one in approaches for f in one.aware[one.stream.after_sight()]]),
        vision_only=mean_of([f for one in approaches for f in one.stream.seen[one.stream.after_sight()]]),
        approach_weight=float(np.mean([one.weight for one in scored])),
    )


def presence_statistic(
    stream: HopTable, reference_prior: Sequence[float], switches: StatisticSwitches
) -> FloatArray:
    """Return P(hidden) + P(visible), the probability of any vehicle, at a fixed prior per hop, shape (n,)."""
    joint = log_joint(stream, reference_prior, switches)
    something = np.logaddexp.reduce(joint[:, :-1], axis=1)
    return np.asarray(np.exp(-np.logaddexp(0.0, joint[:, -1] - something)))
