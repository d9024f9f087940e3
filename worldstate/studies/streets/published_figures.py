"""The published figures, counted on simulated recordings, with intervals over recordings."""

from collections.abc import Sequence

import numpy as np

from worldstate.abduction.cueing.calibration_error import expected_calibration_error
from worldstate.ground.typing import FloatArray, IndexArray
from worldstate.operations.metrics.roc import auroc
from worldstate.operations.recordings.advisories import SECONDS_PER_HOUR
from worldstate.operations.recordings.bearing_gating import bearing_figures
from worldstate.operations.recordings.hop_stream import HOP_S
from worldstate.operations.recordings.hop_table import HopTable, joined

from .decision_rules import ALPHA, ALPHA_LOOSE, RuleOutcome, RuleScores, labelled_windows

Interval = tuple[float, float]

# Twelve samples lie beyond each end of the interval.
DRAWS = 500
COVERAGE = 0.95
HORIZONS = {"all": np.inf, "2s": 2.0, "1s": 1.0}
# The paper's figure of looming is of the last three seconds before the pass.
IMMINENT_S = 3.0
# A slope read as a time: beyond this there is nothing that approaches.
LONGEST_TTA_S = 30.0


def published_figures(score: RuleScores, rows: IndexArray | None = None) -> dict[str, float]:
    """Return every figure on the chosen recordings; NaN where nothing is there to count."""
    chosen = np.arange(len(score.recordings)) if rows is None else rows
    recordings = [score.recordings[i] for i in chosen]
    approaches = [recording for recording in recordings if not recording.hazard_free]
    calm = [recording for recording in recordings if recording.hazard_free]
    figures = {f"auroc_{name}": _auroc(approaches, calm, h) for name, h in HORIZONS.items()}
    rules = {
        "vision": score.vision,
        "published": score.published,
        "sustained": score.sustained,
        "ours": score.ours[ALPHA],
        "ours_loose": score.ours[ALPHA_LOOSE],
    }
    for name, outcome in rules.items():
        figures |= {f"{name}_{key}": value for key, value in rule_figures(outcome, score, chosen).items()}
    return (
        figures
        | _bearings(approaches)
        | _prominences(approaches, calm)
        | _looming(approaches, calm)
        | {"doppler_share": float(np.mean([r.about["doppler"] == "" for r in approaches]))}
        | _calibration(recordings, [score.risk[i] for i in chosen])
    )


def rule_figures(outcome: RuleOutcome, score: RuleScores, rows: IndexArray) -> dict[str, float]:
    """Return detection rate, mean lead over detected approaches and false alarms per hazard-free hour."""
    free = np.array([score.recordings[i].hazard_free for i in rows])
    hops = sum(len(score.recordings[i].time_s) for i in rows[free])
    leads = outcome.lead_s[rows]
    detected = np.isfinite(leads)
    return {
        "detection": float(detected[~free].mean()),
        "lead_s": float(leads[detected].mean()) if detected.any() else float("nan"),
        "false_alarms_per_hour": float(
            outcome.false_onsets[rows].sum() * SECONDS_PER_HOUR / max(hops * HOP_S, HOP_S)
        ),
    }


def figure_intervals(score: RuleScores, rng: np.random.Generator, draws: int = DRAWS) -> dict[str, Interval]:
    """Return the middle 95 % of every figure over samples of recordings, drawn within approach and site."""
    # A figure that a sample does not have, such as a bearing without anything in view, is left out of it.
    strata: dict[tuple[str, str], list[int]] = {}
    for i, recording in enumerate(score.recordings):
        strata.setdefault((recording.label, recording.about["site"]), []).append(i)
    groups = [np.array(members) for _, members in sorted(strata.items())]
    samples = [np.concatenate([rng.choice(group, group.size) for group in groups]) for _ in range(draws)]
    drawn = [published_figures(score, sample) for sample in samples]
    return {name: _middle(np.array([one[name] for one in drawn])) for name in drawn[0]}


def _auroc(approaches: Sequence[HopTable], calm: Sequence[HopTable], horizon_s: float) -> float:
    hazards = [r.published_statistic[r.before_sight(horizon_s)] for r in approaches]
    return _area(hazards, [r.published_statistic for r in calm])


def _area(positives: Sequence[FloatArray], negatives: Sequence[FloatArray]) -> float:
    high, low = np.concatenate(positives), np.concatenate(negatives)
    area = auroc(np.concatenate([high, low]), np.arange(high.size + low.size) < high.size)
    return float("nan") if area is None else area


def _bearings(approaches: Sequence[HopTable]) -> dict[str, float]:
    errors = {"srp": [r.srp_rad - r.reference_rad for r in approaches]}
    errors["music"] = [r.music_rad - r.reference_rad for r in approaches]
    medians = {f"bearing_{name}_deg": _median_deg(parts) for name, parts in errors.items()}
    gated = bearing_figures(checked_bearings(approaches))["bearing_gated_deg"]
    return medians | {"bearing_gated_deg": float("nan") if gated is None else gated}


def checked_bearings(recordings: Sequence[HopTable]) -> HopTable:
    """Put the bearings of recordings beside the prominence of their windows."""
    return joined(
        HopTable({"prominence": r.prominence, "error_rad": r.srp_rad - r.reference_rad}) for r in recordings
    )


def _median_deg(parts: Sequence[FloatArray]) -> float:
    error = np.abs(np.concatenate(parts))
    return float(np.degrees(np.median(error[np.isfinite(error)]))) if np.isfinite(error).any() else np.nan


def _prominences(approaches: Sequence[HopTable], calm: Sequence[HopTable]) -> dict[str, float]:
    """Of windows with a moving box in view, and of hazard-free ones."""
    seen = np.concatenate([r.prominence[np.isfinite(r.reference_rad)] for r in approaches])
    silent = np.concatenate([r.prominence for r in calm])
    return {
        "prominence_in_view": float(np.median(seen)) if seen.size else float("nan"),
        "prominence_in_silence": float(np.median(silent)),
    }


def _looming(approaches: Sequence[HopTable], calm: Sequence[HopTable]) -> dict[str, float]:
    """How well the slope tells the last seconds before the pass from silence, and time-to-arrival itself."""
    left_s = [r.about["pass_s"] - r.time_s for r in approaches]
    imminent = [
        _known(r.log_slope_hz[(left > 0.0) & (left < IMMINENT_S)])
        for r, left in zip(approaches, left_s, strict=True)
    ]
    hidden = [r.before_sight() & (r.log_slope_hz > 2.0 / LONGEST_TTA_S) for r in approaches]
    read = np.concatenate([2.0 / r.log_slope_hz[use] for r, use in zip(approaches, hidden, strict=True)])
    true = np.concatenate([left[use] for left, use in zip(left_s, hidden, strict=True)])
    return {
        "looming_auroc": _area(imminent, [_known(r.log_slope_hz) for r in calm]),
        "looming_correlation": float(np.corrcoef(read, true)[0, 1]) if read.size > 2 else float("nan"),
    }


def _known(values: FloatArray) -> FloatArray:
    return values[np.isfinite(values)]


def _calibration(recordings: Sequence[HopTable], risks: Sequence[FloatArray]) -> dict[str, float]:
    raw, labels = labelled_windows(recordings)
    used = [
        risk if recording.hazard_free else risk[recording.before_sight()]
        for recording, risk in zip(recordings, risks, strict=True)
    ]
    calibrated = expected_calibration_error(np.concatenate(used), labels)
    return {"ece_raw": expected_calibration_error(raw, labels), "ece_calibrated": calibrated}


def _middle(values: FloatArray) -> Interval:
    known = _known(values)
    if not known.size:
        return float("nan"), float("nan")
    tail = (1.0 - COVERAGE) / 2.0
    low, high = np.quantile(known, [tail, 1.0 - tail]).tolist()
    return low, high
