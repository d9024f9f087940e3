"""A window model of six classes from real windows, simulated ones, streams and sources in the open."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.abduction.signature.ensemble_training import SimulatedWindows
from worldstate.abduction.signature.site_estimate import SiteEstimate, SiteEstimateSettings
from worldstate.abduction.signature.site_reference import log_levels
from worldstate.abduction.signature.site_signature import HOP_S
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.ground.typing import FloatArray
from worldstate.operations.training.site_references import simulated_beside, with_site_references
from worldstate.operations.training.training import fit_ensemble

from .heard_stream import HeardStream
from .stream_windows import stream_windows


def learned_beside(
    streams: Sequence[HeardStream], open_field: SimulatedWindows, tables: Sequence[FeatureTable] = ()
) -> SimulatedWindows:
    """Return windows of streams, of sources in the open and of simulated recordings together."""
    recordings = [simulated_beside(tables)] if tables else []
    return SimulatedWindows.joined([*recordings, stream_windows(streams), open_field])


def window_model(
    table: FeatureTable, beside: SimulatedWindows | None, leave_out: Collection[str] = ()
) -> EnsembleModel:
    """Fit a window model without the real and the simulated windows of some sites."""
    rest = table.select(~np.isin(table.environments, list(leave_out)))
    return replace(fit_ensemble(with_site_references(rest), beside), domain=table.domain)


def posteriors_along(
    model: EnsembleModel, features: FloatArray, settings: SiteEstimateSettings | None = None
) -> FloatArray:
    """Return what `SiteSignature` finds hop by hop along a stream, as posteriors, shape (n, classes).

    Shapes: features (n, 60).
    """
    chosen, estimate = settings or SiteEstimateSettings(), SiteEstimate.start(model.n_features)
    references = np.empty((len(features), model.home.row.size))
    for row, feature in enumerate(np.asarray(features, np.float64)):
        references[row] = estimate.reference(model, chosen).row
        estimate = estimate.updated(feature, HOP_S, chosen)
    return model.posteriors(log_levels(features), references)
