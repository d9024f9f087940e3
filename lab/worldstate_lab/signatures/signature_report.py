"""The signature study as JSON-able values, as lines for people, and as a figure."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from worldstate.operations.figure_style import BLUE, GREEN, ORANGE, RED, figure_file, legend_beside

from .signature_study import PAPER_RANGE_HZ, SignatureRow, SignatureStudy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from .fisher_profile import BandProfile

CHANCE = 0.5  # Of both figures: a row whose interval holds it has separated nothing


def study_values(study: SignatureStudy) -> dict[str, Any]:
    """Return the study as JSON-able values; a ratio of two constants, which is infinite, is None."""
    profile = None
    if study.profile is not None:
        values = {name: np.asarray(value).tolist() for name, value in asdict(study.profile).items()}
        profile = {name: [one if np.isfinite(one) else None for one in row] for name, row in values.items()}
    return {
        "simulated": study.simulated,
        "rows": [asdict(row) for row in study.rows],
        "profile": profile,
        "left_out": list(study.left_out),
    }


def study_lines(study: SignatureStudy) -> list[str]:
    """Return a table of what was measured, the worst first, and of what would fill the other rows."""
    filled = [row for row in study.rows if row.value is not None]
    width = max((len(row.name) for row in filled), default=0)
    lines = [f"{'':{width}} {'':17} {'value':>6} {'[interval]':15} {'paper':>11} {'clips':>6}  corpus; how"]
    for row in filled:
        measured = f"{_number(row.value, row):>6} {_between(row):15} {_published(row):>11}"
        lines.append(
            f"{row.name:{width}} {row.figure:17} {measured} {row.n_clips:6}  {row.corpus}; {row.note}"
        )
    for note in dict.fromkeys(row.note for row in study.rows if row.value is None):
        lines += ["", f"open: {note}"]
        lines += [
            f"  {r.name} ({r.figure}, {r.corpus})" for r in study.rows if r.value is None and r.note == note
        ]
    return lines


def write_signature_figure(path: Path, study: SignatureStudy) -> None:
    """Draw the rows that have a value as bars, and the Fisher profile below them."""
    bars = [row for row in study.rows if row.value is not None and row.figure != "Hz"]
    # A row keeps its height however many there are, or labels of two lines would overlap.
    heights = [0.3 * max(len(bars), 1), 2.4] if study.profile is not None else [0.3 * max(len(bars), 1)]
    with figure_file(path, 9.0, sum(heights) + 1.6) as figure:
        figure.suptitle("Signatures of single clips" + (", SIMULATED sound" if study.simulated else ""))
        axes = iter(np.atleast_1d(figure.subplots(len(heights), 1, height_ratios=heights)))
        _draw_bars(next(axes), bars)
        if study.profile is not None:
            _draw_profile(next(axes), study.profile)


def _draw_bars(axes: "Axes", rows: list[SignatureRow]) -> None:
    places = np.arange(len(rows))[::-1]
    for place, row in zip(places, rows, strict=True):
        value, low, high = (np.nan if one is None else one for one in (row.value, row.low, row.high))
        colour = BLUE if row.figure == "AUROC" else ORANGE
        axes.barh(place, value, color=colour, alpha=0.75, label=row.figure)
        axes.plot([low, high], [place, place], color="black", linewidth=1.2, label="95 % over recordings")
        if row.paper is not None:
            # A single number is a span of no length: only its marker shows.
            axes.plot(row.paper, [place, place], "|-", color=RED, ms=11, mew=2.5, lw=2.5, label="paper")
    axes.set_yticks(places, [f"{row.name}\n{row.corpus}" for row in rows], fontsize=7.0)
    axes.axvline(CHANCE, color="grey", linewidth=0.8, linestyle=":", label="chance")
    axes.set(xlim=(0.0, 1.03), xlabel="AUROC; balanced accuracy where the bar is orange")
    axes.margins(y=0.01)
    legend_beside(axes)


def _draw_profile(axes: "Axes", profile: "BandProfile") -> None:
    axes.axvspan(*PAPER_RANGE_HZ, color=RED, alpha=0.12, linewidth=0, label="paper's range")
    axes.stairs(profile.by_level, profile.edges_hz, label="level", baseline=None)
    axes.stairs(profile.by_shape, profile.edges_hz, label="shape", baseline=None, color=GREEN)
    axes.set(xscale="log", xlabel="frequency (Hz)", ylabel="Fisher ratio,\nvehicle against none")
    # Decades alone would leave a span of two of them with three labels.
    axes.set_xlim(profile.edges_hz[0], profile.edges_hz[-1])
    axes.set_xticks([50, 100, 300, 1000, 1800, 4000, 8000], ["50", "100", "300", "1k", "1.8k", "4k", "8k"])
    axes.minorticks_off()
    axes.set_ylim(bottom=0.0)
    legend_beside(axes)


def _number(value: float | None, row: SignatureRow) -> str:
    if value is None or np.isnan(value):
        return "-"
    return f"{value:.0f}" if row.figure == "Hz" else f"{value:.3f}"


def _between(row: SignatureRow) -> str:
    return f"[{_number(row.low, row)}, {_number(row.high, row)}]"


def _published(row: SignatureRow) -> str:
    return "-" if row.paper is None else " - ".join(dict.fromkeys(_number(one, row) for one in row.paper))
