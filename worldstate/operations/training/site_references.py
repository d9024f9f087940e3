"""What windows are compared with: curated windows of their site, or a stream heard before."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from worldstate.abduction.signature.ensemble import EnsembleModel, log_levels, site_reference
from worldstate.abduction.signature.ensemble_training import OTHER_SIDE, SIMULATED_WEIGHT, SimulatedWindows
from worldstate.abduction.signature.site_estimate import SiteEstimate, SiteEstimateSettings
from worldstate.adapters.datasets.feature_table import N_FEATURES, FeatureTable
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray

# What a vehicle has heard of a street after its first ten seconds: nearly always an empty street.
STREAM_WINDOWS = 10
STREAM_HAZARDS = 0.05
# Thresholds are set on so many drawn streams: gamma then depends less on which windows one street is made of.
STREAMS = 5
_WINDOW_S = 1.0


def with_site_references(table: FeatureTable) -> FeatureTable:
    """Append to each window the reference of its junction, from its other recordings; no label is looked at.

    Shapes: table (n, 60), returns (n, 240).
    """
    levels = log_levels(table.features)
    references = np.empty((len(table), 3 * levels.shape[1]))
    for mine, others in _recordings(table):
        references[mine] = site_reference(levels[others])
    return replace(table, features=np.hstack([table.features, references]))


def simulated_beside(tables: Sequence[FeatureTable]) -> SimulatedWindows:
    """Return simulated windows as the ensemble learns them: those of a table compared with its own."""
    parts = []
    for part in map(with_site_references, tables):
        weights, other_side = (np.full(len(part), value) for value in (SIMULATED_WEIGHT, OTHER_SIDE))
        parts.append(SimulatedWindows(part.features, part.labels, part.environments, weights, other_side))
    return SimulatedWindows.joined(parts)


def asked_while_listening(
    table: FeatureTable, rng: np.random.Generator
) -> Callable[[EnsembleModel, BoolArray], FloatArray]:
    """Return posteriors of rows by a model that compares them with what `run` has learned before them.

    Shapes: table (n, 60 or more): what is behind the first 60 features of a window is not looked at.
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
    """Return for each window what `run` has learned of its junction from a stream before it.

    Where no other recording has an empty window that is an error, or with `or_nothing` nothing was heard.

    Shapes: table (n, 60).
    """
    # Labels compose the street, a twentieth of it hazards; the estimate sees none, and nothing of the
    # recording that is scored: neither its windows nor its label move what is drawn for it.
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
    # Hazards first, so that a number in [0, 1) picks one of either.
    rows = np.concatenate([hazards, empty])
    picked = np.where(comes, which * hazards.size, hazards.size + which * empty.size)
    return np.asarray(rows[picked.astype(np.intp)])


def _recordings(table: FeatureTable) -> list[tuple[BoolArray, BoolArray]]:
    """Windows of each recording, and those of the other recordings of its junction."""
    keys, parts = table.recording_keys, []
    for key in np.unique(keys):
        mine = keys == key
        others = (table.environments == table.environments[mine][0]) & ~mine
        if not others.any():
            expected = "another recording of its junction, to compare it with"
            raise InvalidArgumentError(f"recording {key}: expected {expected}")
        parts.append((mine, others))
    return parts
