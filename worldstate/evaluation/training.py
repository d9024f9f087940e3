"""Training of a model: classifier on all windows, thresholds and risk maps on out-of-fold scores."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from worldstate.abduction.cueing import CueingPolicies, CueingPolicy
from worldstate.abduction.signature import SignatureModel, hazard_statistic
from worldstate.abduction.signature_training import PublishedClassifier
from worldstate.adapters.feature_table import FeatureTable, Group
from worldstate.adapters.model_file import Model, Provenance

from .calibration import ABSENT_MISS_RATE, MISS_RATES, PUBLISHED_MISS_RATE, calibrate_windows
from .features import out_of_fold
from .metrics import auroc
from .splits import N_FOLDS, recording_folds

ALPHAS = (0.01, 0.02, 0.05)
CLASSIFIER = "standardise, linear SVC C=1, left/right mirroring, sigmoid per pair, pairwise coupling"

Numbers = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """How a model is trained.

    Parameters
    ----------
    seed : int
        Of the generator that draws all folds.
    repeats : int
        Cross-validations whose out-of-fold scores are pooled: gamma(alpha) then depends less on the folds.
    sustain_hops : int
        k of the sustained rule. Single windows cannot tell it; the threshold keeps its budget at any k.
    alphas : tuple of float
        Budgets.

    Examples
    --------
    >>> TrainingSettings(seed=3).sustain_hops
    3
    """

    seed: int = 0
    repeats: int = 5
    sustain_hops: int = 3
    alphas: tuple[float, ...] = ALPHAS

    @property
    def steps(self) -> int:
        """How often progress is reported."""
        return self.repeats + 1


def train_model(
    table: FeatureTable,
    settings: TrainingSettings,
    *,
    dataset: str,
    group: Group,
    excluded_lists: Sequence[str] = (),
    on_step: Callable[[], None] = lambda: None,
) -> Model:
    """Train the published classifier and calibrate its cueing.

    Parameters
    ----------
    table : FeatureTable
        Windows; those to be left out are left out already.
    settings : TrainingSettings
        Seed, repeats, sustained rule, budgets.
    dataset, group, excluded_lists : str, str, sequence of str
        For the provenance.
    on_step : callable
        Called after each cross-validation and after the last fit.

    Raises
    ------
    InvalidArgumentError
        If a class is missing or there are fewer recordings than folds.
    """
    rng = np.random.default_rng(settings.seed)
    passes = []
    for _ in range(settings.repeats):
        passes.append(out_of_fold(table, recording_folds(table, rng), PublishedClassifier, rng))
        on_step()
    signature = PublishedClassifier(rng).fit(table.features, table.labels).model_
    on_step()
    provenance = Provenance(
        dataset=dataset,
        group=group,
        classifier=CLASSIFIER,
        scikit_learn=version("scikit-learn"),
        seed=settings.seed,
        training_recordings=tuple(np.unique(table.recording_keys).tolist()),
        excluded_lists=tuple(excluded_lists),
        figures=_figures(table, signature, passes),
    )
    return Model(signature, _policies(table, signature, passes, settings), provenance)


def _policies(
    table: FeatureTable, signature: SignatureModel, passes: list[Numbers], settings: TrainingSettings
) -> CueingPolicies:
    pooled = np.concatenate(passes)
    hazards, hazard_free = (np.tile(flags, len(passes)) for flags in (table.hazards, table.hazard_free))
    policies = []
    for miss_rate in sorted(MISS_RATES):
        for alpha in settings.alphas:
            learned = calibrate_windows(pooled, hazards, hazard_free, alpha=alpha, miss_rate=miss_rate)
            policy = CueingPolicy(
                gamma=learned.gamma,
                sustain_hops=settings.sustain_hops,
                alpha=alpha,
                reference_prior=signature.reference_prior,
                risk_map=learned.risk_map,
                miss_rate=miss_rate,
            )
            policies.append(policy)
    return CueingPolicies(tuple(policies))


def _figures(table: FeatureTable, signature: SignatureModel, passes: list[Numbers]) -> dict[str, float]:
    """Out-of-fold figures, mean over the repeats."""
    scored = table.hazards | table.hazard_free
    classes = np.array(signature.classes)
    correct = [np.mean(classes[one.argmax(axis=1)] == table.labels) for one in passes]
    areas = {
        miss_rate: [auroc(hazard_statistic(one[scored], miss_rate), table.hazards[scored]) for one in passes]
        for miss_rate in (PUBLISHED_MISS_RATE, ABSENT_MISS_RATE)
    }
    return {
        "cv_folds": float(N_FOLDS),
        "cv_repeats": float(len(passes)),
        "accuracy": float(np.mean(correct)),
        "auroc_pooled": float(np.mean([area for area in areas[PUBLISHED_MISS_RATE] if area is not None])),
        "auroc_pooled_absent": float(np.mean([area for area in areas[ABSENT_MISS_RATE] if area is not None])),
    }
