"""Training of a model: classifier on all windows, thresholds and risk maps on out-of-fold scores."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from itertools import product

import numpy as np

from worldstate.abduction.cueing.cueing_policy import CueingPolicies, CueingPolicy
from worldstate.abduction.cueing.risk_map import fit_platt
from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.abduction.signature.ensemble_training import RECIPES, SimulatedWindows, SiteEnsembleClassifier
from worldstate.abduction.signature.window_classes import CLASSES, hazard_statistic
from worldstate.adapters.datasets.feature_table import FeatureTable, Group
from worldstate.adapters.files.acoustic_domain import ego_motion_of
from worldstate.adapters.files.model_file import Model, Provenance
from worldstate.ground.extras import check_extra
from worldstate.ground.typing import FloatArray, TextArray
from worldstate.operations.metrics.approach_table import auroc

from .folds import N_FOLDS, folds_by_recording, junction_folds, out_of_fold
from .site_references import asked_while_listening, with_site_references
from .window_calibration import (
    ABSENT_MISS_RATE,
    MISS_RATES,
    PUBLISHED_MISS_RATE,
    WindowCalibration,
    between,
    calibrate_windows,
)

# Budgets.
ALPHAS = (0.01, 0.02, 0.05)
ENSEMBLE = "softmax regressions, all classes mirrored: " + ", ".join(f"{r.view} {r.ridge:g}" for r in RECIPES)


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

    Examples
    --------
    >>> TrainingSettings(seed=3).sustain_hops
    3
    """

    seed: int = 0
    repeats: int = 5
    sustain_hops: int = 3

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
    """Train the ensemble and calibrate its cueing.

    The ensemble is mirror-symmetric and compares windows with their site. Thresholds lie half-way between
    those of recordings left out and of junctions left out.

    Parameters
    ----------
    table : FeatureTable
        Windows; those to be left out are left out already.
    settings : TrainingSettings
        Seed, repeats, sustained rule.
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
    rng, inputs = np.random.default_rng(settings.seed), with_site_references(table)
    fit = partial(fit_ensemble, simulated=simulated)
    levels = _out_of_fold_levels(inputs, fit, settings.repeats, rng, on_step)
    # The ego's motion is that of the windows that are left in the table.
    motion, domain = ego_motion_of(np.unique(table.environments).tolist()), table.domain
    signature = replace(fit(inputs), domain=None if domain is None else replace(domain, ego_motion=motion))
    on_step()
    provenance = Provenance(
        dataset=dataset,
        group=group,
        classifier=_classifier(simulated),
        scikit_learn=version("scikit-learn"),
        seed=settings.seed,
        training_recordings=tuple(np.unique(table.recording_keys).tolist()),
        excluded_lists=tuple(excluded_lists),
        figures=_figures(table, levels[-1]),
    )
    return Model(signature, _policies(table, signature, levels, settings), provenance)


def fit_ensemble(inputs: FeatureTable, simulated: SimulatedWindows | None = None) -> EnsembleModel:
    """Fit the ensemble on windows with the references of their sites behind them."""
    classifier = SiteEnsembleClassifier(simulated=simulated)
    return classifier.fit(inputs.features, inputs.labels, inputs.environments).model_


def _classifier(simulated: SimulatedWindows | None) -> str:
    if simulated is None:
        return ENSEMBLE
    names, counts = np.unique(simulated.y, return_counts=True)
    told = ", ".join(f"{count} {name}" for name, count in zip(names.tolist(), counts.tolist(), strict=True))
    return f"{ENSEMBLE}; {len(simulated.y)} simulated windows too: {told}"


def _out_of_fold_levels(
    inputs: FeatureTable,
    fit: Callable[[FeatureTable], EnsembleModel],
    repeats: int,
    rng: np.random.Generator,
    on_step: Callable[[], None],
) -> list[list[FloatArray]]:
    """Posteriors of windows not trained on, from the most careful folds to the boldest: see `between`."""

    def posteriors(folds: TextArray) -> FloatArray:
        # Windows compared as `run` has them: thresholds from curated references gave a standing ego .055 of
        # false positives in place of .030 at TPR .83 for .80, a moving one TPR .44 for .50. A generator of
        # its own: what is drawn to ask moves no fold.
        return out_of_fold(inputs, folds, fit, asked_while_listening(inputs, rng.spawn(1)[0]))

    passes = []
    for _ in range(repeats):
        passes.append(posteriors(folds_by_recording(inputs, rng)))
        on_step()
    if len(np.unique(inputs.environments)) < 2:
        return [passes]
    return [[posteriors(junction_folds(inputs))], passes]


def _policies(
    table: FeatureTable, signature: EnsembleModel, levels: list[list[FloatArray]], settings: TrainingSettings
) -> CueingPolicies:
    hops, prior, policies = settings.sustain_hops, signature.reference_prior, list[CueingPolicy]()
    for miss_rate, alpha in product(sorted(MISS_RATES), ALPHAS):
        learned = between([_calibrated(table, one, alpha, miss_rate) for one in levels])
        policies.append(CueingPolicy(learned.gamma, hops, alpha, prior, learned.risk_map, miss_rate))
    return CueingPolicies(tuple(policies))


def _calibrated(
    table: FeatureTable, passes: list[FloatArray], alpha: float, miss_rate: float
) -> WindowCalibration:
    hazards, hazard_free = (np.tile(flags, len(passes)) for flags in (table.hazards, table.hazard_free))
    pooled = np.concatenate(passes)
    return calibrate_windows(
        pooled, hazards, hazard_free, alpha=alpha, miss_rate=miss_rate, fit_map=fit_platt
    )


def _figures(table: FeatureTable, passes: list[FloatArray]) -> dict[str, float]:
    """Out-of-fold figures, mean over the repeats."""
    scored, classes = table.hazards | table.hazard_free, np.array(CLASSES)

    def area(miss_rate: float) -> float:
        areas = [auroc(hazard_statistic(one[scored], miss_rate), table.hazards[scored]) for one in passes]
        return float(np.mean([one for one in areas if one is not None]))

    return {
        "cv_folds": float(N_FOLDS),
        "cv_repeats": float(len(passes)),
        "accuracy": float(np.mean([np.mean(classes[one.argmax(axis=1)] == table.labels) for one in passes])),
        "auroc_pooled": area(PUBLISHED_MISS_RATE),
        "auroc_pooled_absent": area(ABSENT_MISS_RATE),
    }
