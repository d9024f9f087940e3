"""The array as a picture: which microphones are well, which are not."""

from pathlib import Path

import numpy as np

from worldstate.adapters.files.atomic import atomic_path
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.operations.recordings.channel_report import RecordingHealth

COLOURS = {
    "dead": "dimgray",
    "intermittent": "silver",
    "noisy": "tab:red",
    "inverted": "tab:purple",
    "swapped": "tab:orange",
    "clipped": "tab:brown",
    "offset": "tab:olive",
    "level": "tab:cyan",
}


def write_array_figure(array: MicrophoneArray, health: RecordingHealth, path: Path) -> None:
    """Draw the microphones across their two widest axes, coloured by fault, channels counted from 1."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    across, up = sorted(np.argsort(array.aperture_m)[-2:])
    place = array.centred_m[:, [across, up]]
    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.scatter(place[:, 0], place[:, 1], s=180, color="tab:green", alpha=0.35, label="well")
    for fault in sorted({verdict.fault for verdict in health.verdicts}):
        channels = [verdict.channel for verdict in health.verdicts if verdict.fault == fault]
        faulty = place[channels]
        axes.scatter(faulty[:, 0], faulty[:, 1], s=180, color=COLOURS[fault.value], label=fault.value)
    for channel, (x, y) in enumerate(place):
        axes.annotate(str(channel + 1), (x, y), ha="center", va="center", fontsize=7)
    for verdict in health.verdicts:
        if verdict.looks_like is not None:
            arrow = {"arrowstyle": "->", "color": COLOURS["swapped"]}
            axes.annotate("", place[verdict.looks_like], place[verdict.channel], arrowprops=arrow)
    axes.set_xlabel(f"{'xyz'[across]} (m)")
    axes.set_ylabel(f"{'xyz'[up]} (m)")
    axes.set_aspect("equal")
    if across == 1:
        axes.invert_xaxis()  # left is left
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format=path.suffix.lstrip(".") or "png", dpi=120)
