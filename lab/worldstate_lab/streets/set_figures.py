"""Figures of one set of windows: medians, spreads, and what of them belongs to the site."""

import numpy as np

from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.ground.typing import FloatArray, TextArray
from worldstate.operations.metrics.roc import auroc

from .measures import AZIMUTHS_DEG, CLASS_GROUPS, SEGMENTS, describe_windows, of_class, spread_values

# (what is told, class of windows); the class is "all" where it is of several.
FigureKey = tuple[str, str]
# Where images in the side walls of the ego's own street stand: 89 % of the real hidden peaks.
WIDE_DEG = (40.0, 65.0)
# Spreads and shares of fewer windows are chance.
LEAST_WINDOWS = 5


def set_figures(table: FeatureTable) -> dict[FigureKey, float]:
    """Return every figure that one set of windows has by itself."""
    figures: dict[FigureKey, float] = {}
    for windows in CLASS_GROUPS:
        chosen = table.select(of_class(table, windows))
        if len(chosen) >= LEAST_WINDOWS:
            named = _spreads(chosen.features) | _site_shares(chosen)
            figures |= {(name, windows): value for name, value in named.items()}
    hidden = table.select(table.hazards)
    if len(hidden) >= LEAST_WINDOWS:
        figures |= {(name, "hidden"): value for name, value in _hidden_peaks(hidden).items()}
    area = second_half_area(table)
    return figures if area is None else figures | {("area of the second half's peak", "hidden, none"): area}


def second_half_area(table: FeatureTable) -> float | None:
    """Return how well the peak of the second half alone ranks hidden above empty windows."""
    rows = table.hazards | table.hazard_free
    peaks = table.features.reshape(len(table), SEGMENTS, -1)[rows, -1].max(axis=1)
    return auroc(peaks, table.hazards[rows])


def _spreads(features: FloatArray) -> dict[str, float]:
    named = {f"median of {name}": np.median(values) for name, values in describe_windows(features).items()}
    for name, values in spread_values(features).items():
        said = name if name.endswith("deg") else f"log {name}"
        low, high = np.percentile(values, (25.0, 75.0))
        named |= {f"sd of {said}": values.std(), f"iqr of {said}": high - low}
    return {name: float(value) for name, value in named.items()}


def _site_shares(table: FeatureTable) -> dict[str, float]:
    levels = np.log(table.features)
    mean = levels.mean(axis=1, keepdims=True)
    pattern = levels - mean
    return {
        "sd of pattern": float(np.sqrt(pattern.var(axis=0).mean())),
        "between-site share of pattern": between_share(pattern, table.environments),
        "between-site share of level": between_share(mean, table.environments),
    }


def between_share(values: FloatArray, sites: TextArray) -> float:
    r"""Return the share of the variance that lies between the means of sites, summed over columns.

    .. math:: \frac{\sum_s n_s \| \bar x_s - \bar x \|^2}{\sum_i \| x_i - \bar x \|^2}

    Shapes: values (n, columns), sites (n,).

    Examples
    --------
    >>> between_share(np.array([[0.0], [0.0], [1.0], [1.0]]), np.array(["SA1", "SA1", "SB1", "SB1"]))
    1.0
    """
    centred = values - values.mean(axis=0)
    means = [(np.sum(sites == site), centred[sites == site].mean(axis=0)) for site in np.unique(sites)]
    between = sum(count * float(mean @ mean) for count, mean in means)
    return float(between / (centred**2).sum())


def _hidden_peaks(hidden: FeatureTable) -> dict[str, float]:
    """Return how many peaks stand wide, and how many on the vehicle's own side."""
    spectrum = hidden.features.reshape(len(hidden), SEGMENTS, -1).mean(axis=1)
    azimuth = AZIMUTHS_DEG[spectrum.argmax(axis=1)]
    aside = np.abs(azimuth)
    return {
        "share of peaks at 40 to 65 deg": float(((aside >= WIDE_DEG[0]) & (aside <= WIDE_DEG[1])).mean()),
        "share of peaks on the own side": float(((azimuth > 0.0) == (hidden.labels == "right")).mean()),
    }
