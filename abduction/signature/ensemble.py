r"""Signature model for junctions never seen: linear experts on a window compared with its site.

Every expert is given one view of the window and returns log-posteriors; the ensemble is their mean
over experts and over the window and its mirror image, sides exchanged:

.. math:: \log P(c \mid x) \propto \tfrac{1}{2 E} \sum_e \big[ \ell_e(c, x) + \ell_e(\bar c, \bar x) \big],
          \qquad \ell_e = \log \mathrm{softmax}\, \big( W_e (v_e(x) - \mu_e) / \sigma_e + b_e \big),

so that mirroring the world exchanges left and right to the bit. Both and direct, where a model knows them,
are their own mirror images: see `window_classes`.
"""

import math
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.ground import FloatArray, InvalidArgumentError
from worldstate.ground.checks import check_shape, finite_array, freeze_arrays, in_range
from worldstate.ground.serialisation import ADDED, Layout, Via

from .expert import (
    SEGMENTS,
    VIEWS,
    Expert,
    expert_views,
    log_softmax,
    mirror_features,
    split_reference,
    total,
)
from .model_domain import ModelDomain
from .published_signature import SignatureModel
from .site_reference import KINDS, SiteReference, log_levels
from .window_classes import (
    CLASSES,
    EXPLANATION_COLUMNS,
    SMALLEST_PROBABILITY,
    checked_classes,
    explained,
    mirrored_classes,
    window_evidence,
)

MOST_EXPERTS = 32
# Where the training sites do not say.
PRIOR_S = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class EnsembleModel:
    """Coefficients of the ensemble, no rows of the data it was trained on.

    Parameters
    ----------
    experts : tuple of Expert
        At least one.
    class_prior : ndarray, shape (classes,)
        Class frequencies of the training set, mirrored rows included.
    home : SiteReference
        Mean reference of the training sites, mirrored ones included: stands in where no site is known.
    empty : ndarray, shape (features,)
        Mean log-levels of the training windows without any source: what a stream that is mostly empty is
        compared with, see `SiteEstimate`.
    domain : ModelDomain, optional
        What it was made for; `AcousticAdapter` refuses another array, rate or feature.
    prior_s : float
        Seconds of listening that weigh as much as the training sites: see `SiteEstimate`.
    classes : tuple of str
        Of a window, the columns of `predict_proba`: front, left, none, right, then both and direct where the
        model knows them.

    Raises
    ------
    InvalidArgumentError
        If the experts do not fit the reference or the classes, or the prior is none.

    Examples
    --------
    >>> expert = Expert("mean", np.zeros(6), np.ones(6), np.zeros((4, 6)), np.zeros(4))
    >>> model = EnsembleModel((expert,), np.full(4, 0.25), SiteReference(*np.zeros((3, 6))), np.zeros(6))
    >>> model.predict_proba(np.ones((1, 6)))
    array([[0.25, 0.25, 0.25, 0.25]])
    """

    LAYOUT: ClassVar = Layout(
        constants={"kind": "ensemble"}, order="classes class_prior home empty experts domain prior_s"
    )

    experts: tuple[Expert, ...]
    class_prior: FloatArray
    home: Annotated[SiteReference, Via(FloatArray, attrgetter("row"), SiteReference.from_row)]
    empty: FloatArray
    domain: ModelDomain | None = field(default=None, metadata=ADDED)
    prior_s: float = field(default=PRIOR_S, metadata=ADDED)
    classes: tuple[str, ...] = CLASSES

    def __post_init__(self) -> None:
        if not 0 < len(self.experts) <= MOST_EXPERTS:
            raise InvalidArgumentError(f"experts: expected 1 to {MOST_EXPERTS}, got {len(self.experts)}")
        known = (len(checked_classes(self.classes)),)
        freeze_arrays(self, class_prior=known, empty=(self.n_features,))
        if (self.class_prior <= 0).any() or not np.isclose(self.class_prior.sum(), 1.0, atol=1e-6):
            raise InvalidArgumentError("class_prior: expected positive numbers that sum to one")
        if self.n_features % SEGMENTS or self.n_features < 3 * SEGMENTS:
            raise InvalidArgumentError(f"home: expected {SEGMENTS} segments of 3 or more directions")
        in_range("prior_s", self.prior_s, 0.0, math.inf, open_high=True)
        finite_array("home", self.home.row, (len(KINDS) * self.n_features,))
        views = expert_views(VIEWS, self.home.mean[None], self.home.row[None])
        for expert in self.experts:
            inputs = views[expert.view].shape[1]
            if expert.mean.size != inputs:
                raise InvalidArgumentError(f"expert: expected {inputs} inputs, got {expert.mean.size}")
            check_shape("expert: intercepts", expert.intercepts.shape, known)

    @property
    def n_features(self) -> int:
        """Length of the feature vector of one window."""
        return int(self.home.mean.size)

    @property
    def reference_prior(self) -> tuple[float, ...]:
        """Training prior in the order of the explanations (left, right, visible, none)."""
        prior = explained(self.class_prior[None], self.classes, self.class_prior)[0]
        return tuple(prior[list(EXPLANATION_COLUMNS)].tolist())

    def predict_proba(self, X: ArrayLike) -> FloatArray:
        r"""Return the posteriors of the model's classes at the training prior, shape (n, classes).

        .. math:: P(c \mid x) \propto \exp \tfrac{1}{2 E} \sum_e
                  \big[ \ell_e(c, x) + \ell_e(\bar c, \bar x) \big], \qquad \sum_c P = 1

        Parameters
        ----------
        X : array_like, shape (n, features) or (n, 4 * features)
            Windows, or windows each with the `row` of its site's reference behind it.

        Raises
        ------
        InvalidArgumentError
            On another shape, NaN or infinity.

        References
        ----------
        C. Genest and J. V. Zidek, "Combining probability distributions: a critique and an annotated
        bibliography", Statist. Sci. 1, 1986 (the logarithmic pool).
        """
        return self.posteriors(*self._split(X))

    def posteriors(self, levels: FloatArray, reference: FloatArray) -> FloatArray:
        """Return what `predict_proba` does for log-levels, shape (n, features), and rows of references."""
        posteriors = np.maximum(np.exp(self._log_posteriors(levels, reference)), SMALLEST_PROBABILITY)
        return np.asarray(posteriors / total(posteriors))

    def explain(self, X: ArrayLike) -> FloatArray:
        r"""Return the posteriors of front, left, none and right alone, shape (n, 4).

        .. math:: P'_k = P_k + \tfrac{1}{2} P_{both} [k \text{ a side}] + P_{direct}\, \pi'_k / \sum \pi'

        Errors are those of `predict_proba`.

        Parameters
        ----------
        X : array_like, shape (n, features) or (n, 4 * features)
            As for `predict_proba`.

        References
        ----------
        Derived here: see the head of `worldstate.abduction.signature.window_classes`.
        """
        return explained(self.predict_proba(X), self.classes, self.class_prior)

    def evidence(self, feature: ArrayLike) -> SignatureEvidence:
        r"""Return the log-likelihoods of one window, shape (features,) or (4 * features,).

        .. math:: \log \ell_c = \log P_c - \log \pi_c

        Parameters
        ----------
        feature : array_like, shape (features,) or (4 * features,)
            One window, with its reference or without.

        Raises
        ------
        InvalidArgumentError
            On another shape, NaN or infinity.

        References
        ----------
        Bayes' rule; H. Bourlard and N. Morgan, *Connectionist Speech Recognition*, 1994 (scaled likelihoods).
        """
        return self.answer(*self._split(np.atleast_2d(feature)))

    def answer(self, levels: FloatArray, reference: FloatArray) -> SignatureEvidence:
        """Return what `evidence` does for log-levels, shape (1, features), and the row of a reference."""
        return window_evidence(self.posteriors(levels, reference), self.classes, self.class_prior)

    def _split(self, X: ArrayLike) -> tuple[FloatArray, FloatArray]:
        n_features = self.n_features
        inputs = finite_array("X", X, (None, None))
        if inputs.shape[1] not in (n_features, n_features * (1 + len(KINDS))):
            raise InvalidArgumentError(
                f"X: expected {n_features} features or {n_features * (1 + len(KINDS))} with a reference, "
                f"got shape {inputs.shape}"
            )
        if inputs.shape[1] > n_features:
            return split_reference(inputs)
        return log_levels(inputs), np.broadcast_to(self.home.row, (len(inputs), self.home.row.size))

    def _log_posteriors(self, levels: FloatArray, reference: FloatArray) -> FloatArray:
        n, wanted = len(levels), {expert.view for expert in self.experts}
        views = expert_views(
            wanted,
            np.concatenate([levels, mirror_features(levels, SEGMENTS)]),
            np.concatenate([reference, mirror_features(reference, SEGMENTS * len(KINDS))]),
        )
        told = [(expert, views[expert.view]) for expert in self.experts]
        sums = [expert.sums(half) for expert, seen in told for half in (seen[:n], seen[n:])]
        # One call for all experts: of a single window most of it is what calls cost.
        both = log_softmax(np.concatenate(sums)).reshape(len(told), 2, n, -1)
        # Added to each other first: the sum of two does not depend on which is the mirror image.
        pairs = both[:, 0] + both[:, 1][..., mirrored_classes(len(self.classes))]
        return log_softmax(pairs.sum(axis=0) / (2 * len(told)))


AnySignature = SignatureModel | EnsembleModel


def explain(signature: AnySignature, X: ArrayLike) -> FloatArray:
    """Return the posteriors of front, left, none and right of windows, shape (n, 4), by either model."""
    return signature.explain(X) if isinstance(signature, EnsembleModel) else signature.predict_proba(X)
