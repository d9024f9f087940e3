"""Evaluation of a signature classifier and its cueing on labelled feature windows.

Everything that is scored was predicted by a classifier, a threshold and a risk map that saw no window of the
recording (protocol ``cv``), junction (``lojo``) or kind of driving (``transfer``): threshold and map come
from inner out-of-fold scores of the training windows.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from worldstate.abduction.cueing.risk_map import fit_isotonic
from worldstate.abduction.signature.ensemble_training import Classifier
from worldstate.abduction.signature.window_classes import CLASSES, hazard_statistic
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray, TextArray

from .prevalence import matched_risk
from .splits import Split
from .window_calibration import MISS_RATES, FitMap, WindowCalibration, between, calibrate_windows

MakeClassifier = Callable[[np.random.Generator], Classifier]
# Posteriors of the chosen rows of the table that is evaluated, shape (rows, 4).
Ask = Callable[[Classifier, BoolArray], FloatArray]
# From a table and a generator to how its rows are asked for.
Asking = Callable[[FeatureTable, np.random.Generator], Ask]


@dataclass(frozen=True, slots=True, eq=False)
class Predictions:
    """What was predicted of every window of one table, each once."""

    folds: TextArray  # shape (n,): Fold in which each window was held out
    probabilities: FloatArray  # shape (n, 4): Posteriors of front, left, none, right
    score: FloatArray  # shape (n,): Statistic and calibrated risk
    risk: FloatArray
    decision: BoolArray  # shape (n,): Whether the statistic reached the threshold

    @classmethod
    def blank(cls, folds: TextArray) -> "Predictions":
        """Return arrays to be filled in, fold by fold."""
        n = len(folds)
        return cls(folds, np.empty((n, len(CLASSES))), np.empty(n), np.empty(n), np.empty(n, dtype=np.bool_))

    def fill(self, rows: BoolArray, probabilities: FloatArray, calibration: WindowCalibration) -> None:
        """Write what a calibration makes of the posteriors of some rows."""
        self.probabilities[rows] = probabilities
        self.score[rows], self.risk[rows], self.decision[rows] = calibration.apply(probabilities)

    @property
    def classes(self) -> TextArray:
        """Most probable class of each window: the published rule."""
        most_probable: TextArray = np.array(CLASSES)[self.probabilities.argmax(axis=1)]
        return most_probable


def asked_plainly(table: FeatureTable, rng: np.random.Generator) -> Ask:
    """Ask for rows as the table holds them; nothing is drawn."""
    return lambda classifier, rows: classifier.predict_proba(table.features[rows])


def cross_validate(
    table: FeatureTable,
    split: Split,
    make: MakeClassifier,
    rng: np.random.Generator,
    *,
    alpha: float,
    inner_splits: Sequence[Split] = (),
    fit_map: FitMap = fit_isotonic,
    ask: Ask | None = None,
    inner_asking: Asking = asked_plainly,
    on_fold: Callable[[], None] = lambda: None,
) -> dict[float, Predictions]:
    """Predict every window once, by classifier, threshold and map that never saw its fold.

    Parameters
    ----------
    table : FeatureTable
        Windows.
    split : callable
        Folds of a table.
    make : callable
        Makes an untrained classifier.
    rng : numpy.random.Generator
        Draws folds and whatever the classifier draws.
    alpha : float
        Budget of the threshold.
    inner_splits : sequence of callable
        Folds inside each training set, from which threshold and map are learned: `split` again, unless given;
        with several, from the most careful to the boldest, the calibration is that `between` them.
    fit_map : callable
        Fits the risk map.
    ask : callable, optional
        Asks the classifier about held-out rows, where they are asked otherwise than the table holds them:
        with another reference.
    inner_asking : callable, optional
        The same for the rows of inner folds.
    on_fold : callable
        Called after each outer fold, for progress.

    Returns
    -------
    dict of float to Predictions
        For each beta: 1, the published statistic, and 0, with the visible explanation removed.

    Examples
    --------
    >>> from worldstate.abduction.signature.published_training import PublishedClassifier
    >>> from worldstate.operations.training.splits import folds_by_recording
    >>> rng = np.random.default_rng(0)
    >>> labels = np.repeat(["left", "none", "right", "front"], 20)
    >>> keys = np.array([str(i) for i in range(80)])
    >>> loud = np.where(labels == "none", 0.1, 0.2)[:, None]
    >>> features = loud * rng.lognormal(0.0, 0.2, (80, 60))
    >>> table = FeatureTable(features, labels, keys, np.tile(["SA1", "SB1"], 40), keys, (None,) * 80)
    >>> found = cross_validate(table, folds_by_recording, PublishedClassifier, rng, alpha=0.1)
    >>> alarms = found[0.0].decision
    >>> bool(alarms[table.hazards].mean() > alarms[table.hazard_free].mean())
    True
    """
    folds, ask = split(table, rng), ask or asked_plainly(table, rng)
    predictions = {beta: Predictions.blank(folds) for beta in MISS_RATES}
    for fold in np.unique(folds):
        held_out = folds == fold
        train = table.select(~held_out)
        probabilities = ask(_trained(make, train, rng), held_out)
        inner = [
            out_of_fold(train, one(train, rng), make, rng, inner_asking) for one in inner_splits or (split,)
        ]
        for beta, prediction in predictions.items():
            prediction.fill(held_out, probabilities, _calibration(train, inner, alpha, beta, fit_map))
        on_fold()
    return predictions


def transfer(
    train: FeatureTable,
    test: FeatureTable,
    inner_splits: Sequence[Split],
    make: MakeClassifier,
    rng: np.random.Generator,
    *,
    alpha: float,
    fit_map: FitMap = fit_isotonic,
    ask: Ask | None = None,
    match_prevalence: bool = False,
) -> dict[float, Predictions]:
    """Predict every window of one table by what was learned on another."""
    shared = np.intersect1d(train.recording_keys, test.recording_keys)
    if shared.size:
        raise InvalidArgumentError(f"transfer: expected other recordings to test on, {shared.size} shared")
    inner = [out_of_fold(train, one(train, rng), make, rng) for one in inner_splits]
    everything = np.ones(len(test), dtype=np.bool_)
    probabilities = (ask or asked_plainly(test, rng))(_trained(make, train, rng), everything)
    predictions = {}
    for beta in MISS_RATES:
        calibration = _calibration(train, inner, alpha, beta, fit_map)
        one = predict_with(test, probabilities, calibration, "transfer")
        if match_prevalence:
            mean_risk = float(calibration.risk_map(hazard_statistic(inner[-1], beta)).mean())
            one = replace(one, risk=matched_risk(one.risk, test, mean_risk))
        predictions[beta] = one
    return predictions


def out_of_fold(
    table: FeatureTable,
    folds: TextArray,
    make: MakeClassifier,
    rng: np.random.Generator,
    asking: Asking = asked_plainly,
) -> FloatArray:
    """Return posteriors of each window from a classifier trained on the other folds, shape (n, 4)."""
    probabilities = np.empty((len(table), len(CLASSES)))
    # A generator of its own: what is drawn to ask moves no fold.
    ask = asking(table, rng.spawn(1)[0])
    for fold in np.unique(folds):
        held_out = folds == fold
        probabilities[held_out] = ask(_trained(make, table.select(~held_out), rng), held_out)
    return probabilities


def predict_with(
    table: FeatureTable, probabilities: FloatArray, calibration: WindowCalibration, fold: str = "model"
) -> Predictions:
    """Return the predictions of a finished model, as one fold."""
    predictions = Predictions.blank(np.full(len(table), fold))
    predictions.fill(np.ones(len(table), dtype=np.bool_), probabilities, calibration)
    return predictions


def _trained(make: MakeClassifier, table: FeatureTable, rng: np.random.Generator) -> Classifier:
    return make(rng).fit(table.features, table.labels, table.environments)


def _calibration(
    train: FeatureTable, inner: Sequence[FloatArray], alpha: float, miss_rate: float, fit_map: FitMap
) -> WindowCalibration:
    levels = [
        calibrate_windows(
            one, train.hazards, train.hazard_free, alpha=alpha, miss_rate=miss_rate, fit_map=fit_map
        )
        for one in inner
    ]
    return between(levels)
