"""Untrained baseline: the level of the loudest direction."""

from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.signature.site_reference import log_levels
from worldstate.abduction.signature.window_classes import CLASSES, FRONT, LEFT, NONE, RIGHT
from worldstate.ground.typing import FloatArray


class LoudestDirection:
    """Hazard odds equal to the highest level of the spatial spectrum; learns nothing.

    Examples
    --------
    >>> LoudestDirection().fit([[0.1]], ["none"]).predict_proba([[0.25, 1.0]])
    array([[0.  , 0.25, 0.5 , 0.25]])
    """

    def fit(self, X: ArrayLike, y: ArrayLike, groups: ArrayLike | None = None) -> Self:
        """Do nothing."""
        return self

    def predict_proba(self, X: ArrayLike) -> FloatArray:
        """Return posteriors of front, left, none, right, shape (n, 4): no side is preferred."""
        odds = np.exp(log_levels(X).max(axis=1))
        posteriors = np.zeros((len(odds), len(CLASSES)))
        posteriors[:, NONE] = 1.0 / (1.0 + odds)
        posteriors[:, LEFT] = posteriors[:, RIGHT] = odds / (1.0 + odds) / 2.0
        posteriors[:, FRONT] = 0.0
        return posteriors
