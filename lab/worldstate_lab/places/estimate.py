"""What is said of a place on the crossing street."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class KnownPlace:
    """A place along the crossing street, left positive, known to less than 5 m.

    Examples
    --------
    >>> KnownPlace(7.2, 1.4).std_m
    1.4
    """

    along_m: float
    std_m: float


@dataclass(frozen=True, slots=True)
class NearOrFar:
    """Which side is likelier, and how probable it is that the vehicle is near, where no place is known.

    Examples
    --------
    >>> NearOrFar("left", 0.3).near_probability
    0.3
    """

    side: str
    near_probability: float


@dataclass(frozen=True, slots=True)
class PlaceEstimate:
    """Belief about one vehicle on the crossing street; all but its existence given that there is one.

    Parameters
    ----------
    place : KnownPlace or NearOrFar
        What can be stated.
    mean_m, std_m : float
        Of the place along the street, left positive, whether it can be stated or not.
    interval_m : (float, float)
        From the 5 % to the 95 % quantile.
    left_probability, hidden_probability : float
        That it is left of the ego's axis; that a corner hides it.
    existence_probability : float
        That there is a vehicle.

    Examples
    --------
    >>> PlaceEstimate(KnownPlace(7.2, 1.4), 7.2, 1.4, (5.0, 9.5), 1.0, 0.98, 0.99).place.along_m
    7.2
    """

    place: KnownPlace | NearOrFar
    mean_m: float
    std_m: float
    interval_m: tuple[float, float]
    left_probability: float
    hidden_probability: float
    existence_probability: float
