"""Figures of two sets of windows: how far they are from each other, and how many of their medians agree."""

import numpy as np

from worldstate.adapters.datasets.feature_table import FeatureTable

from .measures import CLASS_GROUPS, DESCRIPTORS, TYPES, describe_windows, of_class
from .set_figures import LEAST_WINDOWS, FigureKey
from .two_sample import measure_areas, two_sample_areas

# Real junctions of one type agree with one another within this in 18 to 24 of 30 rows.
TOLERANCE = 0.15


def distance_figures(
    one: FeatureTable, other: FeatureTable, rng: np.random.Generator | None
) -> dict[FigureKey, float]:
    """Return what tells two sets apart: C2ST, where there is a generator, and the area of each measure."""
    boosted = {} if rng is None else two_sample_areas(one, other, rng)
    areas = {("C2ST", windows): area for windows, area in boosted.items()}
    single = measure_areas(one, other)
    return areas | {(f"AUROC of {name}", windows): area for (name, windows), area in single.items()}


def agreeing_medians(one: FeatureTable, other: FeatureTable) -> dict[FigureKey, float]:
    """Return the share of medians of `other` that are within 15 % of those of `one`."""
    rows = median_rows(one, other)
    agree = [abs(there - here) <= TOLERANCE * abs(here) for here, there in rows.values()]
    return {("share of medians within 15 %", "all"): float(np.mean(agree))} if agree else {}


def median_rows(one: FeatureTable, other: FeatureTable) -> dict[FigureKey, tuple[float, float]]:
    """Return the medians of both sets by type of junction and class."""
    rows: dict[FigureKey, tuple[float, float]] = {}
    for junctions, prefix in TYPES.items():
        pair = [table.select(np.char.startswith(table.environments, prefix)) for table in (one, other)]
        for windows in CLASS_GROUPS:
            chosen = [table.features[of_class(table, windows)] for table in pair]
            if min(map(len, chosen)) >= LEAST_WINDOWS:
                here, there = map(describe_windows, chosen)
                for name in DESCRIPTORS:
                    middles = float(np.median(here[name])), float(np.median(there[name]))
                    rows[f"median of {name}, type {junctions}", windows] = middles
    return rows
