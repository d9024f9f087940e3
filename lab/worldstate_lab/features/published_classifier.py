"""Training of the published classifier: standardise, mirror, linear machine, one sigmoid per pair.

scikit-learn's own ``SVC(probability=True)`` is deprecated, and it couples probabilities inside libsvm, from
which they cannot be exported as numbers. The method is therefore implemented here on top of the linear
machine.
"""

from typing import Protocol, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn import config_context
from sklearn.svm import SVC

from worldstate.abduction.cueing.risk_map import fit_sigmoid
from worldstate.abduction.signature.ensemble import mirror_features
from worldstate.abduction.signature.ensemble_training import checked_labels, standardisation
from worldstate.abduction.signature.published_signature import PAIRS, SignatureModel
from worldstate.abduction.signature.window_classes import CLASSES, LEFT, RIGHT
from worldstate.ground.checks import finite_array
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray, TextArray

PLATT_FOLDS = 5


class Classifier(Protocol):
    """Interface of a signature classifier: scikit-learn's fit and predict_proba."""

    def fit(self, X: ArrayLike, y: ArrayLike, groups: ArrayLike | None = None) -> Self:
        """Train on features, class names and, if they are used, names of sites.

        Shapes: X (n, features), y, groups (n,).
        """
        ...

    def predict_proba(self, X: ArrayLike) -> FloatArray:
        """Return posteriors of front, left, none, right, shape (n, 4).

        Shapes: X (n, features).
        """
        ...


class PublishedClassifier:
    """The published pipeline with scikit-learn's interface.

    Parameters
    ----------
    rng : numpy.random.Generator
        Draws the folds on which the sigmoids are fitted.

    Attributes
    ----------
    model_ : SignatureModel
        After `fit`: all parameters for inference.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> y = np.repeat(CLASSES, 10)
    >>> X = rng.normal(size=(40, 60)) + 3.0 * np.arange(60) * np.repeat([[0], [1], [2], [3]], 10, axis=0)
    >>> PublishedClassifier(rng).fit(X, y).predict_proba(X).shape
    (40, 4)
    """

    model_: SignatureModel

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def fit(self, X: ArrayLike, y: ArrayLike, groups: ArrayLike | None = None) -> Self:
        r"""Fit on features, shape (n, features), and class names, shape (n,).

        .. math:: \min_{w, b} \tfrac12 \|w\|^2 + \sum_n \max\big(0,\; 1 - y_n (w^T z_n + b)\big), \qquad
                  z = (x - \mu) / \sigma

        for each pair of classes, then one sigmoid per pair by `fit_sigmoid` on held-out samples.

        Parameters
        ----------
        X : array_like, shape (n, features)
            One row per window.
        y : array_like of str, shape (n,)
            Class names.
        groups : array_like of str, shape (n,), optional
            Names of sites; ignored.

        Returns
        -------
        PublishedClassifier
            This object.

        Raises
        ------
        InvalidArgumentError
            If the features are not finite or a class is missing or unknown.

        References
        ----------
        Y. Schulz et al. 2021: see `SignatureModel`; C. Cortes and V. Vapnik, "Support-vector networks",
        Machine Learning 20, 1995.
        """
        features = finite_array("X", X, (None, None))
        features, labels = mirror_hazards(features, checked_labels(y, len(features)))
        mean, scale = standardisation(features)
        standard = (features - mean) / scale
        codes = np.searchsorted(CLASSES, labels)
        # Thirty machines on a few dozen windows each: repeated input checks would double the time.
        with config_context(assume_finite=True, skip_parameter_validation=True):
            machine = SVC(kernel="linear", decision_function_shape="ovo").fit(standard, codes)
            slopes, offsets = self._fit_sigmoids(standard, codes)
        self.model_ = SignatureModel(
            mean=mean,
            scale=scale,
            coefficients=machine.coef_,
            intercepts=machine.intercept_,
            slopes=slopes,
            offsets=offsets,
            class_prior=np.bincount(codes) / codes.size,
        )
        return self

    def predict_proba(self, X: ArrayLike) -> FloatArray:
        """Return posteriors of front, left, none, right, shape (n, 4).

        Parameters
        ----------
        X : array_like, shape (n, features)
            One row per window.
        """
        return self.model_.predict_proba(X)

    def _fit_sigmoids(self, standard: FloatArray, codes: IndexArray) -> tuple[FloatArray, FloatArray]:
        fits = []
        for first, second in PAIRS:
            chosen = (codes == first) | (codes == second)
            is_first = codes[chosen] == first
            fits.append(fit_sigmoid(self._held_out_decisions(standard[chosen], is_first), is_first))
        slopes, offsets = np.array(fits).T
        return slopes, offsets

    def _held_out_decisions(self, standard: FloatArray, is_first: BoolArray) -> FloatArray:
        """Return decision values of machines trained without the sample, positive for the first class."""
        decisions = np.empty(len(standard))
        fold = self.rng.permutation(len(standard)) % PLATT_FOLDS
        for held_out in range(PLATT_FOLDS):
            test, train = fold == held_out, fold != held_out
            if is_first[train].all() or not is_first[train].any():
                decisions[test] = 1.0 if is_first[train].all() else -1.0
                continue
            machine = SVC(kernel="linear").fit(standard[train], is_first[train])
            # The product is computed directly, because scikit-learn's input check takes as long as the fit.
            decisions[test] = standard[test] @ machine.coef_[0] + machine.intercept_[0]
        return decisions


def mirror_hazards(X: FloatArray, y: TextArray) -> tuple[FloatArray, TextArray]:
    r"""Append the mirror images of all left and right windows, with swapped sides.

    .. math:: (x, left) \to (\bar x, right), \qquad (x, right) \to (\bar x, left), \qquad
              \bar x_{s,a} = x_{s, A - 1 - a}

    Shapes: X (n, 2 * azimuths), y (n,).
    """
    # Only these two classes are mirrored, as published, so the share of hazards increases.
    hazard = np.isin(y, (CLASSES[LEFT], CLASSES[RIGHT]))
    swapped = np.where(y[hazard] == CLASSES[LEFT], CLASSES[RIGHT], CLASSES[LEFT])
    return np.concatenate([X, mirror_features(X[hazard])]), np.concatenate([y, swapped])
