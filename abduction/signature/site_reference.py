r"""Reference of a site: unlabelled summaries that features are compared with.

A feature is a row of positive levels, so the comparison is a difference of logarithms: reflections that every
window of a junction shares drop out, and a classifier trained elsewhere meets what it knows.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground import FloatArray, InvalidArgumentError, finite_array

SMALLEST_LEVEL = 1e-4
QUIET_SHARE = 0.35
KINDS = ("mean", "median", "quiet")


@dataclass(frozen=True, slots=True, eq=False)
class SiteReference:
    """Three unlabelled summaries of the log-levels at one site.

    Examples
    --------
    >>> site_reference(np.log([[1.0, 2.0], [1.0, 4.0], [1.0, 8.0]])).median.round(2)
    array([0.  , 1.39])
    """

    mean: FloatArray  # shape (features,): Over all windows
    median: FloatArray
    # shape (features,): Mean over the 35 % of the windows whose loudest feature is the least: close to what
    # the site is like while no vehicle comes, whatever share of the windows that is.
    quiet: FloatArray

    @property
    def row(self) -> FloatArray:
        """The three summaries one after the other, shape (3 * features,): what stands behind a window."""
        return np.concatenate([getattr(self, kind) for kind in KINDS])

    @classmethod
    def from_row(cls, row: ArrayLike) -> "SiteReference":
        """Return the reference whose `row` this is.

        Shapes: row (3 * features,).
        """
        values = finite_array("reference", row, (None,))
        if values.size % len(KINDS):
            raise InvalidArgumentError(f"reference: expected a multiple of three numbers, got {values.size}")
        return cls(*values.reshape(len(KINDS), -1))

    def shifted(self, offset: ArrayLike) -> "SiteReference":
        """Return the reference of a site whose log-levels are higher by `offset`, shape (features,).

        Shapes: offset (features,).
        """
        # `r' = r + offset` for each of the three.
        return SiteReference(*(getattr(self, kind) + np.asarray(offset) for kind in KINDS))


def log_levels(X: ArrayLike) -> FloatArray:
    r"""Return the natural logarithm of levels, silence held at 1e-4.

    .. math:: x = \ln \max(X, 10^{-4})

    Examples
    --------
    >>> log_levels([[1.0, 0.0]]).round(2)
    array([[ 0.  , -9.21]])
    """
    return np.log(np.maximum(np.asarray(X, dtype=np.float64), SMALLEST_LEVEL))


def site_reference(levels: ArrayLike) -> SiteReference:
    r"""Return the reference of a site from its windows, shape (windows, features), natural logarithms.

    .. math:: r = \big(\langle x \rangle,\; \mathrm{median}\, x,\;
              \langle x \mid \max_a x_a \le q_{0.35} \rangle\big)

    Shapes: levels (windows, features).

    Examples
    --------
    >>> site_reference(np.array([[0.0, 1.0], [2.0, 3.0]])).row
    array([1., 2., 1., 2., 0., 1.])
    """
    windows = finite_array("levels", levels, (None, None))
    if not len(windows):
        raise InvalidArgumentError("levels: expected at least one window")
    loudest = windows.max(axis=1)
    quiet = windows[loudest <= np.quantile(loudest, QUIET_SHARE)]
    return SiteReference(windows.mean(axis=0), np.median(windows, axis=0), quiet.mean(axis=0))
