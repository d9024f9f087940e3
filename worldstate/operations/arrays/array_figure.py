"""The array as a picture: which microphones are well, which are not."""

from collections import Counter
from pathlib import Path

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.operations.figure_style import (
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    figure_file,
    legend_beside,
)
from worldstate.operations.recordings.channel_report import RecordingHealth

_COLOURS = {
    "dead": "gray",
    "intermittent": "silver",
    "noisy": RED,
    "inverted": PURPLE,
    "swapped": ORANGE,
    "clipped": "tab:brown",
    "offset": SKY,
    "level": BLUE,
}
# Areas of markers, points squared: one that holds a number of two digits, one that fits a line of the legend,
# and how much smaller a second fault is drawn on the first.
_AREA, _LEGEND_AREA, _SMALLER = 240.0, 80.0, 0.55
_VIEWS = {
    (1, 2): "seen from behind",
    (0, 1): "seen from above, forward is to the right",
    (0, 2): "seen from the right, forward is to the right",
}


def write_array_figure(array: MicrophoneArray, health: RecordingHealth, path: Path) -> None:
    """Draw the microphones across their two widest axes, coloured by fault, channels counted from 1."""
    across, up = sorted(np.argsort(array.aperture_m)[-2:].tolist())
    place = array.centred_m[:, [across, up]]
    with figure_file(path, 7.5, 6.0) as figure:
        axes = figure.add_subplot()
        axes.scatter(place[:, 0], place[:, 1], s=_AREA, color=GREEN, alpha=0.35, lw=0)
        axes.scatter([], [], s=_LEGEND_AREA, color=GREEN, alpha=0.35, lw=0, label="well")
        drawn: Counter[int] = Counter()
        for fault in sorted({verdict.fault for verdict in health.verdicts}):
            channels = [verdict.channel for verdict in health.verdicts if verdict.fault == fault]
            areas = [_AREA * _SMALLER ** drawn[channel] for channel in channels]
            colour = _COLOURS[fault.value]
            axes.scatter(place[channels, 0], place[channels, 1], s=areas, color=colour, alpha=0.8, lw=0)
            axes.scatter([], [], s=_LEGEND_AREA, color=colour, alpha=0.8, lw=0, label=fault.value)
            drawn.update(channels)
        for channel, point in enumerate(place):
            axes.annotate(str(channel + 1), point, ha="center", va="center", fontsize=7.5)
        for verdict in health.verdicts:
            if verdict.looks_like is not None:
                # Bent, so that the two arrows of a swapped pair do not cover each other.
                arrow = {"arrowstyle": "->", "color": _COLOURS["swapped"], "shrinkA": 9, "shrinkB": 9}
                arrow["connectionstyle"] = "arc3,rad=0.2"
                axes.annotate("", place[verdict.looks_like], place[verdict.channel], arrowprops=arrow)
        axes.set(xlabel=f"{'xyz'[across]} (m)", ylabel=f"{'xyz'[up]} (m)", aspect="equal")
        axes.margins(0.08)  # whole markers at the edge
        if across == 1:
            axes.invert_xaxis()  # left is left
        axes.set_title(f"{array.n_microphones} microphones {_VIEWS[across, up]}; channels from 1")
        legend_beside(axes)
