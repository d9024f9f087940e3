"""References for the comparison of windows: curated windows of their site, or an earlier stream."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from worldstate.abduction.signature.ensemble import EnsembleModel, log_levels, site_reference
from worldstate.abduction.signature.ensemble_training import OTHER_SIDE, SIMULATED_WEIGHT, SimulatedWindows
from worldstate.abduction.signature.site_estimate import SiteEstimate, SiteEstimateSettings
from worldstate.adapters.datasets.feature_table import N_FEATURES, FeatureTable
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray

# Number of windows in a stream, and share of them with a hazard, for the first ten seconds at a street.
STREAM_WINDOWS = 10
STREAM_HAZARDS = 0.05
# Thresholds are set on this many random streams, so that gamma depends less on the windows of one street.
STREAMS = 5
_WINDOW_S = 1.0


def with_site_references(table: FeatureTable) -> FeatureTable:
    """Append to each window the reference of its junction from the other recordings; labels are not used.

    Shapes: table (n, 60), returns (n, 240).
    """
    levels = log_levels(table.features)
    references = np.empty((len(table), 3 * levels.shape[1]))
    for mine, others in _recordings(table):
        references[mine] = site_reference(levels[others])
    return replace(table, features=np.hstack([table.features, references]))


def simulated_beside(tables: Sequence[FeatureTable]) -> SimulatedWindows:
    """Return simulated windows for the ensemble: those of each table, compared with their own site."""
    parts = []
    for part in map(with_site_references, tables):
        weights, other_side = (np.full(len(part), value) for value in (SIMULATED_WEIGHT, OTHER_SIDE))
        parts.append(SimulatedWindows(part.features, part.labels, part.environments, weights, other_side))
    return SimulatedWindows.joined(parts)


def asked_while_listening(
    table: FeatureTable, rng: np.random.Generator
) -> Callable[[EnsembleModel, BoolArray], FloatArray]:
    """Return a function for the posteriors of rows, with references from a random stream before each.

    Shapes: table (n, 60 or more); only the first 60 features of a window are used.
    """
    windows = table.features[:, :N_FEATURES]
    learned = learned_while_listening(replace(table, features=windows), rng)

    def posteriors(model: EnsembleModel, rows: BoolArray) -> FloatArray:
        references = [learned[row].reference(model) for row in np.flatnonzero(rows)]
        return model.explain(np.hstack([windows[rows], references]))

    return posteriors


def learned_while_listening(
    table: FeatureTable, rng: np.random.Generator, *, or_nothing: bool = False
) -> list[SiteEstimate]:
    """Return for each window the site estimate of its junction from a random stream before it.

    If no other recording has an empty window, an error is raised, or with `or_nothing` the initial estimate
    is returned.

    Shapes: table (n, 60).
    """
    # Labels select the windows of the street, one in twenty of them with a hazard. The estimate does not use
    # labels, and neither the windows nor the label of the scored recording influence its stream.
    settings, start = SiteEstimateSettings(), SiteEstimate.start(table.features.shape[1])
    learned = [start] * len(table)
    for mine, others in _recordings(table):
        estimate = start
        if or_nothing and not (others & table.hazard_free).any():
            continue
        for row in _stream(table, others, rng):
            estimate = estimate.updated(table.features[row], _WINDOW_S, settings)
        for row in np.flatnonzero(mine):
            learned[row] = estimate
    return learned


def _stream(table: FeatureTable, others: BoolArray, rng: np.random.Generator) -> IndexArray:
    hazards, empty = (np.flatnonzero(others & flags) for flags in (table.hazards, table.hazard_free))
    if not empty.size:
        site = table.environments[others][0]
        raise InvalidArgumentError(f"{site}: expected hazard-free windows to compose a stream of, got none")
    kind, which = rng.random((2, STREAM_WINDOWS))
    comes = (kind < STREAM_HAZARDS) & bool(hazards.size)
    # Hazards first, so that a number in [0, 1) selects one of each kind.
    rows = np.concatenate([hazards, empty])
    picked = np.where(comes, which * hazards.size, hazards.size + which * empty.size)
    return np.asarray(rows[picked.astype(np.intp)])


def _recordings(table: FeatureTable) -> list[tuple[BoolArray, BoolArray]]:
    """Return the windows of each recording, and those of the other recordings of its junction."""
    keys, parts = table.recording_keys, []
    for key in np.unique(keys):
        mine = keys == key
        others = (table.environments == table.environments[mine][0]) & ~mine
        if not others.any():
            expected = "another recording of its junction for comparison"
            raise InvalidArgumentError(f"recording {key}: expected {expected}")
        parts.append((mine, others))
    return parts
