"""Signature model from any fitted classifier with scikit-learn's `predict_proba` and `classes_`."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.ground.checks import finite_array
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray

from .window_classes import CLASSES, DIRECTIONS, EXPLANATION_COLUMNS, SMALLEST_PROBABILITY


class FittedClassifier(Protocol):
    """What is asked of a fitted classifier, pipelines and calibrated ones included."""

    @property
    def classes_(self) -> Any:
        """Names of the columns of `predict_proba`."""
        ...

    def predict_proba(self, X: Any) -> Any:
        """Return posteriors, shape (n, classes).

        Shapes: X (n, features).
        """
        ...


class ClassifierSignature:
    r"""Likelihoods from posteriors: :math:`\log P_c - \log \pi_c`.

    Parameters
    ----------
    classifier : FittedClassifier
        Its ``classes_`` are front, left, none and right in any order; its posteriors should be calibrated.
    class_prior : mapping of str to float, optional
        Class frequencies that it was trained on; equal ones unless given.

    Raises
    ------
    InvalidArgumentError
        If the classes are others or the prior is none.

    Examples
    --------
    >>> class Coin:
    ...     classes_ = ["left", "right", "front", "none"]
    ...     def predict_proba(self, X): return np.full((len(X), 4), 0.25)
    >>> ClassifierSignature(Coin()).evidence([0.0]).hidden
    (0.0, 0.0)
    """

    def __init__(self, classifier: FittedClassifier, class_prior: dict[str, float] | None = None) -> None:
        names = [str(name) for name in classifier.classes_]
        if sorted(names) != sorted(CLASSES):
            raise InvalidArgumentError(f"classifier: expected the classes {CLASSES}, got {names[:8]}")
        shares = class_prior or dict.fromkeys(CLASSES, 1.0 / len(CLASSES))
        prior = finite_array("class_prior", [shares.get(name, 0.0) for name in CLASSES], (len(CLASSES),))
        if (prior <= 0).any() or not np.isclose(prior.sum(), 1.0, atol=1e-6):
            raise InvalidArgumentError("class_prior: expected a positive share of each class, sum one")
        self._classifier = classifier
        self._order = [names.index(name) for name in CLASSES]
        self.class_prior = prior

    @property
    def reference_prior(self) -> tuple[float, ...]:
        """Training prior in the order of the explanations (left, right, visible, none)."""
        return tuple(self.class_prior[list(EXPLANATION_COLUMNS)].tolist())

    def predict_proba(self, X: ArrayLike) -> FloatArray:
        r"""Return the posteriors of front, left, none, right, shape (n, 4).

        .. math:: P_c = \frac{\max(p_c, 10^{-7})}{\sum_{c'} \max(p_{c'}, 10^{-7})}

        Parameters
        ----------
        X : array_like, shape (n, features)
            One row a window.

        Raises
        ------
        InvalidArgumentError
            If X is not finite or the classifier answers with something that is no distribution.
        """
        inputs = finite_array("X", X, (None, None))
        answer = finite_array(
            "predict_proba", self._classifier.predict_proba(inputs), (len(inputs), len(CLASSES))
        )
        if (answer < 0).any() or not np.allclose(answer.sum(axis=1), 1.0, atol=1e-3):
            raise InvalidArgumentError("predict_proba: expected posteriors that sum to one")
        posteriors = np.maximum(answer[:, self._order], SMALLEST_PROBABILITY)
        return np.asarray(posteriors / posteriors.sum(axis=1, keepdims=True))

    def evidence(self, feature: ArrayLike) -> SignatureEvidence:
        r"""Return the log-likelihoods of one window.

        .. math:: \log \ell_c = \log P_c - \log \pi_c

        Parameters
        ----------
        feature : array_like, shape (features,)
            One window.

        Raises
        ------
        InvalidArgumentError
            As `predict_proba`.

        References
        ----------
        Bayes' rule; H. Bourlard and N. Morgan, *Connectionist Speech Recognition*, 1994 (scaled likelihoods).
        """
        ratios = np.log(self.predict_proba(np.atleast_2d(feature))[0]) - np.log(self.class_prior)
        left, right, visible, none = ratios[list(EXPLANATION_COLUMNS)].tolist()
        return SignatureEvidence(DIRECTIONS, (left, right), visible, none)
