"""The figure of the comparison: ROC, reliability, detection against false alarms, gating of bearings."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate.abduction.cueing.calibration_error import reliability_curve
from worldstate.ground.typing import FloatArray
from worldstate.operations.figure_style import figure_file
from worldstate.operations.recordings.bearing_gating import draw_gating

from .decision_rules import ALPHA, RuleScores, labelled_windows
from .published_figures import HORIZONS, checked_bearings, published_figures, rule_figures
from .report import TARGETS

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def write_comparison_figure(score: RuleScores, path: Path) -> None:
    """Draw the score and write it as PNG, SVG or PDF, by the ending of `path`."""
    with figure_file(path, 14.5, 3.6) as figure:
        roc, reliability, operating, gating = figure.subplots(1, 4)
        _draw_roc(roc, score)
        _draw_reliability(reliability, score)
        _draw_operating(operating, score)
        draw_gating(gating, checked_bearings([r for r in score.recordings if not r.hazard_free]))
        gating.set_title("bearings in view")


def roc_curve(positives: FloatArray, negatives: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return false- and true-positive rates at every threshold, from 0 to 1, shape (k,) each.

    Examples
    --------
    >>> roc_curve(np.array([0.9, 0.4]), np.array([0.6, 0.1]))
    (array([0. , 0. , 0.5, 0.5, 1. ]), array([0. , 0.5, 0.5, 1. , 1. ]))
    """
    thresholds = np.unique(np.concatenate([positives, negatives]))[::-1]
    rates = [
        np.searchsorted(np.sort(-scores), -thresholds, side="right") / scores.size
        for scores in (negatives, positives)
    ]
    false, true = (np.concatenate([[0.0], rate]) for rate in rates)
    return false, true


def _draw_roc(axes: "Axes", score: RuleScores) -> None:
    calm = np.concatenate([r.published_statistic for r in score.recordings if r.hazard_free])
    figures = published_figures(score)
    for name, horizon_s in HORIZONS.items():
        hazards = [r.published_statistic[r.before_sight(horizon_s)] for r in score.recordings]
        label = "all occluded" if name == "all" else f"last {horizon_s:.0f} s"
        found, paper = figures[f"auroc_{name}"], TARGETS[f"auroc_{name}"].published
        axes.plot(
            *roc_curve(np.concatenate(hazards), calm), label=f"{label}: {found:.2f} (paper {paper:.2f})"
        )
    axes.plot([0, 1], [0, 1], color="grey", linewidth=0.6)
    axes.set(xlabel="false-positive rate", ylabel="true-positive rate", title="windows, $P_l + P_r$")
    axes.legend(fontsize="small", loc="lower right")


def _draw_reliability(axes: "Axes", score: RuleScores) -> None:
    raw, labels = labelled_windows(score.recordings)
    used = [
        risk if recording.hazard_free else risk[recording.before_sight()]
        for recording, risk in zip(score.recordings, score.risk, strict=True)
    ]
    for name, values in (("raw statistic", raw), ("calibrated risk", np.concatenate(used))):
        curve = reliability_curve(values, labels)
        axes.plot(curve.predicted, curve.observed, marker="o", label=name)
    axes.plot([0, 1], [0, 1], color="grey", linewidth=0.6)
    axes.set(xlabel="predicted", ylabel="observed hazard frequency", title="reliability, held-out folds")
    axes.legend(fontsize="small")


def _draw_operating(axes: "Axes", score: RuleScores) -> None:
    rows = np.arange(len(score.recordings))
    curve = [rule_figures(outcome, score, rows) for outcome in score.ours.values()]
    rates, shares = ([one[key] for one in curve] for key in ("false_alarms_per_hour", "detection"))
    axes.plot(rates, shares, marker=".", color="C2", label=r"ours over $\alpha$")
    points = {"published": ("C0", score.published), "sustained": ("C1", score.sustained)}
    points["ours"] = ("C2", score.ours[ALPHA])
    for name, (colour, outcome) in points.items():
        one = rule_figures(outcome, score, rows)
        axes.plot(one["false_alarms_per_hour"], one["detection"], "o", color=colour, label=name)
        paper = [TARGETS[f"{name}_{key}"].published for key in ("false_alarms_per_hour", "detection")]
        axes.plot(*paper, "o", color=colour, fillstyle="none")
    axes.set(xlabel="false alarms per hour", ylabel="approaches detected", ylim=(0.0, 1.03))
    axes.set_title("recordings (hollow: paper)")
    axes.legend(fontsize="small", loc="lower right")
