"""Ablations of the paper's statistic: one part changed at a time, on the same folds of recordings."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from worldstate.abduction.cueing.cueing_policy import neyman_pearson_threshold, sustained_alarm
from worldstate.abduction.cueing.risk_map import brier_score, expected_calibration_error, fit_isotonic
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
from worldstate_lab.metrics.stream_statistic import log_joint, stream_statistic


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
    """

    use_absence: bool = True
    calibrated: bool = True
    approach_weights: tuple[float, ...] = (0.0,)
    alpha: float = 0.02
    sustain_hops: int = 3


# One held-out recording with statistic, risk, alarm, awareness and weight of the calibration folds.
_Scored = tuple[HopTable, FloatArray, FloatArray, BoolArray, BoolArray, float]


def evaluate_ablation(
    streams: Sequence[HopTable],
    reference_prior: Sequence[float],
    rng: np.random.Generator,
    switches: AblationSwitches,
) -> dict[str, float | None]:
    """Evaluate one setting of the switches by recording-level folds.

    Parameters
    ----------
    streams : sequence of HopTable
        Approaches with a T0, and hazard-free recordings.
    reference_prior : sequence of float
        Prior of the statistic.
    rng : numpy.random.Generator
        Assigns recordings to folds and draws the floor of the ECE.
    switches : AblationSwitches
        Parts in use.

    Raises
    ------
    InvalidArgumentError
        If there are fewer than two approaches or two hazard-free recordings.

    Returns
    -------
    dict of str to float
        Detection, lead time, false alarms and calibration with these switches; None if the streams contain no
        data for a figure.

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
    >>> streams, rng = [stream(i) for i in range(20)], np.random.default_rng(0)
    >>> evaluate_ablation(streams, (0.25,) * 4, rng, AblationSwitches())["detected"]
    1.0
    """
    sites = [str(stream.about.get("site", "")) for stream in streams]
    folds = deal_folds([stream.label for stream in streams], sites, rng)
    scored: list[_Scored] = []
    for fold in np.unique(folds):
        others = [one for one, its in zip(streams, folds, strict=True) if its != fold]
        score = _learned(others, reference_prior, switches)
        scored += [score(one) for one, its in zip(streams, folds, strict=True) if its == fold]
    return _row(scored, rng)


def ablation_table(
    streams: Sequence[HopTable], reference_prior: Sequence[float], seed: int, base: AblationSwitches
) -> dict[str, dict[str, float | None]]:
    """Evaluate the full statistic, each part switched off, and looming added, on the same folds."""
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


def _learned(
    streams: Sequence[HopTable], prior: Sequence[float], switches: AblationSwitches
) -> Callable[[HopTable], _Scored]:
    """Set weight, thresholds and risk map on the calibration folds; return the score of other recordings."""

    def statistic(stream: HopTable, weight: float) -> FloatArray:
        return stream_statistic(stream, prior, switches.use_absence, weight)

    def presence(stream: HopTable) -> FloatArray:
        return presence_statistic(stream, prior, switches.use_absence)

    free = [stream for stream in streams if stream.hazard_free]
    parted = [*free, *(stream for stream in streams if stream.before_sight().any())]
    weight = best_weight(parted, switches.approach_weights, statistic)
    scores = [statistic(stream, weight) for stream in parted]
    gamma = neyman_pearson_threshold(scores[: len(free)], switches.alpha, switches.sustain_hops)
    presence_gamma = neyman_pearson_threshold([presence(stream) for stream in free], switches.alpha)
    calibrated = switches.calibrated and len(parted) > len(free)
    risk_map = fit_isotonic(*labelled_windows(parted, scores)) if calibrated else None

    def score(stream: HopTable) -> _Scored:
        found = statistic(stream, weight)
        risk = found if risk_map is None else risk_map(found)
        alarm = sustained_alarm(found >= gamma, switches.sustain_hops)
        return stream, found, risk, alarm, stream.seen | (presence(stream) >= presence_gamma), weight

    return score


def _row(scored: Sequence[_Scored], rng: np.random.Generator) -> dict[str, float | None]:
    free = [one for one in scored if one[0].hazard_free]
    approaches = [one for one in scored if one[0].before_sight().any()]
    streams, statistics, risks, *_ = zip(*free, *approaches, strict=True)
    statistic, hazards = labelled_windows(streams, statistics)
    risk, _ = labelled_windows(streams, risks)
    found = ApproachTable(
        [
            onset_outcome(stream.time_s[rising_edges(alarm)], stream.t0_s)
            for stream, _, _, alarm, *_ in approaches
        ],
        [alarm for _, _, _, alarm, *_ in free],
    ).figures()
    both = bool(approaches) and bool(free)
    return {
        "auroc": auroc(statistic, hazards),  # Of windows before T0 against hazard-free windows
        # Share of approaches announced before T0, their mean lead time, the rate on hazard-free recordings
        "detected": found["detected"],
        "lead_time_s": found["lead_s"],
        "false_alarms_per_hour": found["onsets_per_hour"],
        "window_rate": found["hazard_free_share"],
        # ECE of the risk on the same windows, with its sampling floor
        "ece": expected_calibration_error(risk, hazards) if both else None,
        "ece_floor": calibration_error_sampling(risk, rng)[0] if both else None,
        "brier": brier_score(risk, hazards) if both else None,
        # Share of the hops after T0 with the vehicle in view in which it is detected or P(hidden) +
        # P(visible) is above its threshold; below, the share in which it is detected.
        "awareness": mean_of([f for one, *_, aware, _ in approaches for f in aware[one.after_sight()]]),
        "vision_only": mean_of([f for one, *_ in approaches for f in one.seen[one.after_sight()]]),
        "approach_weight": float(np.mean([weight for *_, weight in scored])),  # Mean of the chosen weights
    }


def presence_statistic(
    stream: HopTable, reference_prior: Sequence[float], use_absence: bool = True
) -> FloatArray:
    """Return P(hidden) + P(visible), the probability of any vehicle, at a fixed prior per hop, shape (n,)."""
    joint = log_joint(stream, reference_prior, use_absence)
    something = np.logaddexp.reduce(joint[:, :-1], axis=1)
    return np.asarray(np.exp(-np.logaddexp(0.0, joint[:, -1] - something)))
