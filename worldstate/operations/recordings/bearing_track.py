"""The bearing of every hop of a recording, without a model."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worldstate.adapters.audio.sound_file import Audio
from worldstate.frontend.direction.music import count_sources
from worldstate.frontend.frame import AcousticFrame
from worldstate.frontend.spectra.stft import StreamingStft, band_bins
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.ground.values import seconds
from worldstate.operations.figure_style import figure_file

# Bins whose covariance is decomposed to count sources: evenly out of the band.
_BINS = 12


@dataclass(frozen=True, slots=True, eq=False)
class BearingTrack:
    """One row a hop.

    Examples
    --------
    >>> track = BearingTrack(np.array([1.0]), np.array([20.0]), np.array([3.4]), np.array([2.0]), None)
    >>> print(track.csv(), end="")
    time_s,azimuth_deg,std_deg,prominence
    1.000,20.00,3.40,2.000
    """

    time_s: FloatArray  # Middle of the sound that the bearing was read from
    azimuth_deg: FloatArray  # Left positive
    std_deg: FloatArray
    prominence: FloatArray  # Peak-to-median ratio, >= 1; 1 in silence
    sources: FloatArray | None  # Plane waves in the second that the hop ends in

    def csv(self) -> str:
        """Return the table."""
        head = "time_s,azimuth_deg,std_deg,prominence"
        columns = [self.time_s, self.azimuth_deg, self.std_deg, self.prominence]
        form = "{:.3f},{:.2f},{:.2f},{:.3f}"
        if self.sources is not None:
            head, form, columns = head + ",sources", form + ",{:.0f}", [*columns, self.sources]
        return "\n".join([head, *(form.format(*row) for row in zip(*columns, strict=True)), ""])


def track_bearings(
    audio: Audio,
    front_end: FrontEnd,
    *,
    count: bool = False,
    on_second: Callable[[], None] = lambda: None,
) -> BearingTrack:
    """Read the bearing of every hop of an open recording, and count the sources of every second."""
    rows: list[tuple[float, ...]] = []
    for block in audio.blocks(audio.sample_rate_hz):
        sources = _sources_in(block, front_end) if count else 0
        rows += [(*_row(frame), float(sources)) for frame in front_end.process(block)]
        on_second()
    time_s, azimuth, std, prominence, sources_of = np.array(rows, dtype=np.float64).reshape(-1, 5).T
    return BearingTrack(
        time_s, np.degrees(azimuth), np.degrees(std), prominence, sources_of if count else None
    )


def write_bearings_figure(track: BearingTrack, path: Path, title: str) -> None:
    """Draw azimuth over time with its standard deviation, darker where more prominent."""
    with figure_file(path, 9.0, 3.6) as figure:
        axes = figure.subplots()
        axes.errorbar(track.time_s, track.azimuth_deg, track.std_deg, fmt="none", ecolor="0.85", zorder=1)
        dots = axes.scatter(
            track.time_s, track.azimuth_deg, 9.0, track.prominence, cmap="viridis_r", zorder=2
        )
        figure.colorbar(dots, ax=axes, label="prominence")
        axes.set(xlabel="time (s)", ylabel="azimuth, left positive (deg)", title=title)


def _row(frame: AcousticFrame) -> Iterable[float]:
    time_s = seconds(frame.stamp_ns) - frame.bearing_age_s
    return time_s, frame.bearing_rad, frame.bearing_std_rad, frame.prominence


def _sources_in(block: Float32Array, front_end: FrontEnd) -> int:
    """Count plane waves by the eigenvalues of a second's covariances; 0 for less than a tenth of that."""
    settings = front_end.settings
    band = band_bins(settings.srp_band_hz, front_end.sample_rate_hz, settings.nfft)
    chosen = np.unique(np.linspace(0, len(band) - 1, _BINS).round().astype(int))
    # Frames overlap by half; every second one is nearly independent of the last.
    frames = StreamingStft(block.shape[1], settings.nfft, band).push(block)[::2][:, chosen]
    if len(frames) < settings.hop_rate_hz:
        return 0
    covariance = np.einsum("tkm,tkn->kmn", frames, frames.conj()) / len(frames)
    return count_sources(np.maximum(np.linalg.eigvalsh(covariance), 0.0), len(frames))
