"""What is staged on the camera, on the microphones, or on both at once."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from worldstate.adapters.camera.degradation import LEVELS, Family, degrade
from worldstate.ground.typing import ImageArray

# Conditions that every sweep has: the recording as it is, and no camera at all.
CLEAN, OFF = "clean", "off"
# Rain has two effects: it soils the lens and it drums on the roof. Each is staged alone as well.
LENS, ROOF, RAIN = "lens", "roof", "rain"
# The three families of the paper; those measured as miss rates, as nobody tells the camera that it rains.
FAMILIES: tuple[Family, ...] = ("blur", "darkness", "noise")
# What an image goes through, optics first. Drops on a lens smear the image and take some of its light.
STAGES: Mapping[str, tuple[Family, ...]] = MappingProxyType(
    {CLEAN: (), **{family: (family,) for family in FAMILIES}, LENS: ("blur", "darkness")}
)


@dataclass(frozen=True, slots=True)
class Condition:
    """One level of one family; level 0 for those without levels.

    Examples
    --------
    >>> rain = Condition("rain", 3)
    >>> rain.name, rain.camera.name, rain.sound_level, rain.degradation
    ('rain 0.75', 'lens 0.75', 3, 0.75)
    >>> Condition("roof", 2).camera.name, Condition("blur", 2).sound_level
    ('clean', 0)
    """

    family: str
    level: int = 0

    @property
    def name(self) -> str:
        """Unique in a sweep."""
        return f"{self.family} {self.degradation:g}" if self.level else self.family

    @property
    def degradation(self) -> float:
        """The staged d in [0, 1]."""
        return LEVELS[self.level]

    @property
    def camera(self) -> "Condition":
        """The condition whose images these are."""
        if self.family in STAGES:
            return self
        return Condition(LENS, self.level) if self.family == RAIN else Condition(CLEAN)

    @property
    def sound_level(self) -> int:
        """Level of the rain on the roof, 0 without."""
        return self.level if self.family in (ROOF, RAIN) else 0

    def stage(self, image: ImageArray, rng: np.random.Generator, reduced: float = 1.0) -> ImageArray:
        """Return an image as this camera would have taken it; `reduced` as in `degrade`."""
        for family in STAGES[self.family]:
            image = degrade(image, family, self.degradation, rng, reduced)
        return image


def camera_conditions() -> tuple[Condition, ...]:
    """Return the conditions of the camera alone: the clean one, and every level of every family."""
    return Condition(CLEAN), *_levels(*FAMILIES, LENS)


def at_level(family: str, level: int) -> Condition:
    """Return a level of a family; level 0 of every family is the clean recording."""
    return Condition(family, level) if level else Condition(CLEAN)


def all_conditions() -> tuple[Condition, ...]:
    """Return those of the camera, those of the sound, both at once, and no camera.

    Examples
    --------
    >>> [one.name for one in all_conditions()][::5]
    ['clean', 'darkness 0.25', 'noise 0.5', 'lens 0.75', 'roof 1', 'off']
    """
    return *camera_conditions(), *_levels(ROOF, RAIN), Condition(OFF)


def _levels(*families: str) -> list[Condition]:
    return [Condition(family, level) for family in families for level in range(1, len(LEVELS))]
