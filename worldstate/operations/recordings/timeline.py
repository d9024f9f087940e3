"""The timeline figure: bearings, advisories by side, and the hazard statistic of one recording."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.operations.figure_style import (
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    RED,
    figure_style,
    legend_beside,
    save_figure,
)

from .true_track import TrueTrack

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# An advisory holds until the next decision.
_HOP_S = 0.1
# Hops of one entity further apart than this are not joined by a line.
_GAP_S = 1.5 * _HOP_S
# Longest title in one line above a figure of this width.
_TITLE_CHARACTERS = 100
# Rows of the middle panel, from below.
_CAMERA_ROW, _SIDE_ROWS = 0, {"right": 1, "left": 2}


@dataclass(frozen=True, slots=True, eq=False)
class EntityTrack:
    """Azimuth of one entity at the hops in which it more likely existed than not."""

    time_s: FloatArray  # Ends of the windows, azimuth, standard deviation
    azimuth_rad: FloatArray
    std_rad: FloatArray
    hidden: BoolArray  # Whether it was behind an occluder

    def broken(self) -> "EntityTrack":
        """Return the track with a row of NaN in every gap, so that no line is drawn across."""
        gaps = np.flatnonzero(np.diff(self.time_s) > _GAP_S) + 1
        numbers = self.time_s, self.azimuth_rad, self.std_rad
        time_s, azimuth_rad, std_rad = (np.insert(row, gaps, np.nan) for row in numbers)
        return EntityTrack(time_s, azimuth_rad, std_rad, np.insert(self.hidden, gaps, False))


@dataclass(frozen=True, slots=True)
class Timeline:
    """What the figure shows, one row a hop.

    Parameters
    ----------
    time_s : array (n,)
        End of each decision window, seconds from the start of the recording.
    statistic, risk : array (n,)
        s(t) and the calibrated risk r(t), both in [0, 1].
    threshold : float
        gamma(alpha) on the statistic.
    alpha : float
        The false-positive budget that gamma was set for.
    advisory : mapping of str to array (n,) of bool
        The hidden-hazard advisory by the side that it names, ``"left"`` and ``"right"``.
    azimuths_rad : array (a,)
        Search grid, left positive.
    srp : array (n, a)
        Steered response power of each window.
    srp_age_s : float
        From the middle of the window of `srp` to its end, seconds; the figure draws it that much earlier.
    entities : tuple of EntityTrack
        Moving entities, in the order in which they came up.
    sighting_time_s, sighting_azimuth_rad : array (d,)
        Moving camera detections.
    t0_s : float or None
        Line-of-sight entry.
    truth : tuple of TrueTrack
        True tracks of the vehicles of a simulated recording, else empty.
    title : str
        Heading of the figure.

    Examples
    --------
    >>> n = 20
    >>> quiet = Timeline(
    ...     time_s=1.0 + 0.1 * np.arange(n), statistic=np.zeros(n), risk=np.zeros(n), threshold=0.8,
    ...     alpha=0.02, advisory={"left": np.zeros(n, bool), "right": np.zeros(n, bool)},
    ...     azimuths_rad=np.linspace(-1, 1, 9), srp=np.ones((n, 9)), srp_age_s=0.5, entities=(),
    ...     sighting_time_s=np.empty(0), sighting_azimuth_rad=np.empty(0), t0_s=None, truth=(), title="",
    ... )
    >>> int(quiet.advisory["left"].sum())
    0
    """

    time_s: FloatArray
    statistic: FloatArray
    risk: FloatArray
    threshold: float
    alpha: float
    advisory: Mapping[str, BoolArray]
    azimuths_rad: FloatArray
    srp: FloatArray
    srp_age_s: float
    entities: tuple[EntityTrack, ...]
    sighting_time_s: FloatArray
    sighting_azimuth_rad: FloatArray
    t0_s: float | None
    truth: tuple[TrueTrack, ...]
    title: str


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
    >>> n = 20
    >>> quiet = Timeline(
    ...     time_s=1.0 + 0.1 * np.arange(n), statistic=np.zeros(n), risk=np.zeros(n), threshold=0.8,
    ...     alpha=0.02, advisory={"left": np.zeros(n, bool), "right": np.zeros(n, bool)},
    ...     azimuths_rad=np.linspace(-1, 1, 9), srp=np.ones((n, 9)), srp_age_s=0.5, entities=(),
    ...     sighting_time_s=np.empty(0), sighting_azimuth_rad=np.empty(0), t0_s=None, truth=(), title="",
    ... )
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
    level = timeline.srp / np.median(timeline.srp, axis=1, keepdims=True)
    # A window of one second that ends at t holds the sound around t - 0.5 s: drawn at its end it would lag
    # the camera, whose boxes are of the moment.
    middle_s = timeline.time_s - timeline.srp_age_s
    mesh = axes.pcolormesh(
        middle_s, np.degrees(timeline.azimuths_rad), level.T, shading="nearest", cmap="Greys", rasterized=True
    )
    bar = axes.figure.colorbar(mesh, ax=axes, location="top", aspect=60, pad=0.02, fraction=0.05)
    width_s = 2.0 * timeline.srp_age_s
    bar.set_label(f"SRP over its median over azimuth, {width_s:g}-s windows, each drawn at its middle")
    for vehicle in timeline.truth:
        _draw_truth(axes, vehicle)
    for entity in timeline.entities:
        _draw_entity(axes, entity.broken())
    seen = np.degrees(timeline.sighting_azimuth_rad)
    axes.plot(timeline.sighting_time_s, seen, ".", color=PURPLE, label="camera, moving box")
    axes.set(ylabel="azimuth (deg), left positive", ylim=(-90, 90), yticks=range(-90, 91, 45))


def _draw_truth(axes: "Axes", track: TrueTrack) -> None:
    azimuth = np.degrees(track.azimuth_rad)
    for shown, style, name in ((~track.in_view, ":", "out of sight"), (track.in_view, "-", "in sight")):
        line = np.where(shown, azimuth, np.nan)
        axes.plot(track.time_s, line, style, color=GREEN, linewidth=2.0, label=f"vehicle, truth, {name}")


def _draw_entity(axes: "Axes", track: EntityTrack) -> None:
    azimuth, spread = np.degrees(track.azimuth_rad), np.degrees(track.std_rad)
    for hidden, color, label in ((True, RED, "hidden"), (False, BLUE, "in view")):
        # The first hop in view ends the hidden line too: it is one entity.
        shown = track.hidden == hidden
        joined = shown | (np.roll(shown, 1) & np.isfinite(azimuth) & (np.arange(shown.size) > 0))
        line, low, high = (
            np.where(where, x, np.nan)
            for where, x in ((joined, azimuth), (shown, azimuth - spread), (shown, azimuth + spread))
        )
        if shown.any():
            axes.fill_between(track.time_s, low, high, color=color, alpha=0.25, lw=0)
            axes.plot(track.time_s, line, color=color, label=f"entity, {label}, ±1 std")


def _draw_rows(axes: "Axes", timeline: Timeline) -> None:
    """Draw a bar for every advisory in the row of its side, and a tick for every camera detection."""
    for side, color in (("left", RED), ("right", ORANGE)):
        for start, stop in _runs(timeline.advisory[side]):
            begin_s, end_s = timeline.time_s[start], timeline.time_s[stop - 1] + _HOP_S
            axes.broken_barh([(begin_s, end_s - begin_s)], (_SIDE_ROWS[side] - 0.4, 0.8), color=color, lw=0)
    camera = np.full(timeline.sighting_time_s.shape, _CAMERA_ROW)
    axes.plot(timeline.sighting_time_s, camera, "|", color=PURPLE)
    rows = {"camera detection": _CAMERA_ROW} | {f"advisory {side}": row for side, row in _SIDE_ROWS.items()}
    axes.set(yticks=list(rows.values()), yticklabels=list(rows), ylim=(-0.6, 2.6))
    axes.tick_params(axis="y", length=0)


def _draw_statistic(axes: "Axes", timeline: Timeline) -> None:
    axes.plot(timeline.time_s, timeline.statistic, color=BLUE, label="hazard statistic $s(t)$")
    axes.plot(timeline.time_s, timeline.risk, color=RED, label="calibrated risk $r(t)$")
    label = rf"threshold $\gamma(\alpha={timeline.alpha:g})$ on $s$"
    axes.axhline(timeline.threshold, color=BLUE, linestyle=":", label=label)
    axes.set(xlabel="time (s), end of the decision window", ylabel="statistic, risk", ylim=(-0.02, 1.02))
    # The first window begins a second before its decision: at 0, or where a bag's clock or --start says.
    first_s, last_s = timeline.time_s[[0, -1]] if timeline.time_s.size else (1.0, 1.0)
    axes.set_xlim(first_s - 1.0, last_s + _HOP_S)


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


def _runs(on: BoolArray) -> list[tuple[int, int]]:
    """First index, and one past the last, of every stretch of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
