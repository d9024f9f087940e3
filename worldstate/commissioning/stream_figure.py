"""Figure of a simulated stream: the paths of its vehicles from above, and its sound."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate.operations.figure_style import HEARD, HIDDEN, IN_VIEW, TRUTH, figure_file, legend_beside
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.stream.truth import VehicleTruth
from worldstate.simulation.stream.writing import WrittenStream

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Rows of the events: vehicles from a hidden arm first, then each kind of negative.
FLOWS = (
    "left", "right", "both", "queue", "follows", "waits", "turns_away", "parks", "far", "from_behind",
    "from_ahead", "stands", "leaves", "joins", "stops", "distant",
)  # fmt: skip
MAP_M = 60.0  # Extent to either side
WALLS_M = 12.0  # The ego's own street is drawn this far behind the ego
COLUMNS = 1600  # Columns of the spectrogram; the figure has fewer dots


def write_stream_figure(stream: WrittenStream, path: Path) -> None:
    """Draw paths, spectrogram and events of a stream; the file name's ending gives the file type."""
    with figure_file(path, 11.0, 9.0) as figure:
        above, middle, below = figure.subplots(3, 1, height_ratios=(0.8, 0.9, 1.0))
        _draw_map(above, stream)
        _draw_spectrogram(middle, stream)
        _draw_events(below, stream)
        below.sharex(middle)
        legend_beside(above)
        minutes, preset = stream.settings.minutes, stream.settings.preset.name
        figure.suptitle(f"{stream.folder.name}: {minutes:g} min, {len(stream.vehicles)} vehicles, {preset}")


def _draw_map(axes: "Axes", stream: WrittenStream) -> None:
    for line in _walls(stream.settings.site):
        axes.plot(*np.array(line).T, color="black", linewidth=2.0)
    for one in stream.vehicles:
        for shown, colour, label in ((~one.in_view, HIDDEN, "hidden"), (one.in_view, IN_VIEW, "in view")):
            # Vehicles of one flow use the same lane, so they are drawn side by side
            beside = 0.15 * (one.number % 8 - 3.5)
            y, x = (np.where(shown, value, np.nan) for value in (one.y_m, one.x_m + beside))
            axes.plot(y, x, color=colour, linewidth=0.8, label=label)
    axes.plot(0.0, 0.0, "^", color="black", markersize=9, label="array")
    axes.set(xlim=(MAP_M, -MAP_M), ylim=(-WALLS_M, 22.0), aspect="equal")
    axes.set(xlabel="y (m), left positive", ylabel="x (m), ahead")


def _walls(site: Site) -> list[list[tuple[float, float]]]:
    """Return corners and walls as polylines of (y, x)."""
    mouth, left, right = site.corner_ahead_m, site.corner_left_m, -site.corner_right_m
    lines = [
        [(MAP_M, mouth), (left, mouth), (site.side_wall_left_m, -WALLS_M)],
        [(-MAP_M, mouth), (right, mouth), (-site.side_wall_right_m, -WALLS_M)],
    ]
    if site.opposite_wall_m is not None:
        lines.append([(MAP_M, site.opposite_wall_m), (-MAP_M, site.opposite_wall_m)])
    return lines


def _draw_spectrogram(axes: "Axes", stream: WrittenStream) -> None:
    heard = stream.spectrogram
    power = 10.0 ** (heard.levels_db() / 10.0)
    together = max(-(-len(power) // COLUMNS), 1)
    lines = [power[i : i + together].mean(axis=0) for i in range(0, len(power), together)]
    levels = 10.0 * np.log10(np.array(lines).reshape(-1, len(heard.frequencies_hz)))
    times = heard.times_s[::together]
    if len(times):
        low, high = np.percentile(levels, [5.0, 99.5])
        mesh = axes.pcolormesh(
            times, heard.frequencies_hz, levels.T, shading="nearest", cmap="magma", vmin=low, vmax=high,
            rasterized=True,
        )  # fmt: skip
        axes.figure.colorbar(mesh, ax=axes, label="dB re 20 uPa a bin", pad=0.01)
    axes.set(ylabel="frequency (Hz), middle microphone", xlim=(0.0, stream.settings.duration_s))


def _draw_events(axes: "Axes", stream: WrittenStream) -> None:
    had = {one.event.flow for one in stream.vehicles}
    rows = [*(flow for flow in FLOWS if flow in had), *sorted({one.sound.kind for one in stream.sounds})]
    for one in stream.vehicles:
        _draw_event(axes, one, rows.index(one.event.flow))
    for sound in stream.sounds:
        span = (sound.start_s, sound.end_s - sound.start_s)
        axes.broken_barh([span], (rows.index(sound.sound.kind) - 0.35, 0.7), color="0.7", lw=0)
    axes.set(yticks=range(len(rows)), yticklabels=[row.replace("_", " ") for row in rows])
    axes.tick_params(axis="y", labelsize=9)
    axes.set(xlabel="time (s); pink: in earshot, blue: in view, tick: first line of sight")
    axes.set_ylim(len(rows) - 0.4, -0.6)


def _draw_event(axes: "Axes", one: VehicleTruth, row: int) -> None:
    span = (one.event.start_s, one.event.end_s - one.event.start_s)
    axes.broken_barh([span], (row - 0.35, 0.7), color=HEARD, alpha=0.5, lw=0)
    seen = one.time_s[one.in_view]
    if seen.size:
        axes.broken_barh([(seen[0], seen[-1] - seen[0] + 0.1)], (row - 0.35, 0.7), color=IN_VIEW, lw=0)
    if one.t0_s is not None:
        axes.plot([one.t0_s] * 2, [row - 0.45, row + 0.45], color=TRUTH, linewidth=0.8)
