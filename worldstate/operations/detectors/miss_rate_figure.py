"""The figure of measured miss rates: beta over degradation, one panel a family, one line an azimuth bin."""

from pathlib import Path

import numpy as np

from worldstate.adapters.camera.degradation import LEVELS
from worldstate.adapters.camera.miss_rates import MissRates
from worldstate.adapters.files.atomic import atomic_path


def write_absence_figure(rates: MissRates, path: Path) -> None:
    """Draw `rates` and write the figure as PNG, SVG or PDF, by the ending of `path`."""
    from matplotlib.figure import Figure

    names = list(rates.families)
    figure = Figure(figsize=(3.2 * len(names), 3.2), layout="constrained")
    for axes, name in zip(figure.subplots(1, len(names), sharey=True, squeeze=False)[0], names, strict=True):
        counts = rates.families[name]
        beta, (low, high) = counts.miss_rates(rates.repeats), counts.interval(rates.repeats)
        for i, row in enumerate(beta):
            label = f"{rates.azimuth_deg[i]:.0f}-{rates.azimuth_deg[i + 1]:.0f}°"
            (line,) = axes.plot(LEVELS, row, marker="o", label=label)
            if np.sum(counts.looks[i]):
                axes.fill_between(LEVELS, low[i], high[i], color=line.get_color(), alpha=0.12, lw=0)
        axes.plot(LEVELS, counts.clutter_rates, color="grey", linestyle=":", label="clutter")
        axes.set(title=name, xlabel="degradation $d$", ylim=(0.0, 1.0))
    figure.axes[0].set_ylabel(r"miss rate $\beta(\theta, d)$")
    figure.axes[0].legend(fontsize="small")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150, format=path.suffix.lstrip(".") or "png")
