"""Bearing of every hop of a recording, without a model."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from worldstate.adapters.audio.sound_file import Audio
from worldstate.adapters.files.file_io import write_rows
from worldstate.frontend.stream import AcousticFrame, FrontEnd
from worldstate.ground.values import seconds
from worldstate.operations.figure_style import figure_file

from .hop_table import HopTable

# Columns of the text table: middle of the sound from which the bearing is estimated; azimuth, left positive;
# its standard deviation; peak-to-median ratio, 1 in silence; 1 at the edge of the searched sector.
_FORMS = {"time_s": ".3f", "azimuth_deg": ".2f", "std_deg": ".2f", "prominence": ".3f", "at_edge": ".0f"}


def write_bearings(track: HopTable, path: Path) -> None:
    """Write the table as CSV, atomically."""
    columns = [[f"{value:{_FORMS[name]}}" for value in column] for name, column in track.columns.items()]
    write_rows(path, tuple(track.columns), zip(*columns, strict=True), newline="\n")


def track_bearings(
    audio: Audio, front_end: FrontEnd, *, on_second: Callable[[], None] = lambda: None
) -> HopTable:
    """Estimate the bearing of every hop of an open recording."""
    rows: list[tuple[float, ...]] = []
    for block in audio.blocks(audio.sample_rate_hz):
        rows += map(_row, front_end.process(block))
        on_second()
    rows += map(_row, front_end.finish())
    return HopTable.of_rows(tuple(_FORMS), rows)


def write_bearings_figure(track: HopTable, path: Path, title: str) -> None:
    """Draw azimuth over time with its standard deviation; darker dots are more prominent."""
    with figure_file(path, 9.0, 3.6) as figure:
        axes, places = figure.subplots(), (track.time_s, track.azimuth_deg)
        axes.errorbar(*places, track.std_deg, fmt="none", ecolor="0.85", zorder=1)
        dots = axes.scatter(*places, 9.0, track.prominence, cmap="viridis_r", zorder=2)
        figure.colorbar(dots, ax=axes, label="prominence")
        axes.set(xlabel="time (s)", ylabel="azimuth, left positive (deg)", title=title)


def _row(frame: AcousticFrame) -> tuple[float, ...]:
    time_s = seconds(frame.stamp_ns) - frame.bearing_age_s
    azimuth_deg, std_deg = np.degrees([frame.bearing_rad, frame.bearing_std_rad])
    return time_s, azimuth_deg, std_deg, frame.prominence, frame.at_edge
