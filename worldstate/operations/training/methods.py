"""Methods and baselines of an evaluation on feature windows."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import cast

import numpy as np

from worldstate.abduction.cueing.risk_map import fit_isotonic, fit_platt
from worldstate.abduction.signature.ensemble_training import (
    Classifier,
    Recipe,
    SimulatedWindows,
    SiteEnsembleClassifier,
)
from worldstate.abduction.signature.published_training import PublishedClassifier
from worldstate.adapters.datasets.feature_table import N_FEATURES, FeatureTable
from worldstate.ground.typing import BoolArray, FloatArray

from .feature_evaluation import (
    Ask,
    Asking,
    MakeClassifier,
    Predictions,
    asked_plainly,
    cross_validate,
    transfer,
)
from .loudness import LoudestDirection
from .site_references import REFERENCES, Reference, inputs_under, with_site_references
from .splits import Protocol, Split, folds_by_recording, junction_folds, split_for
from .window_calibration import ABSENT_MISS_RATE, PUBLISHED_MISS_RATE, FitMap

Passes = list[dict[float, Predictions]]


@dataclass(frozen=True, slots=True)
class WindowMethod:
    """One way from windows to risk."""

    # From the table as read to the table that the classifier sees.
    prepare: Callable[[FeatureTable], FeatureTable]
    make: MakeClassifier  # Makes an untrained classifier
    fit_map: FitMap  # Fits the risk map
    # Whether the threshold stands between junctions left out and recordings left out, where the protocol
    # leaves out junctions; else threshold and map come from folds like the outer ones.
    two_levels: bool
    # Whether risks are shifted, under `transfer`, until hazards are as frequent as in training.
    match_prevalence: bool = False
    # What the scored windows are compared with, None where the method compares with nothing. Training has the
    # curated windows in any case, as in `train`.
    reference: Reference | None = None
    # How windows are asked for from which threshold and map are learned.
    inner_asking: Asking = asked_plainly


@dataclass(frozen=True, slots=True)
class Row:
    """One row of the comparison: a method and the statistic that is read from it."""

    method: str  # Name in `methods`
    miss_rate: float  # beta of the statistic


def evaluate_pass(
    method: WindowMethod,
    table: FeatureTable,
    protocol: Protocol,
    *,
    seed: int,
    alpha: float,
    train: FeatureTable | None = None,
) -> dict[float, Predictions]:
    """Run one seed of one method."""
    rng, split = np.random.default_rng(seed), split_for(protocol)
    prepared = method.prepare(table)
    inner = _inner_splits(method, protocol)
    ask = None if method.reference is None else _ask_under(method.reference, table, seed)
    if train is None:
        return cross_validate(
            prepared,
            split,
            method.make,
            rng,
            alpha=alpha,
            inner_splits=inner,
            fit_map=method.fit_map,
            ask=ask,
            inner_asking=method.inner_asking,
        )
    learned = method.prepare(train)
    return transfer(
        learned,
        prepared,
        inner,
        method.make,
        rng,
        alpha=alpha,
        fit_map=method.fit_map,
        ask=ask,
        match_prevalence=method.match_prevalence,
    )


def _ask_under(reference: Reference, table: FeatureTable, seed: int) -> Ask:
    # A generator of its own: the folds of a seed are the same under every reference.
    return asked_under(reference, table, np.random.default_rng([seed, 1]))


def asked_under(reference: Reference, table: FeatureTable, rng: np.random.Generator) -> Ask:
    """Ask an ensemble about windows compared with a reference in place of the one behind them, if any."""
    inputs = inputs_under(reference, replace(table, features=table.features[:, :N_FEATURES]), rng)

    def ask(classifier: Classifier, rows: BoolArray) -> FloatArray:
        model = cast(SiteEnsembleClassifier, classifier).model_
        return model.explain(inputs(model, rows))

    return ask


def _inner_splits(method: WindowMethod, protocol: Protocol) -> tuple[Split, ...]:
    split = split_for(protocol)
    return (split, folds_by_recording) if method.two_levels and split is junction_folds else (split,)


def as_read(table: FeatureTable) -> FeatureTable:
    """Return the table as it is."""
    return table


def site_ensemble(rng: np.random.Generator, simulated: SimulatedWindows | None = None) -> Classifier:
    """Make the classifier of the method; it draws nothing."""
    return SiteEnsembleClassifier(simulated=simulated)


def loudest_direction(rng: np.random.Generator) -> Classifier:
    """Make the scalar; it draws nothing."""
    return LoudestDirection()


def distant_site(rng: np.random.Generator) -> Classifier:
    """Make the classifier for a site unlike all of training: the quiet reference alone, hardly held back."""
    # Level, which the ridge favours, is what a moving ego's own noise covers; the pattern above the quietest
    # windows is left. Chosen among some thirty for each moving junction on the other two: thrice the same.
    return SiteEnsembleClassifier((Recipe("quiet", 1e-5),))


def methods(simulated: SimulatedWindows | None = None) -> dict[str, WindowMethod]:
    """Return the methods by name, the ensembles of them trained on simulated windows too."""
    # Thresholds of windows compared as `run` has them: on curated ones a standing ego had .055 of false
    # positives in place of .030 at TPR .83 for .80, a moving one TPR .44 for .50.
    ensemble = WindowMethod(
        with_site_references,
        partial(site_ensemble, simulated=simulated),
        fit_platt,
        two_levels=True,
        inner_asking=partial(asked_under, "run"),
    )
    # The pattern alone, for a moving ego: streets of a standing one cost it (docs/signature.md).
    distant = WindowMethod(
        with_site_references, distant_site, fit_platt, two_levels=False, match_prevalence=True
    )
    return {
        "baseline": WindowMethod(as_read, PublishedClassifier, fit_isotonic, two_levels=False),
        "loudest_direction": WindowMethod(as_read, loudest_direction, fit_isotonic, two_levels=False),
        **{f"ensemble_{one}": replace(ensemble, reference=one) for one in REFERENCES},
        **{f"distant_site_{one}": replace(distant, reference=one) for one in REFERENCES},
    }


# What is read from each method, by the name of its row.
ROWS = {
    "baseline": Row("baseline", PUBLISHED_MISS_RATE),
    "baseline_absent": Row("baseline", ABSENT_MISS_RATE),
    **{name: Row(name, ABSENT_MISS_RATE) for name in methods() if name != "baseline"},
}

# What `worldstate` is: the ensemble where the ego drives as it did in training, one expert where it does not.
# How the ego drives is known to whoever asks, and nothing else decides.
OURS: dict[Protocol, str] = {"cv": "ensemble", "lojo": "ensemble", "transfer": "distant_site"}


def row_of(method: str, protocol: Protocol, reference: Reference) -> str:
    """Return the name in `ROWS` of what a method is under a protocol and a reference."""
    return f"{OURS[protocol]}_{reference}" if method == "worldstate" else method


def rows_beside(row: str, protocol: Protocol, reference: Reference) -> tuple[str, ...]:
    """Return the rows beside one: those to beat, and itself under the other references."""
    if row == "baseline":
        return ()
    others = tuple(row_of("worldstate", protocol, other) for other in REFERENCES if other != reference)
    # Where the ego drives and did not in training, the ensemble is one of those to beat.
    afar = (f"ensemble_{reference}",) if protocol == "transfer" else ()
    return ("baseline", "baseline_absent", "loudest_direction", *others, *afar)


def method_of(method: str, simulated: SimulatedWindows | None = None) -> WindowMethod:
    """Return what a method is in training: compared with curated windows."""
    return methods(simulated)[row_of(method, "cv", "curated")]
