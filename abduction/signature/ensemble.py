r"""Signature model for unknown junctions: linear experts on the difference between a window and its site.

Every expert receives one view of the window and returns log-posteriors. The ensemble is their mean over
experts and over the window and its mirror image, in which the sides are exchanged:

.. math:: \log P(c \mid x) \propto \tfrac{1}{2 E} \sum_e \big[ \ell_e(c, x) + \ell_e(\bar c, \bar x) \big],
          \qquad \ell_e = \log \mathrm{softmax}\, \big( W_e (v_e(x) - \mu_e) / \sigma_e + b_e \big),

so that a mirrored scene exchanges left and right bit for bit. The optional classes both and direct are their
own mirror images: see `window_classes`.
"""

import math
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.ground import FloatArray, InvalidArgumentError, finite_array, mean, median
from worldstate.ground.checks import check_shape, freeze_arrays, in_range, one_of
from worldstate.ground.serialisation import ADDED, Layout

from . import window_classes
from .published_signature import ModelDomain, SignatureModel

SMALLEST_LEVEL = 1e-4
QUIET_SHARE = 0.35
KINDS = ("mean", "median", "quiet")


def log_levels(X: ArrayLike) -> FloatArray:
    r"""Return the natural logarithm of levels, which are limited to at least 1e-4.

    .. math:: x = \ln \max(X, 10^{-4})

    Examples
    --------
    >>> log_levels([[1.0, 0.0]]).round(2)
    array([[ 0.  , -9.21]])
    """
    return np.log(np.maximum(np.asarray(X, dtype=np.float64), SMALLEST_LEVEL))


def site_reference(levels: ArrayLike) -> FloatArray:
    r"""Return the reference of a site: three unlabelled summaries of its windows, concatenated.

    .. math:: r = \big(\langle x \rangle,\; \mathrm{median}\, x,\;
              \langle x \mid \max_a x_a \le q_{0.35} \rangle\big)

    The last summary is the mean over the 35 % of the windows whose largest feature is lowest. It approximates
    the site without vehicles for any share of such windows.

    Shapes: levels (windows, features), natural logarithms; returns (3 * features,).

    Examples
    --------
    >>> site_reference(np.array([[0.0, 1.0], [2.0, 3.0]]))
    array([1., 2., 1., 2., 0., 1.])
    """
    windows = finite_array("levels", levels, (None, None))
    if not len(windows):
        raise InvalidArgumentError("levels: expected at least one window")
    loudest = windows.max(axis=1)
    quiet = windows[loudest <= np.quantile(loudest, QUIET_SHARE)]
    return np.concatenate([windows.mean(axis=0), np.median(windows, axis=0), quiet.mean(axis=0)])


SEGMENTS = 2


def mirror_features(X: FloatArray, segments: int = SEGMENTS) -> FloatArray:
    r"""Return the features of the mirrored scene: azimuths reversed within each segment.

    .. math:: \bar x_{s,a} = x_{s, A - 1 - a}

    Shapes: X (n, segments * azimuths).
    """
    return X.reshape(len(X), segments, -1)[:, :, ::-1].reshape(X.shape)


_SHARPNESS = 4.0
_PARTS = 3  # Parts of a segment's directions: left, centre and right


def shape_features(levels: FloatArray) -> FloatArray:
    r"""Return peaks, sides, widths and changes of log-levels over direction, shape (n, 13 * segments + 5).

    .. math:: p = \sum_a w_a u_a, \qquad \sigma^2 = \sum_a w_a u_a^2 - p^2, \qquad
              w_a \propto e^{4 (x_a - \max x)}, \quad \sum_a w_a = 1

    are side and width, with u from -1 to 1; the others are extremes, means, deviations and differences.

    Shapes: levels (n, segments * directions).
    """
    # Mirroring the directions exchanges left and right values and changes the sign of signed ones.
    stretches = levels.reshape(len(levels), SEGMENTS, -1)
    first, last = stretches[:, 0], stretches[:, -1]
    change, highest = last - first, np.maximum.reduce
    peak, lowest = highest(last, 1) - highest(first, 1), np.minimum.reduce(change, 1)
    changes = np.array([highest(change, 1), lowest, mean(change, 1), peak, _std(change)])
    by_segment = np.array(_columns(stretches)).transpose(1, 2, 0).reshape(len(levels), -1)
    return np.concatenate([by_segment, changes.T], axis=1)


def _std(values: FloatArray) -> FloatArray:
    around = values - mean(values, -1)[..., None]
    return np.asarray(np.sqrt(mean(around * around, -1)))


def _columns(levels: FloatArray) -> list[FloatArray]:
    """Return the values of each segment, each of shape (n, segments)."""
    n_directions = levels.shape[2]
    highest, total = np.maximum.reduce, np.add.reduce
    peak, middle = highest(levels, 2), median(levels)
    third = n_directions // _PARTS
    ends = [0, third, n_directions - third, n_directions]
    first, centre, last = [highest(levels[:, :, a:b], 2) for a, b in pairwise(ends)]
    direction = _directions(n_directions)
    weights = np.exp(_SHARPNESS * (levels - peak[..., None]))
    weights /= total(weights, 2)[..., None]
    # Sums instead of matrix products: the result of a row then does not depend on the other rows.
    position, square = total(weights * direction, 2), total(weights * direction**2, 2)
    width = np.sqrt(np.maximum(square - position**2, 0.0))
    heights = [peak, middle, np.minimum.reduce(levels, 2), peak - middle]
    sides = [first, centre, last, first - last, position, np.abs(position)]
    return [*heights, *sides, _std(levels), width, _std(levels[..., 1:] - levels[..., :-1])]


@lru_cache
def _directions(count: int) -> FloatArray:
    return np.linspace(-1.0, 1.0, count)


SHAPE, SHAPE_CHANGE = "shape", "shape_change"
VIEWS = (*KINDS, SHAPE, SHAPE_CHANGE)


@dataclass(frozen=True, slots=True, eq=False)
class Expert:
    """One linear softmax classifier and its view of the window.

    Examples
    --------
    >>> Expert("mean", np.zeros(6), np.ones(6), np.zeros((4, 6)), np.zeros(4)).view
    'mean'
    """

    # `mean`, `median` or `quiet`: log-levels minus that summary of the site; `shape`: the values of
    # `shape_features` for the window; `shape_change`: their difference from those of the site's median.
    view: str
    mean: FloatArray  # shape (inputs,): Standardisation; scale > 0
    scale: FloatArray
    weights: FloatArray  # shape (classes, inputs)
    intercepts: FloatArray  # shape (classes,)

    def __post_init__(self) -> None:
        one_of("view", self.view, VIEWS)
        inputs, classes = np.size(self.mean), np.size(self.intercepts)
        freeze_arrays(self, mean=(inputs,), scale=(inputs,), weights=(classes, inputs), intercepts=(classes,))
        if (self.scale <= 0).any():
            raise InvalidArgumentError("scale: expected positive numbers")

    def sums(self, seen: FloatArray) -> FloatArray:
        r"""Return the inputs of the softmax, shape (n, classes), from the view, shape (n, inputs).

        .. math:: a = W (v - \mu) / \sigma + b

        Shapes: seen (n, inputs).
        """
        return np.asarray((seen - self.mean) / self.scale @ self.weights.T + self.intercepts)


def expert_views(levels: FloatArray, reference: FloatArray) -> dict[str, FloatArray]:
    r"""Return all views, each of shape (n, inputs).

    .. math:: v = x - r \text{ (mean, median, quiet)}, \qquad v = \phi(x) \text{ (shape)}, \qquad
              v = \phi(x) - \phi(r_{median}) \text{ (change)}

    where phi is `shape_features`.

    Shapes: levels (n, features), reference (n, 3 * features).
    """
    n = levels.shape[1]
    summaries = {kind: reference[:, n * k : n * (k + 1)] for k, kind in enumerate(KINDS)}
    views = {kind: levels - summary for kind, summary in summaries.items()}
    # One call for both, because for a single window the overhead of calls dominates.
    shapes = shape_features(np.concatenate([levels, summaries["median"]]))
    views[SHAPE], of_site = shapes[: len(levels)], shapes[len(levels) :]
    return views | {SHAPE_CHANGE: views[SHAPE] - of_site}


def log_softmax(sums: FloatArray) -> FloatArray:
    r"""Return the log softmax of each row.

    .. math:: \ell_c = a_c - \log \sum_{c'} e^{a_{c'}}

    Shapes: sums (n, classes).
    """
    below = sums - np.maximum.reduce(sums, 1)[:, None]
    return np.asarray(below - np.log(total(np.exp(below))))


def total(values: FloatArray) -> FloatArray:
    r"""Return the sums of rows, shape (n, 1), bit-identical for any order of the columns.

    .. math:: s_i = \sum_j x_{ij}

    Shapes: values (n, columns).

    Examples
    --------
    >>> total(np.array([[1.0, 2.0, 3.0]]))
    array([[6.]])
    """
    ordered = values.copy()
    ordered.sort()
    return np.asarray(np.add.reduce(ordered, 1)[:, None])


def split_reference(X: FloatArray) -> tuple[FloatArray, FloatArray]:
    r"""Split windows with appended references into log-levels and references.

    .. math:: x = \ln \max(X, 10^{-4})

    Shapes: X (n, 4 * features), returns (n, features).

    Examples
    --------
    >>> split_reference(np.array([[1.0, 0.1, 0.2, 0.3]]))
    (array([[0.]]), array([[0.1, 0.2, 0.3]]))
    """
    n_features = X.shape[1] // (1 + len(KINDS))
    return log_levels(X[:, :n_features]), X[:, n_features:]


MOST_EXPERTS = 32
# Default of `prior_s`, used if the training sites do not determine it.
PRIOR_S = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class EnsembleModel:
    """Coefficients of the ensemble; it holds no training data.

    Parameters
    ----------
    experts : tuple of Expert
        At least one expert.
    class_prior : ndarray, shape (classes,)
        Class frequencies of the training set, including mirrored rows.
    home : ndarray, shape (3 * features,)
        Mean reference of the training sites, including mirrored ones; used for an unknown site.
    empty : ndarray, shape (features,)
        Mean log-levels of the training windows without a source. A mostly empty stream is compared with it,
        see `SiteEstimate`.
    domain : ModelDomain, optional
        Conditions of the training data; `AcousticAdapter` rejects another array, rate or feature.
    prior_s : float
        Duration of a stream after which it has the same weight as the training sites: see `SiteEstimate`.
    classes : tuple of str
        Columns of `predict_proba`: front, left, none, right, then both and direct if the model has them.

    Raises
    ------
    InvalidArgumentError
        If the experts do not fit the reference or the classes, or the prior is invalid.

    Examples
    --------
    >>> expert = Expert("mean", np.zeros(6), np.ones(6), np.zeros((4, 6)), np.zeros(4))
    >>> model = EnsembleModel((expert,), np.full(4, 0.25), np.zeros(18), np.zeros(6))
    >>> model.predict_proba(np.ones((1, 6)))
    array([[0.25, 0.25, 0.25, 0.25]])
    """

    LAYOUT: ClassVar = Layout(
        constants={"kind": "ensemble"}, order="classes class_prior home empty experts domain prior_s"
    )

    experts: tuple[Expert, ...]
    class_prior: FloatArray
    home: FloatArray
    empty: FloatArray
    domain: ModelDomain | None = field(default=None, metadata=ADDED)
    prior_s: float = field(default=PRIOR_S, metadata=ADDED)
    classes: tuple[str, ...] = window_classes.CLASSES

    def __post_init__(self) -> None:
        if not 0 < len(self.experts) <= MOST_EXPERTS:
            raise InvalidArgumentError(f"experts: expected 1 to {MOST_EXPERTS}, got {len(self.experts)}")
        known = (len(window_classes.checked_classes(self.classes)),)
        freeze_arrays(self, class_prior=known, empty=(None,))
        freeze_arrays(self, home=(len(KINDS) * self.n_features,))
        if (self.class_prior <= 0).any() or not np.isclose(self.class_prior.sum(), 1.0):
            raise InvalidArgumentError("class_prior: expected positive numbers that sum to one")
        if self.n_features % SEGMENTS or self.n_features < _PARTS * SEGMENTS:
            raise InvalidArgumentError(f"home: expected {SEGMENTS} segments of {_PARTS} or more directions")
        in_range("prior_s", self.prior_s, 0.0, math.inf)
        views = expert_views(self.empty[None], self.home[None])
        for expert in self.experts:
            inputs = views[expert.view].shape[1]
            if expert.mean.size != inputs:
                raise InvalidArgumentError(f"expert: expected {inputs} inputs, got {expert.mean.size}")
            check_shape("expert: intercepts", expert.intercepts.shape, known)

    @property
    def n_features(self) -> int:
        """Length of the feature vector of one window."""
        return int(self.empty.size)

    @property
    def reference_prior(self) -> tuple[float, ...]:
        """Training prior in the order of the explanations (left, right, visible, none)."""
        prior = window_classes.explained(self.class_prior[None], self.classes, self.class_prior)[0]
        return tuple(prior[list(window_classes.EXPLANATION_COLUMNS)].tolist())

    def predict_proba(self, X: ArrayLike) -> FloatArray:
        r"""Return the posteriors of the model's classes at the training prior, shape (n, classes).

        .. math:: P(c \mid x) \propto \exp \tfrac{1}{2 E} \sum_e
                  \big[ \ell_e(c, x) + \ell_e(\bar c, \bar x) \big], \qquad \sum_c P = 1

        Parameters
        ----------
        X : array_like, shape (n, features) or (n, 4 * features)
            Windows, optionally each followed by the reference of its site.

        Raises
        ------
        InvalidArgumentError
            On another shape, NaN or infinity.

        References
        ----------
        C. Genest and J. V. Zidek, "Combining probability distributions: a critique and an annotated
        bibliography", Statist. Sci. 1, 1986 (the logarithmic pool).
        """
        inputs = finite_array("X", X, (None, None))
        if inputs.shape[1] == self.n_features:
            inputs = np.hstack([inputs, np.tile(self.home, (len(inputs), 1))])
        check_shape("X, with a reference", inputs.shape, (None, self.n_features * (1 + len(KINDS))))
        return self.posteriors(*split_reference(inputs))

    def posteriors(self, levels: FloatArray, reference: FloatArray) -> FloatArray:
        """Return the result of `predict_proba` for log-levels, shape (n, features), and references."""
        n = len(levels)
        views = expert_views(
            np.concatenate([levels, mirror_features(levels, SEGMENTS)]),
            np.concatenate([reference, mirror_features(reference, SEGMENTS * len(KINDS))]),
        )
        told = [(expert, views[expert.view]) for expert in self.experts]
        sums = [expert.sums(half) for expert, seen in told for half in (seen[:n], seen[n:])]
        # One call for all experts, because for a single window the overhead of calls dominates.
        both = log_softmax(np.concatenate(sums)).reshape(len(told), 2, n, -1)
        # These two are added first, because then the result is the same for the mirror image.
        pairs = both[:, 0] + both[:, 1][..., window_classes.mirrored_classes(len(self.classes))]
        pooled = log_softmax(np.add.reduce(pairs) / (2 * len(told)))
        shares = np.maximum(np.exp(pooled), window_classes.SMALLEST_PROBABILITY)
        return np.asarray(shares / total(shares))

    def explain(self, X: ArrayLike) -> FloatArray:
        r"""Return the posteriors of front, left, none and right only, shape (n, 4).

        .. math:: P'_k = P_k + \tfrac{1}{2} P_{both} [k \text{ a side}] + P_{direct}\, \pi'_k / \sum \pi'

        It raises the errors of `predict_proba`.

        Parameters
        ----------
        X : array_like, shape (n, features) or (n, 4 * features)
            See `predict_proba`.

        References
        ----------
        Derived here: see the module `worldstate.abduction.signature.window_classes`.
        """
        return window_classes.explained(self.predict_proba(X), self.classes, self.class_prior)

    def evidence(self, feature: ArrayLike) -> SignatureEvidence:
        r"""Return the log-likelihoods of one window, shape (features,) or (4 * features,).

        .. math:: \log \ell_c = \log P_c - \log \pi_c

        Parameters
        ----------
        feature : array_like, shape (features,) or (4 * features,)
            One window with or without its reference.

        Raises
        ------
        InvalidArgumentError
            On another shape, NaN or infinity.

        References
        ----------
        Bayes' rule; H. Bourlard and N. Morgan, *Connectionist Speech Recognition*, 1994 (scaled likelihoods).
        """
        posteriors = self.predict_proba(np.atleast_2d(feature))
        return window_classes.window_evidence(posteriors, self.classes, self.class_prior)


AnySignature = SignatureModel | EnsembleModel


def explain(signature: AnySignature, X: ArrayLike) -> FloatArray:
    """Return the posteriors of front, left, none and right of windows, shape (n, 4), for both models."""
    return signature.explain(X) if isinstance(signature, EnsembleModel) else signature.predict_proba(X)
