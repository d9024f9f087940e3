"""The timeline figure: one occluded approach end to end, drawn from what the filter said."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from worldstate.adapters.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]


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
    entity_azimuth_rad, entity_std_rad : array (n,)
        Azimuth of the leading entity and its standard deviation; NaN where there is none.
    sighting_time_s, sighting_azimuth_rad : array (d,)
        Moving camera detections.
    t0_s : float or None
        Line-of-sight entry.
    title : str
        Heading of the figure.
    """

    time_s: Floats
    statistic: Floats
    risk: Floats
    threshold: float
    alpha: float
    advisory: NDArray[np.bool_]
    azimuths_rad: Floats
    srp: Floats
    entity_azimuth_rad: Floats
    entity_std_rad: Floats
    sighting_time_s: Floats
    sighting_azimuth_rad: Floats
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
    azimuth, spread = np.degrees(timeline.entity_azimuth_rad), np.degrees(timeline.entity_std_rad)
    axes.fill_between(timeline.time_s, azimuth - spread, azimuth + spread, color="tab:blue", alpha=0.2, lw=0)
    axes.plot(timeline.time_s, azimuth, color="tab:blue", label="entity azimuth, ±1 std")
    seen = np.degrees(timeline.sighting_azimuth_rad)
    axes.plot(timeline.sighting_time_s, seen, ".", color="tab:red", label="camera")
    axes.set(ylabel="azimuth, left positive (deg)", ylim=(-90, 90), yticks=range(-90, 91, 45))
    axes.legend(loc="upper left", fontsize="small")


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
