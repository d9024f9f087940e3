"""The figures of efficiency: variance over bound against SNR, and the bearing toward endfire."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate.adapters.files.atomic import atomic_path
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.bounds.cramer_rao import broadside_rad, endfire_information

from .efficiency import Efficiency

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# What the library promises of its estimators at high SNR.
PROMISED_DB = 1.5


def write_efficiency_figure(measured: Sequence[Efficiency], path: Path) -> None:
    """Draw mean squared error over bound, dB against dB, and write it by the ending of `path`."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.4), layout="constrained")
    axes = figure.subplots()
    low, high = measured[0].sampling_db()
    axes.axhspan(low, high, color="grey", alpha=0.2, lw=0, label=f"sampling, {measured[0].trials} trials")
    axes.axhline(0.0, color="black", linewidth=0.8)
    axes.axhline(PROMISED_DB, color="black", linewidth=0.8, linestyle=":", label=f"{PROMISED_DB:g} dB")
    for one in measured:
        axes.plot(one.at, one.ratio_db, marker="o", markersize=4, label=one.name)
    axes.set(xlabel="SNR (dB)", ylabel="mean squared error over bound (dB)", ylim=(-2.0, 15.0))
    axes.legend(fontsize="small")
    _save(figure, path)


def write_endfire_figure(measured: Efficiency, array: MicrophoneArray, title: str, path: Path) -> None:
    """Draw the corollary: bearings fade toward endfire, and what does not depend on the bearing stays."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    azimuth_deg = np.degrees(measured.at)
    left.semilogy(azimuth_deg, np.degrees(np.sqrt(measured.bound)), color="black", label="bound")
    left.semilogy(azimuth_deg, np.degrees(np.sqrt(measured.mean_square)), "o", label=measured.name)
    left.set(ylabel="bearing error, rms (deg)", title=title)
    fine = np.radians(np.linspace(0.0, 90.0, 181))
    shape = endfire_information(array.positions_m, broadside_rad(array.positions_m) + fine)
    share = measured.bound.min() / measured.mean_square
    right.plot(np.degrees(fine), shape, color="black", label="bearing")
    right.plot(azimuth_deg, share, "o", label="bearing, achieved")
    right.axhline(1.0, color="C2", linestyle="--", label="radial speed, presence")
    right.set(ylabel="information, share of the best", ylim=(0.0, 1.4))
    for axes in (left, right):
        axes.set_xlabel("azimuth from broadside (deg)")
        axes.legend(fontsize="small")
    _save(figure, path)


def _save(figure: "Figure", path: Path) -> None:
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150, format=path.suffix.lstrip(".") or "png")
