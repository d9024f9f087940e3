"""The timeline figure: bearings, advisories by side, and the hazard statistic of one recording."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate.frontend.settings import HOP_RATE_HZ, WINDOW_HOPS
from worldstate.ground.typing import FloatArray
from worldstate.operations.figure_style import (
    BLUE,
    GREEN,
    HOP_S,
    ORANGE,
    PURPLE,
    RED,
    draw_bars,
    draw_power,
    figure_style,
    legend_beside,
    name_rows,
    save_figure,
    with_gaps,
)

from .hop_table import HopTable
from .true_track import TrueTrack

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Length of a decision window.
WINDOW_S = WINDOW_HOPS / HOP_RATE_HZ
# Longest title in one line above a figure of this width.
_TITLE_CHARACTERS = 100
# Rows of the middle panel, from below.
_ROWS = ("camera detection", "advisory right", "advisory left")


@dataclass(frozen=True, slots=True, eq=False)
class Timeline:
    """What the figure shows.

    Parameters
    ----------
    hops : HopTable
        One row a hop: ``time_s``, the end of its window in seconds from the start of the recording;
        ``statistic`` and ``risk``, s(t) and r(t) in [0, 1]; ``left`` and ``right``, whether an advisory of
        that side is on; ``srp``, the steered response power of the window over azimuth.
    threshold : float
        gamma(alpha) on the statistic.
    alpha : float
        The false-positive budget that gamma was set for.
    azimuths_rad : array (a,)
        Search grid, left positive.
    entities : tuple of array (n, 4)
        Moving entities in the order in which they came up, at the hops in which each more likely existed than
        not: time, azimuth, standard deviation, and 1 where it was behind an occluder.
    sightings : array (d, 2)
        Time and azimuth of moving camera detections.
    t0_s : float or None
        Line-of-sight entry.
    truth : tuple of TrueTrack
        True tracks of the vehicles of a simulated recording, else empty.
    title : str
        Heading of the figure.

    Examples
    --------
    >>> columns = dict.fromkeys(("statistic", "risk", "left", "right"), np.zeros(20))
    >>> hops = HopTable({"time_s": 1.0 + 0.1 * np.arange(20), "srp": np.ones((20, 9)), **columns})
    >>> quiet = Timeline(hops, threshold=0.8, alpha=0.02, azimuths_rad=np.linspace(-1.0, 1.0, 9))
    >>> len(quiet.hops), quiet.t0_s
    (20, None)
    """

    hops: HopTable
    threshold: float
    alpha: float
    azimuths_rad: FloatArray
    entities: tuple[FloatArray, ...] = ()
    sightings: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    t0_s: float | None = None
    truth: tuple[TrueTrack, ...] = ()
    title: str = ""


def write_timeline(timeline: Timeline, path: Path) -> None:
    """Draw `timeline` and write it as PNG, SVG or PDF, by the ending of `path`.

    Raises
    ------
    InputFileError
        If the ending is another one or the folder is missing.
    OSError
        If the folder cannot be written.

    Parameters
    ----------
    timeline : Timeline
        From `run_recording`.
    path : Path
        Exactly this file.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> columns = dict.fromkeys(("statistic", "risk", "left", "right"), np.zeros(20))
    >>> hops = HopTable({"time_s": 1.0 + 0.1 * np.arange(20), "srp": np.ones((20, 9)), **columns})
    >>> quiet = Timeline(hops, threshold=0.8, alpha=0.02, azimuths_rad=np.linspace(-1.0, 1.0, 9))
    >>> with TemporaryDirectory() as folder:
    ...     write_timeline(quiet, Path(folder) / "quiet.png")
    ...     (Path(folder) / "quiet.png").stat().st_size > 10_000
    True
    """
    with figure_style():
        save_figure(draw_timeline(timeline), path)


def draw_timeline(timeline: Timeline) -> "Figure":
    """Return the figure: azimuth above, advisories and camera in the middle, statistic and risk below."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 7.2), layout="constrained")
    upper, middle, lower = figure.subplots(3, 1, sharex=True, height_ratios=(1.0, 0.3, 0.75))
    _draw_azimuths(upper, timeline)
    _draw_rows(middle, timeline)
    _draw_statistic(lower, timeline)
    _mark_visible(figure.axes[:3], timeline)
    for axes in (upper, middle, lower):
        legend_beside(axes)
    title = timeline.title
    figure.suptitle(title if len(title) <= _TITLE_CHARACTERS else "..." + title[-_TITLE_CHARACTERS:])
    return figure


def _draw_azimuths(axes: "Axes", timeline: Timeline) -> None:
    # A window of one second that ends at t holds the sound around t - 0.5 s: drawn at its end it would lag
    # the camera, whose boxes are of the moment.
    middle_s = timeline.hops.time_s - WINDOW_S / 2.0
    label = f"SRP over its median over azimuth, {WINDOW_S:g}-s windows, each drawn at its middle"
    draw_power(axes, middle_s, timeline.azimuths_rad, timeline.hops.srp, label)
    for vehicle in timeline.truth:
        _draw_truth(axes, vehicle)
    for entity in timeline.entities:
        _draw_entity(axes, entity)
    seen_s, seen_rad = timeline.sightings.T
    axes.plot(seen_s, np.degrees(seen_rad), ".", color=PURPLE, label="camera, moving box")
    axes.set(ylabel="azimuth (deg), left positive", ylim=(-90, 90), yticks=range(-90, 91, 45))


def _draw_truth(axes: "Axes", track: TrueTrack) -> None:
    azimuth = np.degrees(track.azimuth_rad)
    for shown, style, name in ((~track.in_view, ":", "out of sight"), (track.in_view, "-", "in sight")):
        line = np.where(shown, azimuth, np.nan)
        axes.plot(track.time_s, line, style, color=GREEN, linewidth=2.0, label=f"vehicle, truth, {name}")


def _draw_entity(axes: "Axes", track: FloatArray) -> None:
    time_s, azimuth_rad, std_rad, behind = with_gaps(track).T
    azimuth, spread = np.degrees(azimuth_rad), np.degrees(std_rad)
    for hidden, color, label in ((True, RED, "hidden"), (False, BLUE, "in view")):
        # The first hop in view ends the hidden line too: it is one entity.
        shown = behind == hidden
        joined = shown | (np.roll(shown, 1) & np.isfinite(azimuth) & (np.arange(shown.size) > 0))
        line, low, high = (
            np.where(where, x, np.nan)
            for where, x in ((joined, azimuth), (shown, azimuth - spread), (shown, azimuth + spread))
        )
        if shown.any():
            axes.fill_between(time_s, low, high, color=color, alpha=0.25, lw=0)
            axes.plot(time_s, line, color=color, label=f"entity, {label}, ±1 std")


def _draw_rows(axes: "Axes", timeline: Timeline) -> None:
    """Draw a bar for every advisory in the row of its side, and a tick for every camera detection."""
    for side, color in (("left", RED), ("right", ORANGE)):
        row = _ROWS.index(f"advisory {side}")
        draw_bars(axes, timeline.hops.time_s, timeline.hops.columns[side], row, color)
    axes.plot(timeline.sightings[:, 0], np.zeros(len(timeline.sightings)), "|", color=PURPLE)
    name_rows(axes, _ROWS)


def _draw_statistic(axes: "Axes", timeline: Timeline) -> None:
    time_s = timeline.hops.time_s
    axes.plot(time_s, timeline.hops.statistic, color=BLUE, label="hazard statistic $s(t)$")
    axes.plot(time_s, timeline.hops.risk, color=RED, label="calibrated risk $r(t)$")
    label = rf"threshold $\gamma(\alpha={timeline.alpha:g})$ on $s$"
    axes.axhline(timeline.threshold, color=BLUE, linestyle=":", label=label)
    axes.set(xlabel="time (s), end of the decision window", ylabel="statistic, risk", ylim=(-0.02, 1.02))
    # The first window begins a second before its decision: at 0, or where a bag's clock or --start says.
    first_s, last_s = time_s[[0, -1]] if time_s.size else (1.0, 1.0)
    axes.set_xlim(first_s - 1.0, last_s + HOP_S)


def _mark_visible(panels: "list[Axes]", timeline: Timeline) -> None:
    """Mark line-of-sight entry and, where the truth is known, the interval in which a vehicle is visible."""
    intervals = [track.visible_s for track in timeline.truth]
    for axes in panels:
        if timeline.t0_s is not None:
            axes.axvline(timeline.t0_s, color="black", linewidth=1.2, linestyle="--")
    # Shading the power above would change its greys; one panel names it for both.
    for axes, label in ((panels[1], "in line of sight (truth)"), (panels[2], None)):
        for interval in filter(None, intervals):
            axes.axvspan(*interval, color=GREEN, alpha=0.12, lw=0, label=label)
    if timeline.t0_s is not None:
        entry = panels[1].axvline(timeline.t0_s, color="black", linewidth=1.2, linestyle="--")
        entry.set_label("line-of-sight entry $T_0$")
