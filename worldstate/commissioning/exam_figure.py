"""A figure of an exam: who is warned how long before T0, and how well hidden is told from nobody by then."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from worldstate.operations.figure_style import figure_file, legend_beside

from .stream_exam import ExaminedStream, auroc_before, examine, warned_before

BEFORE_S = np.linspace(0.0, 5.0, 26)


def write_exam_figure(streams: Sequence[ExaminedStream], path: Path) -> None:
    """Draw the share of approaches in alarm and the AUROC against the time before T0, site by site."""
    sites = sorted({one.heard.site for one in streams})
    with figure_file(path, 9.0, 3.6) as figure:
        warned, ranked = figure.subplots(1, 2)
        for site in sites:
            here = [one for one in streams if one.heard.site == site]
            onsets = examine(here)["onsets_per_hour"]
            told = site if onsets is None else f"{site}, {onsets:.0f} an hour"
            warned.plot(-BEFORE_S, warned_before(here, BEFORE_S), linewidth=1.0, label=told)
            ranked.plot(-BEFORE_S, auroc_before(here, BEFORE_S), linewidth=1.0, label=told)
        warned.plot(-BEFORE_S, warned_before(streams, BEFORE_S), color="black", label="all")
        ranked.plot(-BEFORE_S, auroc_before(streams, BEFORE_S), color="black", label="all")
        warned.set(ylim=(0.0, 1.0), xlabel="seconds to T0", ylabel="approaches in alarm by then")
        ranked.set(ylim=(0.5, 1.0), xlabel="seconds to T0", ylabel="AUROC against hazard-free hops")
        legend_beside(ranked, "alarms where nobody comes")
