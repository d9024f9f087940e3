"""Evaluation of a signature classifier and its cueing on labelled feature windows.

Every scored prediction comes from a classifier, a threshold and a risk map that were trained without any
window of the recording (protocol ``cv``), junction (``lojo``) or ego motion (``transfer``). Threshold and map
are set on inner out-of-fold scores of the training windows.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np
from scipy.optimize import brentq
from scipy.special import expit, logit

from worldstate.abduction.cueing.risk_map import fit_isotonic, fit_platt
from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.abduction.signature.ensemble_training import Recipe, SimulatedWindows, SiteEnsembleClassifier
from worldstate.abduction.signature.window_classes import CLASSES, hazard_statistic
from worldstate.adapters.datasets.feature_table import N_FEATURES, FeatureTable
from worldstate.adapters.files.acoustic_domain import check_tables, ovad_domain
from worldstate.adapters.files.model_file import Model
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray, TextArray
from worldstate.operations.training.site_references import asked_while_listening, with_site_references
from worldstate.operations.training.training import (
    ABSENT_MISS_RATE,
    PUBLISHED_MISS_RATE,
    WindowCalibration,
    asked_on_streams,
    calibrate_passes,
    folds_by_recording,
    junction_folds,
    out_of_fold,
    trained_ensemble,
)
from worldstate_lab.features.published_classifier import Classifier, PublishedClassifier

Protocol = Literal["cv", "lojo", "transfer"]
Reference = Literal["run", "cold", "curated"]
# Returns the posteriors of the chosen rows of the evaluated table, shape (rows, 4).
Ask = Callable[[Classifier, BoolArray], FloatArray]

SMALLEST_RISK = 1e-6


@dataclass(frozen=True, slots=True)
class WindowMethod:
    """One way to compute a risk from windows."""

    # Returns an untrained classifier; None: the ensemble, trained as in `model fit`.
    make: Callable[[np.random.Generator], Classifier] | None = None
    miss_rate: float = ABSENT_MISS_RATE  # beta of the statistic
    # Reference of the scored windows, None if the method uses none. Training is the same in any case, as in
    # `model fit`.
    reference: Reference | None = None
    # Whether the method is for sites unlike those of training. Its threshold and map then come only from
    # folds like the outer ones, and under `transfer` risks are shifted until hazards are as frequent as in
    # training. Otherwise the threshold of an ensemble is a compromise between folds by junction and folds by
    # recording.
    afar: bool = False
    simulated: SimulatedWindows | None = None  # On which the ensemble is trained, too

    def prepare(self, table: FeatureTable) -> FeatureTable:
        """Return the table in the form that the classifier receives."""
        return table if self.reference is None else with_site_references(table)

    def trained(self, table: FeatureTable, rng: np.random.Generator) -> Classifier:
        """Return a classifier trained on a prepared table."""
        if self.make is None:
            return trained_ensemble(table, simulated=self.simulated)
        return self.make(rng).fit(table.features, table.labels, table.environments)

    def posteriors(self, table: FeatureTable, rng: np.random.Generator, inner: Protocol = "cv") -> FloatArray:
        """Return out-of-fold posteriors of each window of a prepared table, shape (n, 4)."""
        return self.passes(table, rng, inner, self.asks(table, rng)[:1])[0]

    def passes(
        self, table: FeatureTable, rng: np.random.Generator, inner: Protocol, asks: Sequence[Ask]
    ) -> list[FloatArray]:
        """Return out-of-fold posteriors for each kind of query, each of shape (n, 4)."""
        folds = folds_of(inner, table, rng)
        return out_of_fold(table, folds, lambda part: self.trained(part, rng), asks)

    def asks(self, table: FeatureTable, rng: np.random.Generator) -> list[Ask]:
        """Return the queries of inner folds of a prepared table, with the reference of the scored windows."""
        # A threshold is valid only for the reference with which it was set: one set under `run` loses 0.06 of
        # the windows if the scored windows use curated references. Separate generators are used, so that the
        # draws of queries do not change the folds.
        if self.afar or self.reference in (None, "curated"):
            return [_asked_plainly(table)]
        if self.reference == "run":
            return [_of_ensemble(one) for one in asked_on_streams(table, rng)]
        windows = table.features[:, :N_FEATURES]
        return [lambda classifier, rows: classifier.predict_proba(windows[rows])]

    def calibration(
        self, train: FeatureTable, protocol: Protocol, rng: np.random.Generator, alpha: float
    ) -> tuple[WindowCalibration, float]:
        """Return threshold and risk map, and the mean risk of the training windows."""
        like_outer: Protocol = "cv" if protocol == "cv" else "lojo"
        # The folds are ordered from the most to the least cautious.
        both = self.reference is not None and not self.afar and like_outer == "lojo"
        inner: tuple[Protocol, ...] = ("lojo", "cv") if both else (like_outer,)
        asks, beta = self.asks(train, rng), self.miss_rate
        scores = [self.passes(train, rng, one, asks) for one in inner]
        fit_map = fit_isotonic if self.reference is None else fit_platt
        learned = calibrate_passes(train, scores, alpha=alpha, miss_rate=beta, fit_map=fit_map)
        return learned, float(learned.risk_map(hazard_statistic(np.concatenate(scores[-1]), beta)).mean())


def folds_of(protocol: Protocol, table: FeatureTable, rng: np.random.Generator) -> TextArray:
    """Return the folds of a protocol; ``transfer`` splits its training set by junction."""
    return folds_by_recording(table, rng) if protocol == "cv" else junction_folds(table)


def _asked_plainly(table: FeatureTable) -> Ask:
    """Return a query that uses the rows of the table unchanged."""
    return lambda classifier, rows: classifier.predict_proba(table.features[rows])


def _of_ensemble(ask: Callable[[EnsembleModel, BoolArray], FloatArray]) -> Ask:
    return lambda classifier, rows: ask(cast(SiteEnsembleClassifier, classifier).model_, rows)


def asked_under(
    reference: Reference, table: FeatureTable, rng: np.random.Generator
) -> Callable[[EnsembleModel, BoolArray], FloatArray]:
    """Return a function for the posteriors of rows by a model, with a reference.

    Shapes: table (n, 60).
    """
    if reference == "run":
        return asked_while_listening(table, rng)
    features = (table if reference == "cold" else with_site_references(table)).features
    return lambda model, rows: model.explain(features[rows])


@dataclass(frozen=True, slots=True, eq=False)
class Predictions:
    """One prediction for every window of a table."""

    probabilities: FloatArray  # shape (n, 4): Posteriors of front, left, none, right
    score: FloatArray  # shape (n,): Statistic; below, the calibrated risk
    risk: FloatArray
    decision: BoolArray  # shape (n,): Whether the statistic reached the threshold

    @property
    def classes(self) -> TextArray:
        """Return the most probable class of each window: the published rule."""
        most_probable: TextArray = np.array(CLASSES)[self.probabilities.argmax(axis=1)]
        return most_probable


def evaluate_pass(
    method: WindowMethod,
    table: FeatureTable,
    protocol: Protocol,
    *,
    seed: int,
    alpha: float,
    train: FeatureTable | None = None,
) -> Predictions:
    """Run one seed of one method; `train` is the training set of ``transfer``."""
    rng, inputs = np.random.default_rng(seed), method.prepare(table)
    ask = _asked_plainly(inputs)
    if method.reference is not None:
        # A separate generator is used, so that the folds of a seed are the same with every reference.
        ask = _of_ensemble(asked_under(method.reference, table, np.random.default_rng([seed, 1])))
    if train is None:
        return cross_validate(inputs, protocol, method, rng, alpha=alpha, ask=ask)
    return transfer(method.prepare(train), inputs, method, rng, alpha=alpha, ask=ask)


def cross_validate(
    table: FeatureTable,
    protocol: Protocol,
    method: WindowMethod,
    rng: np.random.Generator,
    *,
    alpha: float,
    ask: Ask | None = None,
) -> Predictions:
    """Predict every window once, with classifier, threshold and map trained without its fold.

    Parameters
    ----------
    table : FeatureTable
        Windows, prepared for the method.
    protocol : {"cv", "lojo"}
        Folds of the table, and of each training set, on which threshold and map are set.
    method : WindowMethod
        Creates the classifiers.
    rng : numpy.random.Generator
        For the folds and the classifiers.
    alpha : float
        Budget of the threshold.
    ask : callable, optional
        Query for held-out rows, if they use another reference than the table.

    Returns
    -------
    Predictions
        One for each window.

    Examples
    --------
    >>> from worldstate_lab.features.published_classifier import PublishedClassifier
    >>> rng = np.random.default_rng(0)
    >>> labels = np.repeat(["left", "none", "right", "front"], 20)
    >>> keys = np.array([str(i) for i in range(80)])
    >>> loud = np.where(labels == "none", 0.1, 0.2)[:, None]
    >>> features = loud * rng.lognormal(0.0, 0.2, (80, 60))
    >>> table = FeatureTable(features, labels, keys, np.tile(["SA1", "SB1"], 40), keys, (None,) * 80)
    >>> alarms = cross_validate(table, "cv", WindowMethod(PublishedClassifier), rng, alpha=0.1).decision
    >>> bool(alarms[table.hazards].mean() > alarms[table.hazard_free].mean())
    True
    """
    folds, ask = folds_of(protocol, table, rng), ask or _asked_plainly(table)
    n = len(table)
    found = Predictions(np.empty((n, len(CLASSES))), np.empty(n), np.empty(n), np.empty(n, dtype=np.bool_))
    for fold in np.unique(folds):
        held_out = folds == fold
        train = table.select(~held_out)
        probabilities = ask(method.trained(train, rng), held_out)
        learned, _ = method.calibration(train, protocol, rng, alpha)
        found.probabilities[held_out] = probabilities
        found.score[held_out], found.risk[held_out], found.decision[held_out] = learned.apply(probabilities)
    return found


def transfer(
    train: FeatureTable,
    test: FeatureTable,
    method: WindowMethod,
    rng: np.random.Generator,
    *,
    alpha: float,
    ask: Ask,
) -> Predictions:
    """Predict every window of one table after training on another."""
    shared = np.intersect1d(train.recording_keys, test.recording_keys)
    if shared.size:
        raise InvalidArgumentError(
            f"transfer: expected different recordings for the test, {shared.size} shared"
        )
    learned, mean_risk = method.calibration(train, "transfer", rng, alpha)
    probabilities = ask(method.trained(train, rng), np.ones(len(test), dtype=np.bool_))
    score, risk, decision = learned.apply(probabilities)
    return Predictions(
        probabilities, score, matched_risk(risk, test, mean_risk) if method.afar else risk, decision
    )


def matched_risk(risk: FloatArray, table: FeatureTable, mean_risk: float) -> FloatArray:
    r"""Return the risks, shifted in log-odds for each junction, shape (n,).

    .. math:: r' = \sigma(\mathrm{logit}\, r + b), \qquad
              \tfrac{1}{n} \sum_i \sigma(\mathrm{logit}\, r_i + b) = \bar r,

    with the mean over the junction's other recordings. No labels are used, but the share of hazards among the
    windows is assumed to be that of the training: this holds for a curated set, but not for continuous sound
    of a street.

    Shapes: risk (n,).
    """
    log_odds = logit(np.clip(risk, SMALLEST_RISK, 1.0 - SMALLEST_RISK))
    keys, matched = table.recording_keys, np.empty(len(table))
    for key in np.unique(keys):
        mine = keys == key
        others = (table.environments == table.environments[mine][0]) & ~mine
        if not others.any():
            raise InvalidArgumentError(f"recording {key}: expected another recording of its junction")
        matched[mine] = expit(log_odds[mine] + _shift(log_odds[others], mean_risk))
    return matched


def _shift(log_odds: FloatArray, mean: float) -> float:
    def surplus(shift: float) -> float:
        return float(expit(log_odds + shift).mean()) - mean

    farthest = float(np.abs(log_odds).max() + abs(logit(mean)) + 1.0)
    return float(brentq(surplus, -farthest, farthest))


def predict_held_out(
    model: Model, table: FeatureTable, alpha: float, reference: Reference, rng: np.random.Generator
) -> Predictions:
    """Predict windows of recordings outside a model's training set, by the published statistic."""
    if model.domain is not None:
        # A table without a domain, such as the released one, is OVAD's.
        check_tables(model.domain, table.domain or ovad_domain(table.environments.tolist()))
    check_unseen(model, table)
    if isinstance(model.signature, EnsembleModel):
        ask = asked_under(reference, table, rng)
        probabilities = ask(model.signature, np.ones(len(table), dtype=np.bool_))
    else:
        probabilities = model.signature.predict_proba(table.features)
    policy = model.policies.for_alpha(alpha, PUBLISHED_MISS_RATE)
    calibration = WindowCalibration(PUBLISHED_MISS_RATE, policy.gamma, policy.risk_map)
    return Predictions(probabilities, *calibration.apply(probabilities))


def check_unseen(model: Model, table: FeatureTable) -> None:
    """Raise an error if a table shares recordings with the training set of a model."""
    recordings = set(np.unique(table.recording_keys).tolist())
    seen = recordings & set(model.provenance.training_recordings)
    if seen:
        raise InvalidArgumentError(
            f"model: trained on {len(seen)} of these {len(recordings)} recordings; expected none. "
            "Train with --exclude IDS and evaluate with --only IDS"
        )


REFERENCES: tuple[Reference, ...] = ("run", "cold", "curated")


def _distant_site(rng: np.random.Generator) -> Classifier:
    # Only the quiet reference is used, with weak regularisation. A stronger ridge favours the level, which is
    # masked by the noise of a moving ego; the pattern relative to the quietest windows remains. The recipe
    # was chosen among about thirty, for each moving junction on the other two, with the same result three
    # times.
    return SiteEnsembleClassifier((Recipe("quiet", 1e-5),))


def methods(simulated: SimulatedWindows | None = None) -> dict[str, WindowMethod]:
    """Return the methods by name; with simulated windows, the ensembles are trained on them too."""
    ensemble = WindowMethod(simulated=simulated)
    # For a moving ego only the pattern is used, because streets with a standing ego reduce its accuracy
    # (lab/NOTES.md).
    distant = WindowMethod(_distant_site, afar=True)
    return {
        "baseline": WindowMethod(PublishedClassifier, PUBLISHED_MISS_RATE),
        **{f"ensemble_{one}": replace(ensemble, reference=one) for one in REFERENCES},
        **{f"distant_site_{one}": replace(distant, reference=one) for one in REFERENCES},
    }


# The method of `worldstate`: the ensemble if the ego moves as in training, a single expert otherwise. The
# choice depends only on the known motion of the ego.
OURS: dict[Protocol, str] = {"cv": "ensemble", "lojo": "ensemble", "transfer": "distant_site"}


def row_of(method: str, protocol: Protocol, reference: Reference) -> str:
    """Return the name in `methods` of a method under a protocol and a reference."""
    return f"{OURS[protocol]}_{reference}" if method == "worldstate" else method


def rows_beside(row: str, protocol: Protocol, reference: Reference) -> tuple[str, ...]:
    """Return the rows to compare with one: baselines, and the same method with the other references."""
    if row == "baseline":
        return ()
    others = tuple(row_of("worldstate", protocol, other) for other in REFERENCES if other != reference)
    # If the motion of the ego differs from training, the ensemble is a baseline too.
    afar = (f"ensemble_{reference}",) if protocol == "transfer" else ()
    return ("baseline", *others, *afar)


def method_of(method: str) -> WindowMethod:
    """Return a method as used in training: with curated references."""
    return methods()[row_of(method, "cv", "curated")]
