"""Panels over recordings, junctions and states of the camera: leads, bearings, miss rates, awareness."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np

from worldstate.ground.typing import FloatArray, IntArray
from worldstate.ground.values import NotUsable
from worldstate.operations.figure_style import BLUE, RED
from worldstate.operations.recordings.hop_table import HopTable
from worldstate_lab.metrics.intervals import worst_group
from worldstate_lab.metrics.track_measures import PUBLISHED, bearing_curve
from worldstate_lab.report.table import Figure, Value

from .panels import COLOURS, GREY, MARKS, legend_below

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

# A median of fewer bearings is not drawn.
FEWEST = 10


def lead_figure(leads_s: Mapping[str, FloatArray], paper_s: Mapping[str, float]) -> Figure:
    """Draw the lead time of every detected approach, one row a method; NaN is an approach not detected."""
    names = [name for name, leads in leads_s.items() if np.isfinite(leads).any()]

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        for row, name in enumerate(names):
            leads = np.sort(leads_s[name][np.isfinite(leads_s[name])])
            # Spread by rank, not at random: the picture of the same numbers stays the same.
            axes.plot(
                leads, row + 0.28 * (np.arange(leads.size) % 5 - 2) / 2, ".", color=BLUE, alpha=0.55, ms=4
            )
            axes.plot(leads.mean(), row, "|", color="black", ms=17, mew=2.0, label="mean of the detected")
            if name in paper_s:
                axes.plot(paper_s[name], row, "D", color=RED, fillstyle="none", ms=6, label="paper")
        counts = [f"{name}\n{np.isfinite(leads_s[name]).sum()} of {leads_s[name].size}" for name in names]
        axes.set_yticks(range(len(names)), counts, fontsize=8.5)
        axes.set(xlabel="lead time (s)", ylim=(len(names) - 0.5, -0.5))
        axes.axvline(0.0, color="0.8", linewidth=0.8, zorder=0)
        legend_below(canvas)

    rows = [(name, float(lead)) for name, leads in leads_s.items() for lead in leads]
    return Figure(
        "lead_times",
        "Lead time of every detected approach",
        "One dot an approach and seed of the folds: line-of-sight entry minus the first alarm within the 5 s "
        "before it. The number of detected approaches stands below the name; methods that detect none are "
        "left out. An empty cell of the CSV is an approach that was not detected.",
        draw,
        ("method", "lead_s"),
        rows,
        size_in=(4.8, 1.6 + 0.52 * max(len(names), 1)),
    )


def junction_figure(
    name: str,
    title: str,
    unit: str,
    values: Mapping[str, Mapping[str, Value]],
    worst: Literal["low", "high"],
) -> Figure:
    """Draw a figure by junction, one colour a method, the worst junction of each ringed.

    `values` holds junction to value by method; `worst` says whether the lowest or the highest is the worst.
    """
    sites = sorted({site for one in values.values() for site in one})
    # Side by side within the row of a junction, at most .3 of it up or down.
    offsets = np.linspace(-0.3, 0.3, len(values)) if len(values) > 1 else np.zeros(1)

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        for (method, by_site), offset, colour, mark in zip(
            values.items(), offsets, COLOURS, MARKS, strict=False
        ):
            for site, value in by_site.items():
                row = sites.index(site) + offset
                axes.plot([value.low, value.high], [row, row], color=colour, linewidth=1.0, alpha=0.6)
                axes.plot(value.value, row, mark, color=colour, ms=5, label=method, linestyle="none")
            marked, _ = worst_group({site: value.value for site, value in by_site.items()}, worst)
            if marked:
                place = by_site[marked].value, sites.index(marked) + offset
                axes.plot(*place, "ko", ms=11, fillstyle="none", label="worst junction")
        axes.set_yticks(range(len(sites)), sites)
        axes.set(xlabel=unit, ylim=(len(sites) - 0.5, -0.5))
        legend_below(canvas, columns=1)

    rows = [(method, *row) for method, by_site in values.items() for row in by_site.items()]
    return Figure(
        name,
        title,
        "Bars are 95 % intervals over the recordings of the junction; the ring marks the worst junction of "
        "a method.",
        draw,
        ("method", "junction", "figure"),
        rows,
        size_in=(4.4, 1.6 + 0.18 * len(values) + 0.5 * max(len(sites), 1)),
    )


def bearing_gating_figure(checks: HopTable) -> Figure:
    """Draw the median bearing error over the share of bearings kept by prominence."""
    curve, n = bearing_curve(checks), int(np.isfinite(checks.error_rad).sum())
    points: tuple[FloatArray, ...] = ()
    if not isinstance(curve, NotUsable):
        points = curve.coverage, np.degrees(curve.median_error_rad), curve.threshold

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        if points:
            enough = points[0] * n >= min(FEWEST, n)
            axes.plot(points[0][enough], points[1][enough], label=f"{n} bearings")
        axes.plot(*np.transpose(PUBLISHED), "o", color="black", fillstyle="none", label="paper")
        axes.set(xlabel="share kept by prominence", ylabel="median bearing error (deg)", xlim=(1.03, 0.0))
        axes.set_ylim(bottom=0.0)
        legend_below(canvas)

    return Figure(
        "bearing_gating",
        "Bearing error, gated by prominence",
        "Median absolute error of the bearings whose peak stands out most, over the share kept; windows "
        "with a moving box in view. Open circles: the paper's 3.4 degrees on all and 2.4 on 16 %.",
        draw,
        ("share_kept", "median_error_deg", "prominence"),
        [tuple(map(float, row)) for row in zip(*points, strict=True)],
    )


def miss_rate_level_figure(families: Mapping[str, Sequence[tuple[str, Value]]]) -> Figure:
    """Draw beta over the level, one line a family; `families` holds (d as text, beta), clean first."""
    levels = [level for level, _ in next(iter(families.values()), ())]

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        rates = {name: [value for _, value in one] for name, one in families.items()}
        _bands(axes, {name: (np.arange(len(one)), one) for name, one in rates.items()})
        axes.set_xticks(range(len(levels)), levels)
        axes.set(xlabel="staged degradation d", ylabel=r"miss rate $\beta$", ylim=(-0.02, 1.02))
        legend_below(canvas, columns=3)

    return Figure(
        "miss_rate_level",
        "Miss rate of the camera by degradation",
        "Share of the hops with a vehicle in view in which the detector reports none, with its 95 % interval "
        "over recordings. The paper: 0.04 clean at boresight, 0.97 in the harshest noise.",
        draw,
        ("family", "level", "miss_rate"),
        [(name, level, value) for name, one in families.items() for level, value in one],
    )


def miss_rate_angle_figure(states: Mapping[str, Sequence[Value]], edges_deg: Sequence[float]) -> Figure:
    """Draw beta over |azimuth|, one line a state of the camera; one value between two edges."""
    middle = 0.5 * (np.asarray(edges_deg)[1:] + np.asarray(edges_deg)[:-1])

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        _bands(axes, {name: (middle, values) for name, values in states.items()})
        axes.set(xlabel="angle off boresight |azimuth| (deg)", ylabel=r"miss rate $\beta$")
        axes.set(ylim=(-0.02, 1.02), xlim=(edges_deg[0], edges_deg[-1]))
        # The last edge is that of the view, such as 35.19 degrees.
        axes.set_xticks(list(edges_deg), [f"{edge:.0f}" for edge in edges_deg])
        legend_below(canvas)

    return Figure(
        "miss_rate_angle",
        "Miss rate of the camera by angle",
        "As before, by the angle between the vehicle and the optical axis. The paper, clean camera: 0.04 at "
        "boresight, 0.14 at 20 to 30 degrees.",
        draw,
        ("state", "from_deg", "to_deg", "miss_rate"),
        [
            (name, *row)
            for name, values in states.items()
            for row in zip(edges_deg[:-1], edges_deg[1:], values, strict=True)
        ],
    )


def awareness_figure(families: Mapping[str, Sequence[tuple[Value, Value]]], paper_least: float) -> Figure:
    """Draw hazard awareness over the measured miss rate beta, one line a family of degradations.

    `families` holds (beta, awareness) by level, the clean camera first.
    """

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        axes.plot([0.0, 1.0], [1.0, 0.0], color=GREY, linestyle="--", label=r"vision alone, $1-\beta$")
        pairs = {name: tuple(zip(*levels, strict=True)) for name, levels in families.items()}
        _bands(
            axes, {name: (np.array([b.value for b in beta]), aware) for name, (beta, aware) in pairs.items()}
        )
        axes.axhline(paper_least, color="black", linewidth=0.9, linestyle=":", label="paper, least")
        axes.set(xlabel=r"measured miss rate $\beta$ of the camera", ylabel="hazard awareness after $T_0$")
        axes.set(xlim=(-0.02, 1.02), ylim=(0.0, 1.03))
        legend_below(canvas)

    return Figure(
        "cueing_awareness",
        "(d) Hazard awareness while the camera fails",
        "Share of the hops after T0 in which the vehicle is seen or reported, over the share that the camera "
        "misses; level 0 is the clean camera. Bands are 95 % intervals over recordings.",
        draw,
        ("family", "level", "miss_rate", "awareness"),
        [
            (name, level, beta.value, aware)
            for name, levels in families.items()
            for level, (beta, aware) in enumerate(levels)
        ],
        size_in=(4.4, 4.2),
    )


def _bands(axes: "Axes", lines: Mapping[str, tuple[FloatArray | IntArray, Sequence[Value]]]) -> None:
    """Draw a line with its band of intervals for each name."""
    for (name, (x, values)), mark in zip(lines.items(), MARKS, strict=False):
        (line,) = axes.plot(x, [v.value for v in values], marker=mark, ms=4, label=name)
        low, high = [v.low for v in values], [v.high for v in values]
        axes.fill_between(x, low, high, color=line.get_color(), alpha=0.13, lw=0)
