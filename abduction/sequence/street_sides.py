r"""From which arm of a known street somebody comes, by the directions in which the sound arrives.

Walls throw the sound of one arm to the other side, or they do not: a pattern that means left at one
junction means right at the next. Where passes have told what either arm sounds like, the pattern x of a
window leans to one of them by a linear discriminant,

.. math:: s = g\, c \tanh\!\Big( \frac{w^\top x + b}{c} \Big)

with g the certainty that few passes leave, and of those who come, the share on either side moves by s in
log-odds; whether somebody comes does not.
"""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.checks import freeze_arrays, in_range
from worldstate.ground.typing import FloatArray

from .sequence_model import COMING_S, GROUPS

# Neighbouring azimuths of the spatial spectrum together, 15 degrees of half a circle.
SECTORS = 12
# The sequence has read the same sound, and windows overlap: none counts for more.
_MOST_NATS = 3.0
_COMING, _OTHER = len(COMING_S), GROUPS.index("other")
_SMALLEST = 1e-12


def arrival_pattern(feature: FloatArray) -> FloatArray:
    """Return how the level lies over `SECTORS` sectors, nats above its mean; shape (n, 12) of (n, azimuths).

    Examples
    --------
    >>> even = np.ones((1, 60))
    >>> arrival_pattern(even).shape, float(arrival_pattern(even).max())
    ((1, 12), 0.0)
    """
    level = np.log(np.asarray(feature, np.float64))
    sectors = np.stack([part.mean(axis=-1) for part in np.array_split(level, SECTORS, axis=-1)], axis=-1)
    return np.asarray(sectors - sectors.mean(axis=-1, keepdims=True))


def somebody_comes(groups: FloatArray) -> FloatArray:
    """Return the chance that somebody comes from either side, shape (...,) of posteriors (..., 2, groups)."""
    return np.asarray((groups[..., :_COMING].sum(axis=-1) + groups[..., _OTHER]).mean(axis=-1))


@dataclass(frozen=True, slots=True, eq=False)
class StreetSides:
    """Which pattern means which arm at one place, heard by one array.

    Examples
    --------
    >>> sides = StreetSides(np.linspace(1.0, -1.0, SECTORS), 0.0, certainty=0.8, heard_by="roof")
    >>> left = np.exp(np.linspace(1.0, -1.0, 60))[None]
    >>> bool(sides.log_ratio(left)[0] > 1.0)
    True
    """

    weights: FloatArray  # shape (12,): Per nat of a sector
    offset: float
    certainty: float  # In [0, 1]: of few passes, less
    heard_by: str  # Array and feature that the patterns were heard with

    def __post_init__(self) -> None:
        freeze_arrays(self, weights=(SECTORS,))
        in_range("offset", self.offset, -1e9, 1e9)
        in_range("certainty", self.certainty, 0.0, 1.0)

    def log_ratio(self, feature: FloatArray) -> FloatArray:
        """Return the log-odds of left against right by the windows' own patterns, shape (n,)."""
        leaning = arrival_pattern(feature) @ self.weights + self.offset
        return np.asarray(self.certainty * _MOST_NATS * np.tanh(leaning / _MOST_NATS))

    def turned(self, groups: FloatArray, feature: FloatArray) -> FloatArray:
        """Return posteriors of the groups with those who come put where the street says.

        Shapes: groups (n, 2, groups), feature (n, azimuths), positive.
        """
        told = self.log_ratio(feature)
        coming, other = groups[..., :_COMING], groups[..., _OTHER]
        here = coming.sum(axis=-1)
        odds = np.log(here + _SMALLEST) - np.log(other + _SMALLEST) + np.stack([told, -told], axis=-1)
        moved = (here + other) / (1.0 + np.exp(-odds))
        found = groups.copy()
        found[..., :_COMING] = coming * (moved / (here + _SMALLEST))[..., None]
        found[..., _OTHER] = here + other - found[..., :_COMING].sum(axis=-1)
        return found
