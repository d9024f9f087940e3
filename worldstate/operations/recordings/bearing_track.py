"""Bearing of every hop of a recording, without a model."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from worldstate.adapters.audio.sound_file import Audio
from worldstate.adapters.files.file_io import write_rows
from worldstate.frontend.direction.music import count_sources
from worldstate.frontend.spectra.stft import StreamingStft, band_bins
from worldstate.frontend.stream import AcousticFrame, FrontEnd
from worldstate.ground.typing import Float32Array
from worldstate.ground.values import seconds
from worldstate.operations.figure_style import figure_file

from .hop_table import HopTable

# Number of bins, spread evenly over the band, whose covariance is decomposed to count sources.
_BINS = 12
_FEWEST_FRAMES = 10  # Fewest frames for a meaningful covariance


# Columns of the text table: middle of the sound from which the bearing is estimated; azimuth, left positive;
# its standard deviation; peak-to-median ratio, 1 in silence; 1 at the edge of the searched sector; number of
# plane waves in the second that ends with the hop.
_FORMS = {"time_s": ".3f", "azimuth_deg": ".2f", "std_deg": ".2f", "prominence": ".3f", "at_edge": ".0f"}
_FORMS |= {"sources": ".0f"}


def write_bearings(track: HopTable, path: Path) -> None:
    """Write the table as CSV, atomically."""
    columns = [[f"{value:{_FORMS[name]}}" for value in column] for name, column in track.columns.items()]
    write_rows(path, tuple(track.columns), zip(*columns, strict=True), newline="\n")


def track_bearings(
    audio: Audio, front_end: FrontEnd, *, count: bool = False, on_second: Callable[[], None] = lambda: None
) -> HopTable:
    """Estimate the bearing of every hop of an open recording, and count the sources of every second."""
    rows: list[tuple[float, ...]] = []
    for block in audio.blocks(audio.sample_rate_hz):
        sources = (_sources_in(block, front_end),) if count else ()
        rows += [(*_row(frame), *sources) for frame in front_end.process(block)]
        on_second()
    rows += [(*_row(frame), *sources) for frame in front_end.finish()]
    return HopTable.of_rows(tuple(_FORMS)[: 6 if count else 5], rows)


def write_bearings_figure(track: HopTable, path: Path, title: str) -> None:
    """Draw azimuth over time with its standard deviation; darker dots are more prominent."""
    with figure_file(path, 9.0, 3.6) as figure:
        axes, places = figure.subplots(), (track.time_s, track.azimuth_deg)
        axes.errorbar(*places, track.std_deg, fmt="none", ecolor="0.85", zorder=1)
        dots = axes.scatter(*places, 9.0, track.prominence, cmap="viridis_r", zorder=2)
        figure.colorbar(dots, ax=axes, label="prominence")
        axes.set(xlabel="time (s)", ylabel="azimuth, left positive (deg)", title=title)


def _row(frame: AcousticFrame) -> Iterable[float]:
    time_s = seconds(frame.stamp_ns) - frame.bearing_age_s
    azimuth_deg, std_deg = np.degrees([frame.bearing_rad, frame.bearing_std_rad])
    return time_s, azimuth_deg, std_deg, frame.prominence, frame.at_edge


def _sources_in(block: Float32Array, front_end: FrontEnd) -> int:
    """Count plane waves by the eigenvalues of a second's covariances; 0 for less than a tenth of a second."""
    settings = front_end.settings
    band = band_bins(settings.srp_band_hz, front_end.sample_rate_hz, settings.nfft)
    chosen = np.unique(np.linspace(0, len(band) - 1, _BINS).round().astype(int))
    # Without the noise of a dead microphone, all sound of the others would count as waves.
    alive = block[:, np.ptp(block, axis=0) > 0.0]
    if not alive.shape[1]:
        return 0
    # Frames overlap by half, so every second one is nearly independent.
    frames = StreamingStft(alive.shape[1], settings.nfft, band).push(alive)[::2][:, chosen]
    if len(frames) < _FEWEST_FRAMES:
        return 0
    covariance = np.einsum("tkm,tkn->kmn", frames, frames.conj()) / len(frames)
    return count_sources(np.maximum(np.linalg.eigvalsh(covariance), 0.0), len(frames))
