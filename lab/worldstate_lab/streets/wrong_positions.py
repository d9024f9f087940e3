"""How much worse classifiers rank when the microphones are not where the features take them to be.

A classifier that ranks as well with permuted positions takes the level for the direction.
"""

import numpy as np

from worldstate.abduction.signature.ensemble import explain
from worldstate.abduction.signature.window_classes import hazard_statistic
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.adapters.files.model_file import read_model
from worldstate.ground.typing import FloatArray
from worldstate.operations.training.folds import folds_by_recording

from .set_figures import FigureKey
from .transfer import area_of, trained_score


def position_figures(
    real: FeatureTable, right: FeatureTable, permuted: FeatureTable, rng: np.random.Generator
) -> dict[FigureKey, float]:
    """Return the areas of hidden above empty windows with right and permuted positions, and their difference.

    By the published classifier trained on the real windows, by the same trained on the right ones of other
    recordings, and by the model that ships.
    """
    both = np.concatenate([right.features, permuted.features])
    scores = {
        "published, of real": trained_score(real, rng, both),
        "published, of simulated": _out_of_fold(right, permuted, rng),
        "shipped model": hazard_statistic(explain(read_model().signature, both), miss_rate=0.0),
    }
    found: dict[FigureKey, float] = {}
    for name, score in scores.items():
        here, there = (area_of(one, right) for one in np.split(score, 2))
        named = {"right": here, "permuted": there, "loss by permuted": here - there}
        found |= {(f"{how} positions: {name}", "hidden, none"): area for how, area in named.items()}
    return found


def _out_of_fold(right: FeatureTable, permuted: FeatureTable, rng: np.random.Generator) -> FloatArray:
    # Trained with the right positions alone; other recordings, or it would know the windows themselves.
    folds = folds_by_recording(right, rng)
    scores = np.empty((2, len(right)))
    for held_out in np.unique(folds):
        test = folds == held_out
        asked = np.concatenate([table.features[test] for table in (right, permuted)])
        scores[:, test] = trained_score(right.select(~test), rng, asked).reshape(2, -1)
    return scores.ravel()
