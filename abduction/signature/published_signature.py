r"""The published signature model: likelihoods of the explanations from a feature vector.

A linear one-against-one support vector machine classifies standardised features. The decision value of each
pair of classes passes through a sigmoid, and the pairs are coupled into posteriors of front, left, none and
right. Their ratios to the class frequencies of the training set are the likelihoods that eq. (6) needs.
"""

from dataclasses import dataclass, field
from itertools import combinations
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.cueing.risk_map import sigmoid
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.ground import FloatArray, InvalidArgumentError
from worldstate.ground.checks import finite_array, freeze_arrays, in_range
from worldstate.ground.serialisation import ADDED, Layout

from .window_classes import CLASSES, EXPLANATION_COLUMNS, SMALLEST_PROBABILITY, evidence_of

EgoMotion = Literal["standing", "moving", "any"]


@dataclass(frozen=True, slots=True, eq=False)
class ModelDomain:
    """Conditions under which the windows of a training set or a table were recorded.

    Parameters
    ----------
    array : str
        Name of the microphone array.
    positions_m : ndarray, shape (M, 3)
        Positions of the microphones in channel order, `base_link` axes, metres.
    sample_rate_hz : (float, float)
        Lowest and highest rate for frames of 512; lower rates with proportionally shorter frames are allowed.
    band_hz : (float, float)
        Band of the feature.
    feature : str
        Name and version of the feature.
    ego_motion : {"standing", "moving", "any"}
        Motion of the ego vehicle.
    fastest_mps : float, optional
        Maximum speed; None in files without this value.

    Raises
    ------
    InvalidArgumentError
        If the positions are not an (M, 3) array of finite numbers or an interval is empty.

    Examples
    --------
    >>> ModelDomain("pair", [[0, 0.1, 0], [0, -0.1, 0]], (47e3, 49e3), (50, 1500), "f 1", "standing").extent_m
    (0.0, 0.2, 0.0)
    """

    array: str
    positions_m: FloatArray
    sample_rate_hz: tuple[float, float]
    band_hz: tuple[float, float]
    feature: str
    ego_motion: EgoMotion
    fastest_mps: float | None = field(default=None, metadata=ADDED)

    def __post_init__(self) -> None:
        freeze_arrays(self, positions_m=(None, 3))
        for name in ("sample_rate_hz", "band_hz"):
            low, high = getattr(self, name)
            in_range(name, low, 0.0, high)

    @property
    def extent_m(self) -> tuple[float, float, float]:
        """Extent of the array along x, y and z, metres."""
        x, y, z = np.ptp(self.positions_m, axis=0).tolist()
        return x, y, z


# All pairs i < j in the order of a one-against-one machine.
PAIRS = tuple(combinations(range(len(CLASSES)), 2))


@dataclass(frozen=True, slots=True, eq=False)
class SignatureModel:
    r"""Coefficients of the published classifier; it holds no training data.

    .. math:: f_{ij}(x) = w_{ij}^T (x - \mu) / \sigma + b_{ij}, \qquad
              P(i \mid i \text{ or } j, x) = 1 / (1 + \exp(A_{ij} f_{ij} + B_{ij})).

    Parameters
    ----------
    mean, scale : ndarray, shape (features,)
        Standardisation; scale > 0.
    coefficients : ndarray, shape (6, features)
        w, one row per pair of the classes front, left, none and right.
    intercepts : ndarray, shape (6,)
        b.
    slopes, offsets : ndarray, shape (6,)
        A and B of the sigmoids.
    class_prior : ndarray, shape (4,)
        Class frequencies of the training set, including mirrored rows.
    domain : ModelDomain, optional
        Conditions of the training data; `AcousticAdapter` rejects another array, rate or feature.

    Raises
    ------
    InvalidArgumentError
        If shapes differ, a number is not finite, a scale is not positive or the prior is invalid.

    References
    ----------
    Schulz et al., "Hearing What You Cannot See: Acoustic Vehicle Detection Around Corners", 2021.

    Examples
    --------
    >>> pairs = np.zeros(6)
    >>> model = SignatureModel(np.zeros(2), np.ones(2), np.zeros((6, 2)), *[pairs] * 3, np.full(4, 0.25))
    >>> model.predict_proba([[0.3, 0.1]])
    array([[0.25, 0.25, 0.25, 0.25]])
    """

    LAYOUT: ClassVar = Layout(constants={"classes": list(CLASSES)})

    mean: FloatArray
    scale: FloatArray
    coefficients: FloatArray
    intercepts: FloatArray
    slopes: FloatArray
    offsets: FloatArray
    class_prior: FloatArray
    domain: ModelDomain | None = field(default=None, metadata=ADDED)

    def __post_init__(self) -> None:
        features, pairs, known = np.size(self.mean), len(PAIRS), (len(CLASSES),)
        freeze_arrays(self, mean=(features,), scale=(features,), coefficients=(pairs, features))
        freeze_arrays(self, intercepts=(pairs,), slopes=(pairs,), offsets=(pairs,), class_prior=known)
        if (self.scale <= 0).any():
            raise InvalidArgumentError("scale: expected positive numbers")
        if (self.class_prior <= 0).any() or not np.isclose(self.class_prior.sum(), 1.0):
            raise InvalidArgumentError("class_prior: expected positive numbers that sum to one")

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the columns of `predict_proba`."""
        return CLASSES

    @property
    def n_features(self) -> int:
        """Length of the feature vector."""
        return int(self.mean.size)

    @property
    def reference_prior(self) -> tuple[float, ...]:
        """Training prior in the order of the explanations (left, right, visible, none)."""
        return tuple(self.class_prior[list(EXPLANATION_COLUMNS)].tolist())

    def decision_values(self, X: ArrayLike) -> FloatArray:
        r"""Return f, shape (n, 6), which is positive if the first class of the pair is more likely.

        .. math:: f_{ij}(x) = w_{ij}^T (x - \mu) / \sigma + b_{ij}

        Parameters
        ----------
        X : array_like, shape (n, features)

        Raises
        ------
        InvalidArgumentError
            On another shape, NaN or infinity.

        References
        ----------
        Y. Schulz et al. 2021: see `SignatureModel`; C. Cortes and V. Vapnik, "Support-vector networks",
        Machine Learning 20, 1995.
        """
        features = finite_array("X", X, (None, self.n_features))
        return np.asarray((features - self.mean) / self.scale @ self.coefficients.T + self.intercepts)

    def predict_proba(self, X: ArrayLike) -> FloatArray:
        r"""Return the posteriors of front, left, none, right at the training prior, shape (n, 4).

        .. math:: r_{ij} = 1 / (1 + \exp(A_{ij} f_{ij} + B_{ij})), \qquad
                  \hat p = \arg\min_p \sum_i \sum_{j \ne i} (r_{ji} p_i - r_{ij} p_j)^2

        It raises the errors of `decision_values`.

        Parameters
        ----------
        X : array_like, shape (n, features)
            One row per window.

        References
        ----------
        J. Platt 1999 (sigmoids), see `fit_platt`; T.-F. Wu, C.-J. Lin and R. C. Weng 2004 (coupling), see
        `couple`.
        """
        return couple(sigmoid(self.decision_values(X), self.slopes, self.offsets), len(CLASSES))

    def evidence(self, feature: ArrayLike) -> SignatureEvidence:
        r"""Return the log-likelihoods of one feature vector, shape (features,).

        .. math:: \log \ell_c = \log P_c - \log \pi_c

        Parameters
        ----------
        feature : array_like, shape (features,)
            One window.

        Raises
        ------
        InvalidArgumentError
            On another shape, NaN or infinity.

        References
        ----------
        Bayes' rule; H. Bourlard and N. Morgan, *Connectionist Speech Recognition*, 1994 (scaled likelihoods).
        """
        return evidence_of(self.predict_proba(np.atleast_2d(feature)), self.class_prior)


def couple(pairwise: FloatArray, n_classes: int) -> FloatArray:
    r"""Return positive class probabilities with sum one from pair probabilities, shape (n, classes).

    For classes i and j let :math:`r_{ij}` estimate :math:`P(i \mid i \text{ or } j)`. The probabilities are

    .. math:: \hat p = \arg\min_p \sum_i \sum_{j \ne i} (r_{ji} p_i - r_{ij} p_j)^2, \qquad \sum_i p_i = 1

    The optimality conditions are linear and the solution is never negative.

    Shapes: pairwise (n, pairs), in the order of `PAIRS`.

    Source: Wu, Lin, Weng, "Probability estimates for multi-class classification by pairwise coupling", 2004,
    second method.
    """
    first, second = np.triu_indices(n_classes, 1)
    r = np.zeros((len(pairwise), n_classes, n_classes))
    r[:, first, second] = np.clip(pairwise, SMALLEST_PROBABILITY, 1.0 - SMALLEST_PROBABILITY)
    r[:, second, first] = 1.0 - r[:, first, second]
    # The quadratic form Q with the constraint on the sum: [[Q, 1], [1', 0]].
    matrix = np.ones((len(r), n_classes + 1, n_classes + 1))
    matrix[:, :-1, :-1] = (r**2).sum(axis=1)[:, None] * np.eye(n_classes) - r * r.mT
    matrix[:, -1, -1] = 0.0
    right_side = np.eye(n_classes + 1)[:, -1:]
    positive = np.maximum(np.linalg.solve(matrix, right_side)[:, :-1, 0], SMALLEST_PROBABILITY)
    return np.asarray(positive / positive.sum(axis=1, keepdims=True))
