"""The figure of the bounds: bearing over azimuth, information and error on data, Fisher ratio over bands."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate.operations.figure_style import figure_file, legend_beside
from worldstate_lab.signatures.fisher_profile import BandProfile

from .identifiability import ReachOfArray, ReachOnData

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def write_identifiability_figure(
    path: Path, array: ReachOfArray, data: ReachOnData | None, bands: BandProfile | None
) -> None:
    """Draw one panel for each part that was asked for, and write them by the ending of `path`."""
    panels = 1 + (data is not None) + (bands is not None)
    with figure_file(path, 5.2 * panels, 3.4) as figure:
        axes = iter(np.atleast_1d(figure.subplots(1, panels)))
        _draw_array(next(axes), array)
        if data is not None:
            _draw_data(next(axes), data)
        if bands is not None:
            _draw_bands(next(axes), bands)


def _draw_array(axes: "Axes", array: ReachOfArray) -> None:
    azimuth_deg = np.degrees(array.azimuths_rad)
    for label, std_rad in (("sound alone", array.std_rad), ("with camera", array.with_vision_rad)):
        known = np.isfinite(std_rad)
        axes.semilogy(azimuth_deg[known], np.degrees(std_rad[known]), marker="o", label=label)
    axes.set(xlabel="azimuth, left positive (deg)", ylabel="smallest std of a bearing (deg)")
    legend_beside(axes)


def _draw_data(axes: "Axes", data: ReachOnData) -> None:
    values = {
        "classifier's error": data.error,
        "bound on any error": data.sharp_fano,
        "information / entropy, at most": data.information_high / data.entropy_bits,
        "information / entropy, at least": data.information_lower / data.entropy_bits,
    }
    axes.barh(list(values), list(values.values()))
    axes.set(xlim=(0.0, 1.0), xlabel=f"share ({data.windows} windows, {data.states} classes)")


def _draw_bands(axes: "Axes", bands: BandProfile) -> None:
    axes.stairs(bands.by_level, bands.edges_hz, label="level")
    axes.stairs(bands.by_shape, bands.edges_hz, label="shape", linewidth=2.0)
    axes.axvspan(*bands.range_hz, color="grey", alpha=0.15, lw=0)
    axes.set(xscale="log", xlabel="frequency (Hz)", ylabel="Fisher ratio, vehicle against none")
    legend_beside(axes)
