"""The timeline figure: one occluded approach end to end, drawn from what the filter said."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate.adapters.files.atomic import atomic_path
from worldstate.ground.typing import BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Hops of one entity further apart than this are not joined by a line.
_GAP_S = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class EntityTrail:
    """Where one entity was believed to be, at the hops in which it more likely existed than not."""

    time_s: FloatArray  # Ends of the windows, azimuth, standard deviation
    azimuth_rad: FloatArray
    std_rad: FloatArray
    hidden: BoolArray  # Whether it was behind an occluder

    def broken(self) -> "EntityTrail":
        """Return the trail with a row of NaN in every gap, so that no line is drawn across."""
        gaps = np.flatnonzero(np.diff(self.time_s) > _GAP_S) + 1
        return EntityTrail(
            np.insert(self.time_s, gaps, np.nan),
            np.insert(self.azimuth_rad, gaps, np.nan),
            np.insert(self.std_rad, gaps, np.nan),
            np.insert(self.hidden, gaps, False),
        )


@dataclass(frozen=True, slots=True)
class Timeline:
    """One row a hop of everything that the figure shows.

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
    advisory : array (n,) of bool
        The hidden-hazard advisory.
    azimuths_rad : array (a,)
        Search grid, left positive.
    srp : array (n, a)
        Steered response power of each window.
    entities : tuple of EntityTrail
        Moving entities, in the order in which they came up.
    sighting_time_s, sighting_azimuth_rad : array (d,)
        Moving camera detections.
    t0_s : float or None
        Line-of-sight entry.
    title : str
        Heading of the figure.
    """

    time_s: FloatArray
    statistic: FloatArray
    risk: FloatArray
    threshold: float
    alpha: float
    advisory: BoolArray
    azimuths_rad: FloatArray
    srp: FloatArray
    entities: tuple[EntityTrail, ...]
    sighting_time_s: FloatArray
    sighting_azimuth_rad: FloatArray
    t0_s: float | None
    title: str


def write_timeline(timeline: Timeline, path: Path) -> None:
    """Draw `timeline` and write it as PNG, SVG or PDF, by the ending of `path`.

    Raises
    ------
    OSError
        If the folder cannot be written.
    """
    figure = draw_timeline(timeline)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150, format=path.suffix.lstrip(".") or "png")


def draw_timeline(timeline: Timeline) -> "Figure":
    """Return the figure: azimuth over time above, statistic, threshold and advisory below."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 6.4), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.0, 1.15))
    _draw_azimuths(upper, timeline)
    _draw_statistic(lower, timeline)
    if timeline.t0_s is not None:
        for axes in (upper, lower):
            axes.axvline(timeline.t0_s, color="black", linewidth=1.2, linestyle="--")
        lower.annotate("$T_0$", (timeline.t0_s, 1.02), ha="center", annotation_clip=False)
    figure.suptitle(timeline.title)
    return figure


def _draw_azimuths(axes: "Axes", timeline: Timeline) -> None:
    level = timeline.srp / np.median(timeline.srp, axis=1, keepdims=True)
    mesh = axes.pcolormesh(
        timeline.time_s, np.degrees(timeline.azimuths_rad), level.T, shading="nearest", cmap="Greys"
    )
    colorbar = axes.figure.colorbar(mesh, ax=axes, pad=0.01)
    colorbar.set_label("SRP over its median")
    for trail in timeline.entities:
        _draw_trail(axes, trail.broken())
    seen = np.degrees(timeline.sighting_azimuth_rad)
    axes.plot(timeline.sighting_time_s, seen, ".", color="tab:red", label="camera")
    axes.set(ylabel="azimuth, left positive (deg)", ylim=(-90, 90), yticks=range(-90, 91, 45))
    handles, labels = axes.get_legend_handles_labels()
    once = dict(zip(labels, handles, strict=True))
    axes.legend(once.values(), once.keys(), loc="upper left", fontsize="small")


def _draw_trail(axes: "Axes", trail: EntityTrail) -> None:
    azimuth, spread = np.degrees(trail.azimuth_rad), np.degrees(trail.std_rad)
    for hidden, color, label in ((True, "tab:orange", "hidden"), (False, "tab:blue", "in view")):
        # The first hop in view ends the hidden line too: it is one entity.
        shown = trail.hidden == hidden
        joined = shown | (np.roll(shown, 1) & np.isfinite(azimuth) & (np.arange(shown.size) > 0))
        line, low, high = (
            np.where(where, x, np.nan)
            for where, x in ((joined, azimuth), (shown, azimuth - spread), (shown, azimuth + spread))
        )
        if shown.any():
            axes.fill_between(trail.time_s, low, high, color=color, alpha=0.25, lw=0)
            axes.plot(trail.time_s, line, color=color, label=f"entity, {label}, ±1 std")


def _draw_statistic(axes: "Axes", timeline: Timeline) -> None:
    axes.fill_between(
        timeline.time_s, 0, 1, where=timeline.advisory, step="pre", color="tab:green", alpha=0.3, lw=0,
        label="hidden-hazard advisory",
    )  # fmt: skip
    axes.plot(timeline.time_s, timeline.statistic, color="tab:blue", label="hazard statistic $s(t)$")
    axes.plot(timeline.time_s, timeline.risk, color="tab:orange", label="calibrated risk $r(t)$")
    label = rf"$\gamma(\alpha={timeline.alpha:g})$"
    axes.axhline(timeline.threshold, color="tab:blue", linestyle=":", label=label)
    axes.plot(
        timeline.sighting_time_s, np.full(timeline.sighting_time_s.shape, -0.04), "|", color="tab:red",
        label="camera detection", clip_on=False,
    )  # fmt: skip
    axes.set(xlabel="time (s)", ylabel="statistic, risk", ylim=(-0.08, 1.0))
    axes.legend(loc="center left", fontsize="small")
