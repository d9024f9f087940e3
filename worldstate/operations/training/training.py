"""Training of a model: classifier on all windows, thresholds and risk maps on out-of-fold scores."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Literal

import numpy as np

from worldstate.abduction.cueing.cueing_policy import CueingPolicies, CueingPolicy
from worldstate.abduction.signature.ensemble import AnySignature
from worldstate.abduction.signature.ensemble_training import RECIPES, SimulatedWindows, SiteEnsembleClassifier
from worldstate.abduction.signature.model_domain import ModelDomain
from worldstate.abduction.signature.published_training import PublishedClassifier
from worldstate.abduction.signature.window_classes import CLASSES, hazard_statistic
from worldstate.adapters.datasets.feature_table import FeatureTable, Group
from worldstate.adapters.files.acoustic_domain import ego_motion_of
from worldstate.adapters.files.model_file import Model, Provenance
from worldstate.ground.extras import check_extra
from worldstate.ground.typing import FloatArray
from worldstate.operations.metrics.roc import auroc

from .feature_evaluation import out_of_fold
from .methods import WindowMethod, method_of
from .splits import N_FOLDS, folds_by_recording, junction_folds
from .window_calibration import (
    ABSENT_MISS_RATE,
    MISS_RATES,
    PUBLISHED_MISS_RATE,
    WindowCalibration,
    between,
    calibrate_windows,
)

ALPHAS = (0.01, 0.02, 0.05)
CLASSIFIER = "standardise, linear SVC C=1, left/right mirroring, sigmoid per pair, pairwise coupling"
ENSEMBLE = "softmax regressions, all classes mirrored: " + ", ".join(f"{r.view} {r.ridge:g}" for r in RECIPES)
TrainingMethod = Literal["baseline", "worldstate"]


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
    method : str
        ``baseline``: as published; ``worldstate``: mirror-symmetric ensemble on windows compared with their
        site, thresholds half-way between recordings left out and junctions left out.

    Examples
    --------
    >>> TrainingSettings(seed=3).sustain_hops
    3
    """

    seed: int = 0
    repeats: int = 5
    sustain_hops: int = 3
    alphas: tuple[float, ...] = ALPHAS
    method: TrainingMethod = "baseline"

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
    simulated: SimulatedWindows | None = None,
    on_step: Callable[[], None] = lambda: None,
) -> Model:
    """Train a classifier and calibrate its cueing.

    Parameters
    ----------
    table : FeatureTable
        Windows; those to be left out are left out already.
    settings : TrainingSettings
        Seed, repeats, sustained rule, budgets.
    dataset, group, excluded_lists : str, str, sequence of str
        For the provenance.
    simulated : SimulatedWindows, optional
        Learned by the ensemble beside the table.
    on_step : callable
        Called after each cross-validation and after the last fit.

    Returns
    -------
    Model
        Signature, policies and provenance.

    Raises
    ------
    MissingExtraError
        If scikit-learn is not installed.
    InvalidArgumentError
        If a class is missing or there are fewer recordings than folds.

    Examples
    --------
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> labels = np.repeat(["left", "none", "right", "front"], 20)
    >>> keys = np.array([str(i) for i in range(80)])
    >>> loud = np.where(labels == "none", 0.1, 0.2)[:, None]
    >>> features = loud * rng.lognormal(0.0, 0.2, (80, 60))
    >>> table = FeatureTable(features, labels, keys, np.tile(["SA1", "SB1"], 40), keys, (None,) * 80)
    >>> model = train_model(table, TrainingSettings(repeats=1), dataset="made up", group="static")
    >>> model.signature.classes, model.provenance.dataset
    (('front', 'left', 'none', 'right'), 'made up')
    """
    check_extra("sklearn")
    rng = np.random.default_rng(settings.seed)
    method = method_of(settings.method, simulated)
    inputs = method.prepare(table)
    levels = _out_of_fold_levels(inputs, method, settings, rng, on_step)
    signature = replace(fit_signature(inputs, settings.method, rng, simulated), domain=_domain(table))
    on_step()
    provenance = Provenance(
        dataset=dataset,
        group=group,
        classifier=_classifier(settings.method, simulated),
        scikit_learn=version("scikit-learn"),
        seed=settings.seed,
        training_recordings=tuple(np.unique(table.recording_keys).tolist()),
        excluded_lists=tuple(excluded_lists),
        figures=_figures(table, signature, levels[-1]),
    )
    return Model(signature, _policies(table, signature, levels, settings), provenance)


def _classifier(method: TrainingMethod, simulated: SimulatedWindows | None) -> str:
    if method != "worldstate":
        return CLASSIFIER
    if simulated is None:
        return ENSEMBLE
    names, counts = np.unique(simulated.y, return_counts=True)
    told = ", ".join(f"{count} {name}" for name, count in zip(names.tolist(), counts.tolist(), strict=True))
    return f"{ENSEMBLE}; {len(simulated.y)} simulated windows too: {told}"


def _out_of_fold_levels(
    inputs: FeatureTable,
    method: WindowMethod,
    settings: TrainingSettings,
    rng: np.random.Generator,
    on_step: Callable[[], None],
) -> list[list[FloatArray]]:
    """Posteriors of windows not trained on, from the most careful folds to the boldest: see `between`."""
    passes, make, asking = [], method.make, method.inner_asking
    for _ in range(settings.repeats):
        passes.append(out_of_fold(inputs, folds_by_recording(inputs, rng), make, rng, asking))
        on_step()
    if settings.method != "worldstate" or len(np.unique(inputs.environments)) < 2:
        return [passes]
    return [[out_of_fold(inputs, junction_folds(inputs), make, rng, asking)], passes]


def _domain(table: FeatureTable) -> ModelDomain | None:
    """Return what the table says, the ego's motion of the windows that are left in it."""
    if table.domain is None:
        return None
    return replace(table.domain, ego_motion=ego_motion_of(np.unique(table.environments).tolist()))


def fit_signature(
    inputs: FeatureTable,
    method: TrainingMethod,
    rng: np.random.Generator,
    simulated: SimulatedWindows | None = None,
) -> AnySignature:
    """Fit the classifier of a method."""
    if method == "worldstate":
        return (
            SiteEnsembleClassifier(simulated=simulated)
            .fit(inputs.features, inputs.labels, inputs.environments)
            .model_
        )
    return PublishedClassifier(rng).fit(inputs.features, inputs.labels).model_


def _policies(
    table: FeatureTable, signature: AnySignature, levels: list[list[FloatArray]], settings: TrainingSettings
) -> CueingPolicies:
    policies = []
    for miss_rate in sorted(MISS_RATES):
        for alpha in settings.alphas:
            learned = between([_calibrated(table, one, alpha, miss_rate, settings) for one in levels])
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


def _calibrated(
    table: FeatureTable, passes: list[FloatArray], alpha: float, miss_rate: float, settings: TrainingSettings
) -> WindowCalibration:
    hazards, hazard_free = (np.tile(flags, len(passes)) for flags in (table.hazards, table.hazard_free))
    fit_map = method_of(settings.method).fit_map
    pooled = np.concatenate(passes)
    return calibrate_windows(pooled, hazards, hazard_free, alpha=alpha, miss_rate=miss_rate, fit_map=fit_map)


def _figures(table: FeatureTable, signature: AnySignature, passes: list[FloatArray]) -> dict[str, float]:
    """Out-of-fold figures, mean over the repeats."""
    scored = table.hazards | table.hazard_free
    classes = np.array(CLASSES)
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
