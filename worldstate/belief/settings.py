"""Settings of the filter."""

from dataclasses import dataclass, fields

from worldstate.ground import InvalidArgumentError, in_range
from worldstate.ground.serialisation import Probability


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """How often evidence counts, and thresholds of birth and death; all else is a constant where it counts.

    Parameters
    ----------
    window_s : float
        Length of the window that a signature is computed on. Windows that overlap repeat most of their
        samples: explanations build on the belief of one window ago, and a bearing or approach rate
        weighs kappa = (time since the last one) / window, at most 1.
    look_interval_s : float
        Looks of the co-evidence channel closer in time than this repeat each other's misses (same object,
        same light, same detector), so to the existence of a visible entity a look weighs (time since the
        last one) / interval, at most 1.
    birth_probability, death_probability : float
        A hidden entity is born when P(hidden on its side) reaches the first, or an advisory names its
        side, and dropped when its existence falls below the second.
    delete_existence : float
        A visible entity is dropped below this existence.
    births_per_look : float
        New road users that a look finds, on the mean: against the clutter rate of the look and the score of
        a detection it decides how far a first detection is believed.
    assumed_certainty : float
        Probability that an occluder stands where the context only assumes one.
    hidden_return : float
        Probability that a radar detects what an occluder hides, over that of what is in line of sight.
    width_change : float
        Standard deviation of the logarithm of an entity's width from box to box.
    size_spread : float
        Standard deviation of the logarithm of the widths of road users: of two at one azimuth the wider box
        is the nearer one as far as this allows.
    stream : str
        Name that entity ids are derived from: the same stream gives the same ids.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> FilterSettings(birth_probability=0.6).window_s
    1.0
    """

    window_s: float = 1.0  # Of the published feature
    look_interval_s: float = 0.3  # Three images at 10 Hz: misses of consecutive images repeat each other
    # Far apart: with one threshold for both, a belief that wavers about it would change ids at every hop.
    birth_probability: Probability = 0.5
    death_probability: Probability = 0.1
    # Three full looks that find nothing take .99 below it, at a miss rate of .04.
    delete_existence: Probability = 0.05
    births_per_look: float = 0.05  # Assumed: one new road user in twenty images
    assumed_certainty: Probability = 0.9  # Assumed
    hidden_return: Probability = 0.1  # Assumed
    width_change: float = 0.3  # Assumed: the box of what comes past an edge grows by a third an image
    size_spread: float = 0.5  # Assumed: from persons of 0.6 m to vans of 4.6 m seen from the side
    stream: str = "worldstate"

    def __post_init__(self) -> None:
        for field in fields(self):
            if field.type is not str:
                high = 1.0 if field.type is Probability else 1e6
                in_range(field.name, getattr(self, field.name), 0.0, high, open_low=True)
        if self.death_probability > self.birth_probability:
            raise InvalidArgumentError("death_probability: expected at most birth_probability")
