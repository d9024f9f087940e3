"""A window model of six classes from real windows, simulated ones, streams and sources in the open."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.abduction.signature.ensemble_training import SimulatedWindows, SiteEnsembleClassifier
from worldstate.abduction.signature.site_estimate import SiteEstimate, SiteEstimateSettings
from worldstate.abduction.signature.site_reference import log_levels
from worldstate.abduction.signature.site_signature import HOP_S
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import FloatArray
from worldstate.operations.training.site_references import simulated_beside, with_site_references

from .heard_stream import HeardStream
from .open_field import N_OPEN, open_field_features, open_field_windows
from .stream_windows import stream_windows


def learned_beside(
    tables: Sequence[FeatureTable],
    streams: Sequence[HeardStream],
    array: MicrophoneArray,
    rng: np.random.Generator,
) -> SimulatedWindows | None:
    """Return all that a window model learns beside real windows; sources in the open only beside streams."""
    parts = [simulated_beside(tables)] if tables else []
    if streams:
        parts += [stream_windows(streams), open_field_windows(open_field_features(array, N_OPEN, rng))]
    return SimulatedWindows.joined(parts) if parts else None


def window_model(
    table: FeatureTable, beside: SimulatedWindows | None, leave_out: Collection[str] = ()
) -> EnsembleModel:
    """Fit a window model without the real and the simulated windows of some sites."""
    rest = table.select(~np.isin(table.environments, list(leave_out)))
    inputs = with_site_references(rest)
    classifier = SiteEnsembleClassifier(simulated=beside)
    model = classifier.fit(inputs.features, inputs.labels, inputs.environments).model_
    return replace(model, domain=table.domain)


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
