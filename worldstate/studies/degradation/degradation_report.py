"""The sweep over camera states as JSON, as a table and as a figure."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from worldstate.operations.figure_style import figure_file

from .degradation_sweep import SweepRow
from .degraded_detections import CLEAN, OFF

COLUMNS = (
    ("d", "degradation"), ("beta", "miss_rate"), ("vision", "vision_only"), ("any", "any_detection"),
    ("aware", "awareness"),
    ("unseen", "unseen_awareness"), ("detected", "detected"), ("lead s", "lead_time_s"),
    ("FA/h", "false_alarms_per_hour"), ("false aware/h", "false_awareness_per_hour"),
    ("share", "false_awareness"),
)  # fmt: skip
_FIGURES = ("false_alarms_per_hour", "false_awareness_per_hour", "false_awareness")


def sweep_report(rows: Sequence[SweepRow]) -> dict[str, object]:
    """Return the rows and what the claim rests on: the worst of each column over the camera's states."""
    # A ratio of false alarms to those of the clean camera is null where the clean camera has none.
    staged = [row for row in rows if row.state != OFF]
    clean = next(row for row in staged if row.state == CLEAN)
    ratios = {f"largest_ratio_of_{name}": _largest_ratio(staged, clean, name) for name in _FIGURES}
    return {
        "clean_awareness": clean.awareness,
        "least_awareness": min(row.awareness for row in staged),
        "clean_vision_only": clean.vision_only,
        "least_vision_only": min(row.vision_only for row in staged),
        **ratios,
        "states": [asdict(row) for row in rows],
    }


def _largest_ratio(staged: Sequence[SweepRow], clean: SweepRow, name: str) -> float | None:
    before = getattr(clean, name)
    return max(getattr(row, name) for row in staged) / before if before else None


def sweep_table(rows: Sequence[SweepRow]) -> str:
    """Return the rows as text, one a state."""
    lines = [f"{'state':14}" + "".join(f"{title:>14}" for title, _ in COLUMNS)]
    for row in rows:
        values = [getattr(row, name) for _, name in COLUMNS]
        texts = ["-" if value is None else f"{value:.{0 if value >= 20.0 else 3}f}" for value in values]
        lines.append(f"{row.state:14}" + "".join(f"{text:>14}" for text in texts))
    return "\n".join(lines)


def write_sweep_figure(rows: Sequence[SweepRow], path: Path) -> None:
    """Draw awareness and vision alone over the share of misses, and false alarms, by the ending of `path`."""
    with figure_file(path, 8.5, 3.4) as figure:
        left, right = figure.subplots(1, 2)
        staged = [row for row in rows if row.state != OFF]
        families = sorted({row.state.split()[0] for row in staged} - {CLEAN})
        for family in families:
            chosen = [row for row in staged if row.state.split()[0] in (CLEAN, family)]
            missed = [1.0 - row.vision_only for row in chosen]
            (line,) = left.plot(missed, [row.awareness for row in chosen], marker="o", label=family)
            low, high = zip(*(row.awareness_interval for row in chosen), strict=True)
            left.fill_between(missed, low, high, color=line.get_color(), alpha=0.12, lw=0)
            d = range(len(chosen))
            right.plot(d, [row.false_alarms_per_hour for row in chosen], marker="o", color=line.get_color())
            aware = [row.false_awareness_per_hour for row in chosen]
            right.plot(d, aware, ls=":", color=line.get_color())
        left.plot([0.0, 1.0], [1.0, 0.0], color="grey", label="vision alone")
        left.set(
            xlabel="share of hops that the detector misses",
            ylabel="hazard awareness after $T_0$",
            ylim=(0, 1.02),
        )
        left.legend(fontsize="small", loc="lower left")
        right.set(xlabel="level of the family", ylabel="per hazard-free hour", ylim=(0, None))
        right.set_title("advisories (solid), awareness (dotted)", fontsize="small")
