"""Training of the ensemble on every window and its mirror image, with one softmax regression per view."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import starmap
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground import TINY, InvalidArgumentError, finite_array
from worldstate.ground.extras import optional
from worldstate.ground.typing import AnyArray, FloatArray, IndexArray, TextArray

from . import ensemble
from .site_estimate import SiteEstimate
from .window_classes import CLASSES, FRONT, LEFT, NONE, RIGHT, WINDOW_CLASSES, mirrored_classes

# Weight of a simulated window relative to a real one, and the part of it with the label of the other side.
# With weights from 0.5 to 3 and parts from 0.15 to 0.35, the AUROC at left-out real junctions changes by at
# most 0.002 and the share of right sides by at most 0.03. The side is right in 93 % of the windows; in 85 %
# without such a part and in 84 % with a part of 0.5.
SIMULATED_WEIGHT, OTHER_SIDE = 1.0, 0.25
# Part of a real window's weight that is used with the site estimate before that window. A larger part costs a
# standing ego 0.01 of the AUROC at the worst junction, and no such part costs a moving ego 0.01.
HEARD_PART = 0.25
# Site name of sounds without a street; training always uses them, also if sites are left out.
OPEN_FIELD = "open field"
_ITERATIONS = 1000
_WINDOW_S = 1.0
_LONGEST = 60.0


@dataclass(frozen=True, slots=True)
class Recipe:
    """View and ridge penalty of one expert."""

    view: str  # See `Expert`
    ridge: float  # Factor of half the squared norm of the coefficients relative to the mean log loss, > 0


# Chosen on eight junctions, each choice evaluated on a junction that was not used for it: lab/NOTES.md.
_RIDGES = dict.fromkeys(ensemble.KINDS, 0.001) | {ensemble.SHAPE: 1e-1, ensemble.SHAPE_CHANGE: 1e-2}
RECIPES = tuple(starmap(Recipe, _RIDGES.items()))
# For a moving ego: its own noise covers the level, which a ridge penalty favours. The pattern relative to the
# reference remains usable, so it is penalised less.
MOVING_RECIPES = tuple(
    replace(one, ridge=0.3 * one.ridge) if one.view in ensemble.KINDS else one for one in RECIPES
)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedWindows:
    """Simulated training windows, each followed by the reference of its site."""

    X: FloatArray  # shape (n, 4 * features); a reference of NaN is replaced by that of the training sites
    y: TextArray  # shape (n,): Names of `WINDOW_CLASSES`
    sites: TextArray  # shape (n,): Site names; a left-out site is excluded from real and simulated windows
    weights: FloatArray  # shape (n,): Relative to a real window of weight 1
    other_side: FloatArray  # shape (n,): Part of a hazard's weight that has the label of the other side

    def at(self, sites: AnyArray) -> "SimulatedWindows":
        """Return the windows of these sites and of the open field."""
        chosen = np.isin(self.sites, [*np.unique(sites).tolist(), OPEN_FIELD])
        return SimulatedWindows(*(getattr(self, column.name)[chosen] for column in fields(self)))

    def beside(self, sites: AnyArray) -> "SimulatedWindows":
        """Return all windows for a table of these sites; windows of other sites move to the open field.

        With their own site names, they would not be used in training with a table of real sites.
        """
        return replace(self, sites=np.where(np.isin(self.sites, np.unique(sites)), self.sites, OPEN_FIELD))

    @classmethod
    def joined(cls, parts: Sequence["SimulatedWindows"]) -> "SimulatedWindows":
        """Return the windows of all parts in one object."""
        return cls(*(np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(cls)))


class SiteEnsembleClassifier:
    """Trainer of `EnsembleModel` in the style of scikit-learn; it is deterministic.

    Parameters
    ----------
    recipes : sequence of Recipe
        One recipe per expert.
    simulated : SimulatedWindows, optional
        Additional training windows; those of sites in the training set are used.

    Attributes
    ----------
    model_ : EnsembleModel
        The trained model, set by `fit`.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> y = np.repeat(CLASSES, 10)
    >>> windows = np.exp(rng.normal(size=(40, 60)) + np.repeat(np.arange(4), 10)[:, None])
    >>> X = np.hstack([windows, np.zeros((40, 180))])
    >>> SiteEnsembleClassifier().fit(X, y).predict_proba(X).shape
    (40, 4)
    """

    model_: ensemble.EnsembleModel

    def __init__(
        self, recipes: Sequence[Recipe] = RECIPES, simulated: SimulatedWindows | None = None
    ) -> None:
        self.recipes, self.simulated = recipes, simulated

    def fit(
        self,
        X: ArrayLike,
        y: ArrayLike,
        groups: ArrayLike | None = None,
        heard: Sequence[SiteEstimate] | None = None,
    ) -> Self:
        r"""Fit the model to class names and windows, each followed by the reference of its site.

        .. math:: \hat W_e, \hat b_e = \arg\min_{W, b} \Big[ \frac{\lambda_e}{2} \|W\|^2
                  - \frac{\sum_i w_i \ell_e(c_i, x_i)}{\sum_i w_i} \Big]

        Real windows have the weight 1 and simulated ones their own. A part of a simulated hazard's weight can
        have the label of the other side, because simulated streets represent presence better than sides. With
        `heard`, a quarter of a real window's weight is used with the site estimate before that window, and
        the rest with the appended reference. The model has the classes both and direct if there are simulated
        windows of them.

        Parameters
        ----------
        X : array_like, shape (n, 4 * features)
            Levels of each window, followed by the mean, median and quiet reference of its site.
        y : array_like of str, shape (n,)
            Labels: front, left, none or right.
        groups : array_like of str, shape (n,), optional
            Names of sites, from which the duration `prior_s` is computed.
        heard : sequence of SiteEstimate, length n, optional
            Site estimate before each window, as during operation.

        Returns
        -------
        SiteEnsembleClassifier
            The object itself.

        Raises
        ------
        InvalidArgumentError
            If X has another shape or is not finite, or a class is missing or unknown.

        References
        ----------
        S. le Cessie and J. C. van Houwelingen, "Ridge estimators in logistic regression", Appl. Statist. 41,
        1992.
        """
        inputs = finite_array("X", X, (None, None))
        if inputs.shape[1] % (ensemble.SEGMENTS * (1 + len(ensemble.KINDS))):
            raise InvalidArgumentError(f"X: expected windows with a reference, got shape {inputs.shape}")
        codes = _codes(checked_labels(y, len(inputs)))
        sites = None if groups is None else np.asarray(groups)
        (windows, learned), empty = ensemble.split_reference(inputs), codes == NONE
        prior_s = ensemble.PRIOR_S if sites is None else _prior_s(windows[empty], sites[empty])
        real, ones = _with_mirror_images(windows, learned, codes), np.ones(2 * len(codes))
        home, silence = real[1].mean(axis=0), real[0][real[2] == NONE].mean(axis=0)
        rows = [(*real, ones)]
        if heard is not None:
            again = np.array([one.beside(home, silence, prior_s) for one in heard])
            more = _with_mirror_images(windows, again, codes)
            rows = [(*real, (1.0 - HEARD_PART) * ones), (*more, HEARD_PART * ones)]
        if self.simulated is not None and sites is not None:
            rows.append(_simulated_rows(self.simulated.at(sites), home))
        levels, reference, codes, weights = map(np.concatenate, zip(*rows, strict=True))
        # The four classes and the additional ones with windows; scikit-learn sorts its columns equally.
        known = np.union1d(np.arange(len(CLASSES)), codes)
        views = ensemble.expert_views(levels, reference)
        self.model_ = ensemble.EnsembleModel(
            tuple(_fit_expert(recipe, views[recipe.view], codes, weights) for recipe in self.recipes),
            np.bincount(codes, weights)[known] / weights.sum(),
            home,
            silence,
            prior_s=prior_s,
            classes=tuple(WINDOW_CLASSES[code] for code in known),
        )
        return self

    def predict_proba(self, X: ArrayLike) -> FloatArray:
        """Return the posteriors of front, left, none and right, shape (n, 4), as `EnsembleModel.explain`.

        Parameters
        ----------
        X : array_like, shape (n, 4 * features)
            Windows, each followed by the reference of its site.
        """
        return self.model_.explain(X)


def checked_labels(y: ArrayLike, n: int) -> TextArray:
    """Return class names as an array; front, none and at least one side must be present.

    Shapes: y (n,).

    Examples
    --------
    >>> checked_labels(["none", "left", "front"], 3)
    array(['none', 'left', 'front'], dtype='<U5')
    """
    labels = np.asarray(y, dtype=np.str_)
    if labels.shape != (n,):
        raise InvalidArgumentError(f"y: expected {n} class names, got shape {labels.shape}")
    present = set(labels.tolist())
    hazards = {CLASSES[LEFT], CLASSES[RIGHT]}
    if not present <= set(CLASSES) or not {CLASSES[FRONT], CLASSES[NONE]} <= present or not present & hazards:
        raise InvalidArgumentError(f"y: expected the classes {CLASSES}, got {sorted(present)}")
    return labels


def _with_mirror_images(
    levels: FloatArray, reference: FloatArray, codes: IndexArray
) -> tuple[FloatArray, FloatArray, IndexArray]:
    """Append the mirror image of every window, so that class frequencies do not change."""
    mirrored_reference = ensemble.mirror_features(reference, ensemble.SEGMENTS * len(ensemble.KINDS))
    return (
        np.concatenate([levels, ensemble.mirror_features(levels, ensemble.SEGMENTS)]),
        np.concatenate([reference, mirrored_reference]),
        np.concatenate([codes, _mirrored(codes)]),
    )


def _simulated_rows(
    windows: SimulatedWindows, home: FloatArray
) -> tuple[FloatArray, FloatArray, IndexArray, FloatArray]:
    """Return log-levels, references, classes and weights; rows with the other side come last."""
    levels, reference = ensemble.split_reference(windows.X)
    reference = np.where(np.isnan(reference), home, reference)
    codes = _codes(windows.y)
    other = _mirrored(codes)
    hidden = np.flatnonzero(other != codes)
    part = np.where(other != codes, windows.other_side, 0.0)
    rows, sides = np.r_[: len(codes), hidden], np.r_[codes, other[hidden]]
    weights = np.r_[1.0 - part, part[hidden]] * windows.weights[rows]
    return (*_with_mirror_images(levels[rows], reference[rows], sides), np.tile(weights, 2))


def _codes(labels: TextArray) -> IndexArray:
    """Return the index of each name in `WINDOW_CLASSES`."""
    return np.array([WINDOW_CLASSES.index(label) for label in labels.tolist()], np.intp)


def _mirrored(codes: IndexArray) -> IndexArray:
    return np.array(mirrored_classes(len(WINDOW_CLASSES)))[codes]


def _prior_s(levels: FloatArray, sites: AnyArray) -> float:
    r"""Return the duration after which a site's own mean is as accurate as that of the training sites.

    .. math:: h_0 = \Delta t\, \frac{\sigma_{within}^2}{\sigma_{between}^2}, \qquad
              \sigma_{between}^2 = \mathrm{var}_s\, \bar x_s - \sigma_{within}^2 \langle 1 / n_s \rangle

    for the patterns of empty windows of one second, without their mean level.

    Shapes: levels (n, features), sites (n,).
    """
    patterns = levels - levels.mean(axis=1, keepdims=True)
    parts = [patterns[sites == site] for site in np.unique(sites)]
    if len(parts) < 2 or min(map(len, parts)) < 2:
        return ensemble.PRIOR_S
    within = float(np.mean([part.var(axis=0, ddof=1).mean() for part in parts]))
    scatter = float(np.var([part.mean(axis=0) for part in parts], axis=0, ddof=1).mean())
    between = scatter - within * float(np.mean([1.0 / len(part) for part in parts]))
    # If sites differ only by chance, there is no pattern to learn.
    return _WINDOW_S * within / max(between, within / _LONGEST)


def _fit_expert(recipe: Recipe, seen: FloatArray, codes: IndexArray, weights: FloatArray) -> ensemble.Expert:
    mean, scale = standardisation(seen, weights)
    regression = optional("sklearn.linear_model").LogisticRegression
    machine = regression(C=1.0 / (recipe.ridge * weights.sum()), max_iter=_ITERATIONS)
    machine.fit((seen - mean) / scale, codes, weights)
    return ensemble.Expert(recipe.view, mean, scale, machine.coef_, machine.intercept_)


def standardisation(inputs: FloatArray, weights: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
    r"""Return the weighted mean and standard deviation of each column; 1 for a constant column.

    .. math:: \mu = \sum_i w_i x_i, \qquad \sigma^2 = \sum_i w_i (x_i - \mu)^2, \qquad \sum_i w_i = 1

    Shapes: inputs (n, columns), weights (n,), returns (columns,).

    Examples
    --------
    >>> standardisation(np.array([[1.0, 5.0], [3.0, 5.0]]))
    (array([2., 5.]), array([1., 1.]))
    """
    mean = np.average(inputs, axis=0, weights=weights)
    deviation = np.sqrt(np.average((inputs - mean) ** 2, axis=0, weights=weights))
    # A constant column has no information and is not scaled.
    return mean, np.where(deviation > TINY, deviation, 1.0)
