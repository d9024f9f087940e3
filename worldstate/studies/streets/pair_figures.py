"""Figures of two sets of windows: how far they are from each other, and what one teaches of the other."""

import numpy as np

from worldstate.adapters.datasets.feature_table import FeatureTable

from .measures import CLASS_GROUPS, DESCRIPTORS, TYPES, describe_windows, of_class
from .set_figures import LEAST_WINDOWS, FigureKey
from .transfer import published_transfer
from .two_sample import measure_areas, two_sample_areas

# Real junctions of one type agree with one another within this in 18 to 24 of 30 rows.
TOLERANCE = 0.15


def pair_figures(
    one: FeatureTable, other: FeatureTable, rng: np.random.Generator
) -> tuple[dict[FigureKey, float], ...]:
    """Return the figures of `one` beside `other`, by both orders: trained on `one`, trained on `other`."""
    both: dict[FigureKey, float] = {
        ("C2ST", windows): area for windows, area in two_sample_areas(one, other, rng).items()
    }
    both |= {
        (f"AUROC of {name}", windows): area for (name, windows), area in measure_areas(one, other).items()
    }
    ordered = ((one, other), (other, one))
    return tuple(both | _taught(train, test, rng) | _agreeing(train, test) for train, test in ordered)


def _taught(train: FeatureTable, test: FeatureTable, rng: np.random.Generator) -> dict[FigureKey, float]:
    if not all(table.hazards.any() and table.hazard_free.any() for table in (train, test)):
        return {}
    found = published_transfer(train, test, rng)
    return {("transfer", "hidden, none"): found.auroc, ("loudest direction", "hidden, none"): found.scalar}


def _agreeing(one: FeatureTable, other: FeatureTable) -> dict[FigureKey, float]:
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
