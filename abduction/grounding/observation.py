"""Measurements of one source that accompany the classifier's feature."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.values import NotUsable


@dataclass(frozen=True, slots=True)
class Observable:
    """A number with its standard deviation, which comes from a bound or from the estimator itself."""

    value: float  # In the unit that the name says
    std: float  # Of the estimate, >= 0

    def __post_init__(self) -> None:
        finite_array("value", self.value, ())
        in_range("std", self.std, 0.0, float("inf"), open_high=True)


NOT_MEASURED = NotUsable("not measured")


@dataclass(frozen=True, slots=True)
class GroundedObservation:
    """The front-end's statistics y = (s, theta, v) besides the classifier's scores.

    Parameters
    ----------
    bearing_rad : Observable or NotUsable
        Azimuth, left positive.
    radial_speed_m_s : Observable or NotUsable
        From Doppler, positive while closing.
    inverse_tta_hz : Observable or NotUsable
        From looming, 1/s.
    signature : mapping of str to Observable
        Observables that descriptors couple to speed, such as ``line_spacing_hz``; those that are missing are
        marginalised.

    Examples
    --------
    >>> GroundedObservation().bearing_rad
    NotUsable(reason='not measured')
    """

    bearing_rad: Observable | NotUsable = NOT_MEASURED
    radial_speed_m_s: Observable | NotUsable = NOT_MEASURED
    inverse_tta_hz: Observable | NotUsable = NOT_MEASURED
    signature: Mapping[str, Observable] = field(default_factory=dict)
