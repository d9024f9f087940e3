"""Sectors that a second sensor searches, its results (co-evidence) and its miss rate.

A result is present, absent or unqueried. Absence is a measurement and has its own type. A sensor that did
not search the sector gives neither presence nor absence: `Unqueried`, beta = 1. The miss rate
beta_c(theta, d) never falls with azimuth or degradation.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground import TINY, FloatArray, InvalidArgumentError, finite_array, wrap_angle
from worldstate.ground.checks import ABOVE_ZERO, BELOW_ONE, check_fields
from worldstate.ground.serialisation import Layout


@dataclass(frozen=True, slots=True)
class Sector:
    """A range of azimuths.

    Parameters
    ----------
    centre_rad, half_width_rad : float
        Centre in `base_link`, left positive, and half the width.

    Examples
    --------
    >>> Sector(0.0, 0.2).touches(0.25, width_rad=0.12), Sector(0.0, 0.2).touches(0.3)
    (True, False)
    """

    centre_rad: float
    half_width_rad: float

    def touches(self, azimuth_rad: float, width_rad: float = 0.0) -> bool:
        """Return whether an object of this width, centred at the azimuth, reaches into the sector."""
        return abs(wrap_angle(azimuth_rad - self.centre_rad)) <= self.half_width_rad + width_rad / 2

    def overlap(self, other: "Sector") -> "Sector | None":
        """Return the intersection with another sector or None; both together span less than a full turn."""
        offset = wrap_angle(self.centre_rad - other.centre_rad)
        low = max(offset - self.half_width_rad, -other.half_width_rad)
        high = min(offset + self.half_width_rad, other.half_width_rad)
        if high <= low:
            return None
        return Sector(wrap_angle(other.centre_rad + (low + high) / 2), (high - low) / 2)

    def midpoints(self, n: int) -> FloatArray:
        """Return the centres of n equal parts, radians, shape (n,), not wrapped."""
        return self.centre_rad + self.half_width_rad * ((2.0 * np.arange(n) + 1.0) / n - 1.0)

    @classmethod
    def between(cls, right_rad: float, left_rad: float) -> "Sector":
        """Return the sector from `right_rad` leftwards to `left_rad`, at most a full turn."""
        if left_rad - right_rad >= 2.0 * math.pi:
            return cls(0.0, math.pi)
        half = (left_rad - right_rad) % (2.0 * math.pi) / 2.0
        return cls(wrap_angle(right_rad + half), half)

    @classmethod
    def in_sight(cls, right_rad: Iterable[float], left_rad: Iterable[float]) -> "Sector":
        """Return the free sector ahead between the edges of occluders.

        Examples
        --------
        >>> sector = Sector.in_sight([-0.56], [0.56])
        >>> sector.touches(0.5), sector.touches(0.7)
        (True, False)
        """
        return cls.between(max(right_rad, default=-math.pi / 2), min(left_rad, default=math.pi / 2))


@dataclass(frozen=True, slots=True)
class Absent:
    """The sector was searched and the co-evidence was not found.

    Parameters
    ----------
    miss_rate : float
        beta_c(theta, d): probability that a visible source of this class is missed, in [0, 1].
    clutter_rate : float
        Probability that the channel reports co-evidence without a source, in [0, 1).

    Examples
    --------
    >>> Absent(miss_rate=0.04).log_likelihoods().round(3)
    array([ 0.   , -3.219,  0.   ])
    """

    miss_rate: float
    clutter_rate: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self, miss_rate=(0.0, 1.0), clutter_rate=(0.0, BELOW_ONE))

    def log_likelihoods(self) -> np.ndarray:
        r"""Log p(absent | hidden, visible, none), shape (3,), nats; -inf where impossible.

        .. math:: p = \big(1 - \kappa,\; \beta\, (1 - \kappa),\; 1 - \kappa\big)

        with beta the miss rate and kappa the clutter rate.

        Returns
        -------
        ndarray, shape (3,)
            Nats.

        References
        ----------
        "Evidence of Absence", eq. (6). An empty sector also requires that there is no false detection.
        """
        spurious = np.log1p(-self.clutter_rate)
        with np.errstate(divide="ignore"):
            missed = np.log(self.miss_rate)
        return np.array([spurious, missed + spurious, spurious]) + 0.0


@dataclass(frozen=True, slots=True)
class Present:
    """The sector was searched and the co-evidence was found.

    Parameters
    ----------
    miss_rate : float
        beta_c(theta, d) of the channel, in [0, 1].
    clutter_rate : float
        Probability of co-evidence without such a source, in (0, 1). At zero, a single false detection would
        remove the hidden explanation permanently.

    Examples
    --------
    >>> Present(miss_rate=0.04, clutter_rate=0.01).log_likelihoods().round(2)
    array([-4.61, -0.04, -4.61])
    """

    miss_rate: float
    clutter_rate: float = 0.01

    def __post_init__(self) -> None:
        check_fields(self, miss_rate=(0.0, 1.0), clutter_rate=(ABOVE_ZERO, BELOW_ONE))

    def log_likelihoods(self) -> np.ndarray:
        r"""Log p(present | hidden, visible, none), shape (3,), nats.

        .. math:: p = \big(\kappa,\; 1 - \beta\, (1 - \kappa),\; \kappa\big)

        with beta the miss rate and kappa the clutter rate.

        Returns
        -------
        ndarray, shape (3,)
            Nats.

        References
        ----------
        Derived here as the complement of `Absent`.
        """
        beta, kappa = self.miss_rate, self.clutter_rate
        # This form of the sum keeps a small clutter rate if beta is 1.
        spurious, found = np.log([kappa, (1.0 - beta) + beta * kappa])
        return np.array([spurious, found, spurious])


@dataclass(frozen=True, slots=True)
class Unqueried:
    """The channel did not search the sector: no image, outside its field of view, or no such sensor.

    Parameters
    ----------
    reason : str
        Explanation for people and logs.

    Examples
    --------
    >>> Unqueried("no detections file").log_likelihoods()
    array([0., 0., 0.])
    """

    reason: str

    def __post_init__(self) -> None:
        check_fields(self, reason=str)

    def log_likelihoods(self) -> np.ndarray:
        """Zero for every explanation, shape (3,): with beta = 1 the posterior does not change.

        ``log p = 0`` for all.

        Returns
        -------
        ndarray, shape (3,)
            Zeros.

        References
        ----------
        "Evidence of Absence", eq. (6) with beta = 1.
        """
        return np.zeros(3)


CoEvidence = Absent | Present | Unqueried


Rows = tuple[tuple[float, ...], ...]

# A channel with a higher miss rate does not observe its sector: with it, a visible vehicle would count as
# none.
MOSTLY_MISSED = 0.5


@dataclass(frozen=True, slots=True)
class MissRateTable:
    r"""Probability that a visible source is missed, over azimuth and degradation.

    .. math:: \beta_c(\theta, d) = p(V = absent \mid h_{vis}, \theta, d),

    bilinear between the points of the table and equal on both sides. It is 1 beyond the last azimuth, which
    is outside the view, and beyond the last degradation, which was not measured. A table that falls with
    azimuth or degradation is rejected, because it was fitted on too few data.

    Parameters
    ----------
    azimuth_deg : tuple of float
        Azimuth magnitudes, increasing from 0 to the edge of the view, degrees.
    degradation : tuple of float
        Degradation levels d, increasing from 0 (clean) to at most 1 (blind).
    beta : tuple of tuple of float
        Miss rates in [0, 1], one row per azimuth and one column per degradation.
    per_class : mapping of str to tuple of tuple of float
        Separate rows for some classes; all others use `beta`.

    Raises
    ------
    InvalidArgumentError
        If the axes do not increase or do not fit, or a rate falls or is outside [0, 1].

    Examples
    --------
    >>> table = MissRateTable((0, 30), (0, 1), ((0.04, 0.9), (0.14, 1.0)))
    >>> round(table(np.radians(15.0), 0.0), 3), table(np.radians(40.0), 0.0)
    (0.09, 1.0)
    """

    LAYOUT: ClassVar = Layout("worldstate.MissRateTable", "1.0.0")

    azimuth_deg: tuple[float, ...]
    degradation: tuple[float, ...]
    beta: Rows
    per_class: Mapping[str, Rows] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_axis("azimuth_deg", self.azimuth_deg, math.degrees(math.pi))
        _check_axis("degradation", self.degradation, 1.0)
        for label, rows in {"beta": self.beta, **self.per_class}.items():
            rates = finite_array(label, rows, (len(self.azimuth_deg), len(self.degradation)))
            if not ((rates >= 0.0) & (rates <= 1.0)).all():
                raise InvalidArgumentError(f"{label}: expected miss rates in [0, 1]")
            if (np.diff(rates, axis=0) < 0.0).any() or (np.diff(rates, axis=1) < 0.0).any():
                problem = "expected miss rates that never fall with azimuth or degradation"
                raise InvalidArgumentError(f"{label}: {problem}")

    def __call__(self, azimuth_rad: float, degradation: float = 0.0, label: str | None = None) -> float:
        """Return beta at one azimuth (radians, any sign) and degradation in [0, 1]."""
        return float(self.over(np.array([azimuth_rad]), degradation, label)[0])

    def over(
        self, azimuths_rad: FloatArray, degradation: float = 0.0, label: str | None = None
    ) -> FloatArray:
        """Return beta at several azimuths, shape (n,), and one degradation."""
        # A single comparison, because this runs many times per hop; NaN fails it too.
        if not 0.0 <= degradation <= 1.0:
            raise InvalidArgumentError(f"degradation: expected a number in [0, 1], got {degradation}")
        magnitude_deg = np.abs(np.degrees(azimuths_rad))
        if degradation > self.degradation[-1]:
            return np.ones_like(magnitude_deg)
        rows = self.beta if label is None else self.per_class.get(label, self.beta)
        along = [float(np.interp(degradation, self.degradation, row)) for row in rows]
        return np.interp(magnitude_deg, self.azimuth_deg, along, right=1.0)


def default_miss_rates() -> MissRateTable:
    r"""Return the table that is used if none was measured.

    .. math:: \beta(\theta, d) = (1 - d)\, \min(0.04 + 0.004\, |\theta_{deg}|,\; 0.97) + 0.97\, d

    Examples
    --------
    >>> table = default_miss_rates()
    >>> round(table(0.0), 2), round(table(np.radians(-25.0)), 2), round(table(0.0, 1.0), 2), table(1.6)
    (0.04, 0.14, 0.97, 1.0)
    """
    # Measured in the paper on clean images: 0.04 at boresight and 0.14 at 25 degrees. The increase continues
    # over the half plane, because the camera's own angle of view is the limit. Under the strongest noise it
    # is 0.97.
    boresight, abeam_deg = 0.04, math.degrees(0.5 * math.pi)
    clean = boresight, boresight + boresight / 10.0 * abeam_deg
    return MissRateTable((0.0, abeam_deg), (0.0, 1.0), tuple((rate, 0.97) for rate in clean))


def _check_axis(name: str, values: tuple[float, ...], limit: float) -> None:
    axis = finite_array(name, values, (None,))
    if axis.size < 2 or axis[0] != 0.0 or axis[-1] > limit or (np.diff(axis) <= 0).any():
        raise InvalidArgumentError(f"{name}: expected numbers that increase from 0 to at most {limit}")


# Enough to converge far below the resolution of a measured miss rate.
_SWEEPS = 2000


def isotonic_grid(values: ArrayLike, weights: ArrayLike) -> FloatArray:
    r"""Return the grid closest to `values` that does not fall along rows or columns.

    .. math:: \min_g \sum_{ij} w_{ij} (g_{ij} - v_{ij})^2 \quad \text{subject to} \quad
              g_{ij} \le g_{i+1,j},\ g_{ij} \le g_{i,j+1},

    Shapes: values (rows, columns), weights (rows, columns).

    References
    ----------
    Dykstra and Robertson, "An algorithm for isotonic regression for two or more independent variables", 1982.
    """
    # Dykstra's alternating projections onto the two sets; each projection pools adjacent violators.
    grid = finite_array("values", values, (None, None)).copy()
    weight = finite_array("weights", weights, grid.shape)
    if not grid.size or (weight <= 0).any():
        raise InvalidArgumentError("weights: expected a grid of positive numbers")
    along_rows, along_columns = np.zeros_like(grid), np.zeros_like(grid)
    for _ in range(_SWEEPS):
        before = grid
        by_row = _pooled_rows(grid + along_rows, weight)
        along_rows += grid - by_row
        grid = _pooled_rows((by_row + along_columns).T, weight.T).T
        along_columns += by_row - grid
        if max(np.abs(grid - before).max(), np.abs(grid - by_row).max()) < TINY:
            break
    # The remaining error of the iteration is negligible, but it must not break the order.
    return np.maximum.accumulate(np.maximum.accumulate(grid, axis=0), axis=1)


def _pooled_rows(values: FloatArray, weights: FloatArray) -> FloatArray:
    """Pool adjacent violators of every row."""
    # Imported here to save 0.4 s in commands that do not need it.
    from scipy.optimize import isotonic_regression

    pairs = zip(values, weights, strict=True)
    return np.array([isotonic_regression(value, weights=weight).x for value, weight in pairs])
