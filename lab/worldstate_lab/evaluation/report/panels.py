"""Panels on calibrated cueing: ROC by horizon, reliability, operating curve, awareness."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from worldstate.abduction.cueing.risk_map import reliability_curve
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.operations.figure_style import CATEGORIES
from worldstate_lab.report.table import Figure, Value

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas


# At a width of 600 pixels more points are not visible, and the CSV would take megabytes.
MOST_POINTS = 200
GREY = "0.55"
MARKS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*")
PROPOSED_COLOUR, *COLOURS = CATEGORIES


def legend_below(canvas: "Canvas", columns: int = 2) -> None:
    """Put one legend below all axes, outside the data, with each label once."""
    found = [axes.get_legend_handles_labels() for axes in canvas.axes]
    once = {label: handle for handles, labels in found for handle, label in zip(handles, labels, strict=True)}
    if once:
        canvas.legend(once.values(), once.keys(), loc="outside lower left", ncols=columns, fontsize=8.5)


def thinned(*columns: FloatArray) -> tuple[FloatArray, ...]:
    """Return evenly spaced rows of curves with too many points, both ends included."""
    n = len(columns[0])
    kept = np.unique(np.linspace(0, n - 1, min(n, MOST_POINTS)).astype(int)) if n else np.arange(0)
    return tuple(column[kept] for column in columns)


def mark_chance(axes: "Axes") -> None:
    """Draw the diagonal: chance level of a ROC, perfect calibration of a reliability curve."""
    axes.plot([0.0, 1.0], [0.0, 1.0], color=GREY, linewidth=0.8, zorder=0)
    axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.02))


def roc_curve(positives: FloatArray, negatives: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return false-positive and true-positive rates at every threshold, from 0 to 1, shape (k,) each.

    Examples
    --------
    >>> roc_curve(np.array([0.9, 0.4]), np.array([0.6, 0.1]))
    (array([0. , 0. , 0.5, 0.5, 1. ]), array([0. , 0.5, 0.5, 1. , 1. ]))
    """
    thresholds = np.unique(np.concatenate([positives, negatives]))[::-1]
    rates = [
        np.searchsorted(np.sort(-scores), -thresholds, side="right") / max(scores.size, 1)
        for scores in (negatives, positives)
    ]
    false, true = (np.concatenate([[0.0], rate]) for rate in rates)
    return false, true


def roc_figure(hazards: Mapping[str, FloatArray], free: FloatArray, areas: Mapping[str, Value]) -> Figure:
    """Draw the ROC of hazard windows against hazard-free windows, one curve per horizon.

    `hazards` contains the statistic of the windows by horizon, `free` that of hazard-free windows, `areas`
    the area by horizon with the paper's value.
    """
    curves = {name: thinned(*roc_curve(scores, free)) for name, scores in hazards.items() if scores.size}

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        mark_chance(axes)
        for name, curve in curves.items():
            axes.plot(*curve, label=f"{name}: {_beside(areas[name])}")
        axes.set(xlabel="false-positive rate of windows", ylabel="true-positive rate of windows")
        legend_below(canvas, columns=1)

    rows = [(name, *point) for name, curve in curves.items() for point in zip(*curve, strict=True)]
    return Figure(
        "cueing_roc",
        "(a) ROC of windows, by time to line of sight",
        "ROC of the hazard statistic: windows of occluded approaches that end within the horizon before T0 "
        "against hazard-free windows. Area with its 95 % interval; the grey diagonal is chance.",
        draw,
        ("horizon", "false_positive_rate", "true_positive_rate"),
        rows,
    )


def reliability_figure(
    risks: Mapping[str, FloatArray], labels: BoolArray, errors: Mapping[str, Value]
) -> Figure:
    """Draw the observed share of hazards over the predicted one, raw and calibrated.

    `risks` contains the raw and calibrated probabilities, each as long as `labels`; `errors` their ECE.
    """
    curves = {name: reliability_curve(values, labels) for name, values in risks.items()}

    def draw(canvas: "Canvas") -> None:
        axes, counts = canvas.subplots(2, 1, sharex=True, height_ratios=(1.0, 0.28))
        mark_chance(axes)
        for (name, curve), mark in zip(curves.items(), MARKS, strict=False):
            axes.plot(
                curve.predicted,
                curve.observed,
                marker=mark,
                ms=4,
                label=f"{name}: ECE {_beside(errors[name])}",
            )
            counts.plot(curve.predicted, curve.counts, marker=mark, ms=3)
        axes.set(ylabel="observed share of hazards")
        most = max(int(one.counts.max()) for one in curves.values())
        counts.set(xlabel="predicted probability", ylabel="windows", ylim=(0, 1.1 * most), yticks=(0, most))
        legend_below(canvas, columns=1)

    rows = [
        (name, *point)
        for name, one in curves.items()
        for point in zip(one.predicted, one.observed, one.counts, strict=True)
    ]
    return Figure(
        "cueing_reliability",
        "(b) Reliability of the stated probability",
        f"Ten equal bins, held-out folds, {labels.mean():.0%} of the windows are hazards. "
        "Below: number of windows in each bin. On the diagonal, the probabilities are calibrated.",
        draw,
        ("reading", "predicted", "observed", "windows"),
        rows,
        size_in=(4.4, 4.2),
    )


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """Detection and false alarms of one method; `alpha` is set for points of the curve."""

    name: str
    false_alarms_per_hour: Value
    detection: Value
    alpha: float | None = None


def operating_figure(points: Sequence[OperatingPoint], quantum_per_hour: float) -> Figure:
    """Draw detection over achieved false alarms per hour: the curve over alpha, other methods as points."""

    def draw(canvas: "Canvas") -> None:
        _draw_operating(canvas, points, max(quantum_per_hour, 1e-3))

    return Figure(
        "cueing_operating",
        "(c) Detection against achieved false alarms",
        f"Bars are 95 % intervals; open marks are the paper's. One alarm onset is {quantum_per_hour:.3g} "
        "per hour: left of it the axis is linear, right of it logarithmic.",
        draw,
        ("method", "alpha", "detection", "false_alarms_per_hour"),
        [(one.name, one.alpha, one.detection, one.false_alarms_per_hour) for one in points],
        size_in=(4.4, 4.4),
    )


def _draw_operating(canvas: "Canvas", points: Sequence[OperatingPoint], linear: float) -> None:
    curve = sorted((one for one in points if one.alpha is not None), key=lambda one: one.alpha or 0.0)
    others = [one for one in points if one.alpha is None]
    axes = canvas.subplots()
    # Few alarms occur per hour: the axis is linear from zero to one onset and logarithmic above.
    axes.set_xscale("symlog", linthresh=linear)
    line = [(one.false_alarms_per_hour.value, one.detection.value) for one in curve]
    if line:
        axes.plot(*zip(*line, strict=True), color=PROPOSED_COLOUR, zorder=1)
        axes.plot([], [], "o", color="black", fillstyle="none", label="the paper's (open)")
    for one in curve:
        _mark(canvas, one, PROPOSED_COLOUR, "o", r"proposed, over $\alpha$")
        place = one.false_alarms_per_hour.value, one.detection.value
        axes.annotate(f"{one.alpha:g}", place, (-5, 5), textcoords="offset points", ha="right", fontsize=8)
    for i, one in enumerate(others):
        _mark(canvas, one, COLOURS[i % len(COLOURS)], MARKS[(i + 1) % len(MARKS)], one.name)
    axes.set(xlabel="false alarms per hazard-free hour", ylabel="approaches detected", ylim=(-0.03, 1.05))
    rates = [one.false_alarms_per_hour for one in points]
    right = np.nanmax([[one.value, one.high] for one in rates] + [[10.0 * linear] * 2])
    ticks = [
        tick for tick in (0, 10, 30, 100, 300, 1000, 3000, 10_000) if tick == 0 or linear <= tick <= right
    ]
    axes.set_xticks(ticks, map(str, ticks))
    axes.minorticks_off()
    axes.set_xlim(-0.3 * linear, 1.3 * right)
    legend_below(canvas)


def _beside(value: Value) -> str:
    return value.text + (f", paper {value.paper.number}" if value.paper else "")


def _mark(canvas: "Canvas", one: OperatingPoint, colour: str, mark: str, label: str) -> None:
    """Draw a point with its two intervals, and the paper's value as an open mark of the same shape."""
    axes = canvas.axes[0]
    x, y = one.false_alarms_per_hour, one.detection
    if not np.isfinite([x.value, y.value]).all():
        return
    for spread, horizontal in ((x, True), (y, False)):
        if spread.interval:
            ends = [spread.low, spread.high]
            along = (ends, [y.value] * 2) if horizontal else ([x.value] * 2, ends)
            axes.plot(*along, color=colour, linewidth=0.8, alpha=0.5, zorder=1)
    axes.plot(x.value, y.value, mark, color=colour, ms=6, label=label, linestyle="none")
    if x.paper and y.paper:
        axes.plot(x.paper.value, y.paper.value, mark, color=colour, ms=7, fillstyle="none", linestyle="none")


def awareness_figure(families: Mapping[str, Sequence[tuple[Value, Value]]], paper_least: float) -> Figure:
    """Draw hazard awareness over the measured miss rate beta, one line per family of degradations.

    `families` contains (beta, awareness) by level, the clean camera first.
    """

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        axes.plot([0.0, 1.0], [1.0, 0.0], color=GREY, linestyle="--", label=r"vision alone, $1-\beta$")
        pairs = {name: tuple(zip(*levels, strict=True)) for name, levels in families.items()}
        for (name, (beta, aware)), mark in zip(pairs.items(), MARKS, strict=False):
            x = [b.value for b in beta]
            (line,) = axes.plot(x, [v.value for v in aware], marker=mark, ms=4, label=name)
            low, high = [v.low for v in aware], [v.high for v in aware]
            axes.fill_between(x, low, high, color=line.get_color(), alpha=0.13, lw=0)
        axes.axhline(paper_least, color="black", linewidth=0.9, linestyle=":", label="paper, least")
        axes.set(xlabel=r"measured miss rate $\beta$ of the camera", ylabel="hazard awareness after $T_0$")
        axes.set(xlim=(-0.02, 1.02), ylim=(0.0, 1.03))
        legend_below(canvas)

    return Figure(
        "cueing_awareness",
        "(d) Hazard awareness with a degraded camera",
        "Share of the hops after T0 in which the vehicle is detected or announced, over the share that the "
        "camera misses; level 0 is the clean camera. Bands are 95 % intervals over recordings.",
        draw,
        ("family", "level", "miss_rate", "awareness"),
        [
            (name, level, beta.value, aware)
            for name, levels in families.items()
            for level, (beta, aware) in enumerate(levels)
        ],
        size_in=(4.4, 4.2),
    )
