"""The world-state from above: at one time, and moving."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from worldstate.adapters.export.scene import CUE_M, SEARCHED_M, SECTOR_M, hidden_sector, label_of, sector_of
from worldstate.adapters.files.atomic import atomic_path
from worldstate.ground.errors import InputFileError
from worldstate.ground.values import seconds
from worldstate.operations.figure_style import BLUE, GREEN, ORANGE, PURPLE, RED, figure_file, figure_style
from worldstate.state import Entity, Occluder, RiskCue, WorldState

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# A GIF this large has 576 x 416 pixels: labels of 9 points are still read in a browser.
_SIZE_IN, _MOVING_DPI = (7.2, 5.2), 80
# An entity less likely than this is drawn, and not named.
_TOLD = 0.2
_LEGEND = (
    ("hidden", RED, 0.35),
    ("in view", BLUE, 0.35),
    ("risk of a side, red if raised", ORANGE, 0.4),
    ("searched, nothing found", GREEN, 0.25),
    ("searched, found", PURPLE, 0.25),
    ("behind an occluder", "0.5", 0.2),
)


def write_birds_eye(state: WorldState, path: Path, *, title: str = "") -> None:
    """Draw one snapshot from above, the ego at the bottom, its left to the left."""
    with figure_file(path, *_SIZE_IN) as figure:
        _draw(figure, state, title)


def write_animation(
    states: Sequence[WorldState],
    path: Path,
    *,
    title: str = "",
    on_frame: Callable[[], None] = lambda: None,
) -> None:
    """Draw every snapshot from above into a GIF that plays at the speed of the recording."""
    check_gif(path)
    from matplotlib.animation import PillowWriter
    from matplotlib.figure import Figure

    span_s = seconds(states[-1].stamp_ns - states[0].stamp_ns)
    writer = PillowWriter(fps=max(round((len(states) - 1) / span_s), 1) if span_s > 0.0 else 1)
    with figure_style(), atomic_path(path) as temporary:
        figure = Figure(figsize=_SIZE_IN, layout="constrained")
        with writer.saving(figure, str(temporary), dpi=_MOVING_DPI):
            for state in states:
                figure.clear()
                _draw(figure, state, title)
                writer.grab_frame()
                on_frame()


def check_gif(path: Path) -> Path:
    """Return `path` if it names a GIF; commands call it before their work."""
    if path.suffix.lower() != ".gif":
        raise InputFileError(path, "expected an animation's name ending in .gif")
    return path


def _draw(figure: "Figure", state: WorldState, title: str) -> None:
    axes = figure.subplots()
    for occluder in state.context.occluders:
        _draw_occluder(axes, occluder)
    for view in state.searched:
        _wedge(axes, view.sector_rad, SEARCHED_M, PURPLE if view.found else GREEN, 0.25)
    for cue in state.cues:
        _draw_cue(axes, cue)
    for entity in (one for one in state.entities if one.moving):
        _draw_entity(axes, entity)
    axes.plot(0.0, 0.0, "^", color="black", ms=12)
    behind = any(abs(view.sector_rad[0]) > 0.6 * math.pi for view in state.searched)
    axes.set(xlim=(-38, 38), ylim=(-41 if behind else -11, 37), aspect="equal", xticks=(), yticks=())
    axes.spines[:].set_visible(False)
    said = f"{seconds(state.stamp_ns):.1f} s" + (f"   {title}" if title else "")
    axes.set_title(said, loc="left")
    _draw_legend(axes)


def _draw_occluder(axes: "Axes", occluder: Occluder) -> None:
    edge = occluder.edge_azimuth_rad
    _wedge(axes, hidden_sector(occluder), SECTOR_M, "0.5", 0.13)
    axes.plot(*zip(_at(edge, 4.0), _at(edge, SECTOR_M), strict=True), color="0.3", lw=2)


def _draw_cue(axes: "Axes", cue: RiskCue) -> None:
    """Draw the risk, and say it on the cue's own side below the ego, where no sector lies."""
    raised = cue.advisory is not None
    sector = sector_of(cue.azimuth_rad, cue.azimuth_std_rad, cue.sector_rad)
    _wedge(axes, sector, CUE_M, RED if raised else ORANGE, 0.05 + 0.5 * cue.risk)
    within = "" if cue.within is None or "3" not in cue.within else f"\nin 3 s {cue.within['3']:.2f}"
    said = f"{cue.direction}{': ADVISORY' if raised else ''}\nrisk {cue.risk:.2f}{within}"
    left = cue.azimuth_rad > 0.0
    axes.text(
        -37 if left else 37, -2.5, said, color=RED if raised else "0.2", ha="left" if left else "right",
        va="top", weight="bold" if raised else "normal",
    )  # fmt: skip


def _draw_entity(axes: "Axes", entity: Entity) -> None:
    hidden = entity.status == "hidden"
    color, density = RED if hidden else BLUE, entity.existence_probability
    sector = sector_of(entity.azimuth_rad, entity.azimuth_std_rad, entity.sector_rad)
    _wedge(axes, sector, SECTOR_M, color, 0.05 + 0.3 * density)
    axes.plot(*zip((0.0, 0.0), _at(entity.azimuth_rad, SECTOR_M), strict=True), color=color, alpha=density)
    for ahead in (entity.forecast or {}).values():
        low, high = sector_of(*ahead, None)
        arc = [_at(low + (high - low) * step / 8, SECTOR_M + 1.0) for step in range(9)]
        axes.plot(*zip(*arc, strict=True), color=color, lw=3, alpha=0.6)
    if entity.position_m is not None:
        axes.plot(-entity.position_m[1], entity.position_m[0], "s", color=color, ms=9)
    if density >= _TOLD:
        x, y = _at(entity.azimuth_rad, SECTOR_M + 5.0)
        axes.text(
            min(max(x, -31.0), 31.0), y, label_of(entity), color=color, fontsize=9, ha="center", va="bottom"
        )


def _draw_legend(axes: "Axes") -> None:
    from matplotlib.patches import Patch

    patches = [Patch(color=color, alpha=alpha, lw=0, label=label) for label, color, alpha in _LEGEND]
    axes.legend(handles=patches, loc="upper center", bbox_to_anchor=(0.5, 0.0), ncol=3)


def _wedge(axes: "Axes", sector_rad: tuple[float, float], radius_m: float, color: Any, alpha: float) -> None:
    from matplotlib.patches import Wedge

    # Ahead is up: matplotlib's angles begin at the right, and turn to the left too.
    first, last = (math.degrees(azimuth) + 90.0 for azimuth in sector_rad)
    axes.add_patch(Wedge((0.0, 0.0), radius_m, first, last, color=color, alpha=min(alpha, 1.0), lw=0))


def _at(azimuth_rad: float, radius_m: float) -> tuple[float, float]:
    return -radius_m * math.sin(azimuth_rad), radius_m * math.cos(azimuth_rad)
