"""Evaluation of a finished model, refused on recordings that it was trained on."""

import numpy as np

from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.adapters.files.acoustic_domain import check_tables, ovad_domain
from worldstate.adapters.files.model_file import Model
from worldstate.ground.errors import InvalidArgumentError
from worldstate.operations.training.window_calibration import MISS_RATES, WindowCalibration

from .feature_evaluation import Predictions, Reference, asked_under


def predict_held_out(
    model: Model, table: FeatureTable, alpha: float, reference: Reference, rng: np.random.Generator
) -> dict[float, Predictions]:
    """Predict windows of recordings that a model never saw, for each beta as `cross_validate` does."""
    if model.domain is not None:
        # A table that does not say, as the released one, is OVAD's.
        check_tables(model.domain, table.domain or ovad_domain(table.environments.tolist()))
    check_unseen(model, table)
    if isinstance(model.signature, EnsembleModel):
        ask = asked_under(reference, table, rng)
        probabilities = ask(model.signature, np.ones(len(table), dtype=np.bool_))
    else:
        probabilities = model.signature.predict_proba(table.features)
    predictions = {}
    for miss_rate in MISS_RATES:
        policy = model.policies.for_alpha(alpha, miss_rate)
        calibration = WindowCalibration(miss_rate, policy.gamma, policy.risk_map)
        predictions[miss_rate] = Predictions.of_model(probabilities, calibration)
    return predictions


def check_unseen(model: Model, table: FeatureTable) -> None:
    """Refuse a table that shares recordings with the training set of a model."""
    recordings = set(np.unique(table.recording_keys).tolist())
    seen = recordings & set(model.provenance.training_recordings)
    if seen:
        raise InvalidArgumentError(
            f"model: trained on {len(seen)} of these {len(recordings)} recordings; expected none. "
            "Train with --exclude IDS and evaluate with --only IDS"
        )
