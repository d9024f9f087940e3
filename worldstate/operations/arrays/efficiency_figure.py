"""The figures of efficiency: variance over bound against SNR, and the bearing toward endfire."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.bounds.cramer_rao import broadside_rad, endfire_information
from worldstate.operations.figure_style import GREEN, figure_file, legend_beside

from .efficiency import Efficiency

# What the library promises of its estimators at high SNR.
PROMISED_DB = 1.5
# Below its threshold SNR an estimator fails by tens of decibels; the figure is about what lies above.
_MOST_DB = 15.0


def write_efficiency_figure(measured: Sequence[Efficiency], path: Path) -> None:
    """Draw mean squared error over bound, dB against dB, and write it by the ending of `path`."""
    with figure_file(path, 9.5, 4.4) as figure:
        axes = figure.subplots()
        low, high = measured[0].sampling_db()
        sampling = f"99.7 % of an efficient estimator,\n{measured[0].trials} trials"
        axes.axhspan(low, high, color="grey", alpha=0.2, lw=0, label=sampling)
        axes.axhline(0.0, color="black", linewidth=0.8, label="Cramer-Rao bound")
        promised = f"promised at high SNR, {PROMISED_DB:g} dB"
        axes.axhline(PROMISED_DB, color="black", linewidth=0.8, linestyle=":", label=promised)
        for one in measured:
            axes.plot(one.at, one.ratio_db, marker="o", markersize=4, label=one.name)
        least = min(low, *(float(np.min(one.ratio_db)) for one in measured))
        axes.set(xlabel="SNR (dB)", ylabel="mean squared error over bound (dB)", ylim=(least - 0.5, _MOST_DB))
        axes.set_title("efficiency of the estimators")
        legend_beside(axes)


def write_endfire_figure(measured: Efficiency, array: MicrophoneArray, title: str, path: Path) -> None:
    """Draw the loss of bearing information toward endfire beside what does not depend on the bearing."""
    fine = np.radians(np.linspace(0.0, 90.0, 181))
    shape = endfire_information(array.positions_m, broadside_rad(array.positions_m) + fine)
    azimuth_deg = np.degrees(measured.at)
    with figure_file(path, 9.0, 5.6) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True)
        upper.plot(azimuth_deg, np.degrees(np.sqrt(measured.bound)), color="black", label="Cramer-Rao bound")
        upper.plot(azimuth_deg, np.degrees(np.sqrt(measured.mean_square)), "o", label=measured.name)
        upper.set(ylabel="bearing error,\nrms (deg)", yscale="log", title=title)
        # A decade is seldom filled: without labels between the powers of ten there would be one or none.
        for axis in ("major", "minor"):
            getattr(upper.yaxis, f"set_{axis}_formatter")("{x:.2g}")
        lower.plot(np.degrees(fine), shape, color="black", label="bearing, bound")
        lower.plot(azimuth_deg, measured.bound.min() / measured.mean_square, "o", label="bearing, achieved")
        lower.axhline(1.0, color=GREEN, linestyle="--", label="radial speed, presence")
        lower.set(ylabel="information,\nshare of the best bearing", ylim=(0.0, None))
        lower.set_xlabel("azimuth from broadside (deg)")
        for axes in (upper, lower):
            legend_beside(axes)
