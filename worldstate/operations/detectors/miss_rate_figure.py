"""The figure of measured miss rates: beta over degradation, one panel a family, one line an azimuth bin."""

from pathlib import Path

import numpy as np

from worldstate.adapters.camera.degradation import LEVELS
from worldstate.adapters.camera.miss_rates import MissRates
from worldstate.operations.figure_style import figure_file, legend_beside


def write_absence_figure(rates: MissRates, path: Path) -> None:
    """Draw `rates` and write the figure as PNG, SVG or PDF, by the ending of `path`."""
    names = list(rates.families)
    with figure_file(path, 3.0 * len(names) + 1.0, 3.2) as figure:
        panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
        for axes, name in zip(panels, names, strict=True):
            counts = rates.families[name]
            beta, (low, high) = counts.miss_rates(rates.repeats), counts.interval(rates.repeats)
            for i, row in enumerate(beta):
                label = f"{rates.azimuth_deg[i]:.0f}-{rates.azimuth_deg[i + 1]:.0f}°"
                (line,) = axes.plot(LEVELS, row, marker="o", label=label)
                if np.sum(counts.looks[i]):
                    axes.fill_between(LEVELS, low[i], high[i], color=line.get_color(), alpha=0.12, lw=0)
            axes.plot(LEVELS, counts.clutter_rates, color="grey", linestyle=":", label="clutter")
            axes.set(title=name, xlabel="degradation $d$", ylim=(0.0, 1.0))
        panels[0].set_ylabel(r"miss rate $\beta(\theta, d)$")
        legend_beside(panels[-1], "off the optical axis")
