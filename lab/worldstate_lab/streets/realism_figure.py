"""The figure of the comparison: each measure by junction, real beside simulated, and the side."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.ground.typing import FloatArray
from worldstate.operations.figure_style import BLUE, RED, figure_file

from .realism import Realism
from .set_classifiers import FAR_AZIMUTHS_DEG
from .window_measures import CLASS_GROUPS, MEASURES, describe_windows, of_class

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LABELS = {
    "width_deg": "width (deg)",
    "position_deg": "position of the peak (deg)",
    "prominence": "prominence",
}
COLOURS = {"real": BLUE, "simulated": RED}


def write_realism_figure(
    path: Path, real: FeatureTable, simulated: Mapping[str, FeatureTable], found: Realism
) -> None:
    """Draw a panel for each measure and class, and one for each half of the window with the odd profiles."""
    sites = sorted(set(real.environments.tolist()))
    tables = {"real": [real], "simulated": list(simulated.values())}
    with figure_file(path, 12.0, 2.2 * (len(MEASURES) + 1)) as figure:
        rows = figure.subplots(len(MEASURES) + 1, len(CLASS_GROUPS), squeeze=False)
        for row, name in zip(rows, MEASURES, strict=False):
            for axes, windows in zip(row, CLASS_GROUPS, strict=True):
                _draw_measure(axes, tables, sites, name, windows)
        for axes, windows in zip(rows[0], CLASS_GROUPS, strict=True):
            axes.set_title(f"{windows} windows")
        for half, axes in enumerate(rows[-1][:2]):
            _draw_profiles(axes, found, half)
        _draw_key(rows[-1][2])


def _draw_measure(
    axes: "Axes", tables: Mapping[str, list[FeatureTable]], sites: list[str], name: str, windows: str
) -> None:
    """Draw the middle 90 and 50 % and the median at each junction."""
    # All simulated sets together: one of ten windows a side and site would show its draws.
    for place, site in enumerate(sites):
        for shift, (origin, some) in zip((0.18, -0.18), tables.items(), strict=True):
            values = [_values(table, site, windows, name) for table in some]
            if sum(map(len, values)):
                low, left, middle, right, high = np.percentile(np.concatenate(values), (5, 25, 50, 75, 95))
                height = len(sites) - place + shift
                axes.plot([low, high], [height] * 2, color=COLOURS[origin], linewidth=1.0)
                axes.plot([left, right], [height] * 2, color=COLOURS[origin], linewidth=4.0, alpha=0.5)
                axes.plot(middle, height, "o", color=COLOURS[origin], markersize=4.0)
    axes.set(yticks=range(len(sites), 0, -1), yticklabels=sites, xlabel=LABELS.get(name, name))
    if not name.endswith("deg"):
        # A factor of loudness is the same length everywhere.
        axes.set_xscale("log")
        axes.minorticks_off()
        axes.xaxis.set_major_formatter("{x:.3g}")
        axes.set_xticks(_ticks(axes))


def _ticks(axes: "Axes") -> FloatArray:
    """Return four ticks of two digits, evenly spaced in the logarithm; decades would be one or none."""
    low, high = axes.get_xlim()
    return np.array([float(f"{value:.1e}") for value in np.geomspace(low, high, 6)[1:-1]])


def _values(table: FeatureTable, site: str, windows: str, name: str) -> FloatArray:
    chosen = of_class(table, windows) & (table.environments == site)
    return describe_windows(table.features[chosen])[name] if chosen.any() else np.zeros(0)


def _draw_profiles(axes: "Axes", found: Realism, half: int) -> None:
    for origin, by_site in found.profiles.items():
        colour = COLOURS["real" if origin == "real" else "simulated"]
        for profile in by_site.values():
            axes.plot(FAR_AZIMUTHS_DEG, profile[half], color=colour, linewidth=1.0, alpha=0.7)
    axes.axhline(0.0, color="grey", linewidth=0.8)
    axes.set(xlabel="azimuth (deg)", ylabel="far side louder (log)")
    axes.set_title(f"half {half + 1} of the window")


def _draw_key(axes: "Axes") -> None:
    for origin, colour in COLOURS.items():
        axes.plot([], [], "o-", color=colour, label=origin)
    axes.axis("off")
    axes.legend(loc="center", title="median, middle 50 and 90 % of windows;\na line a junction below")
