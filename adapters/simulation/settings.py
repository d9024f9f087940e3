"""What is simulated: a site, an approach, and how the vehicle drives."""

from dataclasses import dataclass, field

import numpy as np

from worldstate.checks import in_range
from worldstate.errors import InvalidArgumentError

from .presets import Preset, preset
from .scene import Site, site

APPROACHES = ("left", "none", "right")  # OVAD's class numbers 1, 2, 3, in this order
SAMPLE_RATE_HZ = 47_998.0
# Narrow streets and a blind junction ahead: most drivers slow down before it.
SPEEDS_MPS, BRAKING_SHARE, BRAKING_MPS2 = (5.0, 12.0), 0.75, (0.5, 3.0)


@dataclass(frozen=True, slots=True)
class SimulationSettings:
    """One recording.

    Parameters
    ----------
    site : Site
        The junction.
    approach : str
        "left", "right" or "none".
    duration_s : float
        Length, 0.5 to 60 s.
    entry_s : float
        When the vehicle's front comes into the camera's line of sight; ignored without a vehicle.
    speed_mps : float
        Speed before braking, 1 to 30.
    braking_mps2 : float
        Deceleration in the two seconds before line of sight, 0 to 8.
    parked_car : bool
        Whether a car stands in view.
    sample_rate_hz : float
        8 to 96 kHz.
    preset : Preset
        Levels of everything else.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> SimulationSettings(site("SA1"), "left").entry_s
    7.0
    """

    site: Site
    approach: str
    duration_s: float = 10.0
    entry_s: float = 7.0
    speed_mps: float = 30.0 / 3.6
    braking_mps2: float = 0.0
    parked_car: bool = False
    sample_rate_hz: float = SAMPLE_RATE_HZ
    preset: Preset = field(default_factory=preset)

    def __post_init__(self) -> None:
        if self.approach not in APPROACHES:
            raise InvalidArgumentError(f"approach: expected left, none or right, got {self.approach!r}")
        in_range("duration_s", self.duration_s, 0.5, 60.0)
        in_range("entry_s", self.entry_s, 0.0, self.duration_s if self.approach != "none" else 60.0)
        in_range("speed_mps", self.speed_mps, 1.0, 30.0)
        in_range("braking_mps2", self.braking_mps2, 0.0, 8.0)
        in_range("sample_rate_hz", self.sample_rate_hz, 8_000.0, 96_000.0)


def draw_settings(
    site_name: str, approach: str, rng: np.random.Generator, duration_s: float = 10.0
) -> SimulationSettings:
    """Draw how a vehicle drives: 18 to 43 km/h, three in four braking, in sight at 65 to 75 % of the time.

    Parameters
    ----------
    site_name : str
        One of `SITES`.
    approach : str
        "left", "right" or "none".
    rng : numpy.random.Generator
        Source of randomness.
    duration_s : float
        Length of the recording.

    Examples
    --------
    >>> draw_settings("SB1", "right", np.random.default_rng(1)).site.name
    'SB1'
    """
    in_range("duration_s", duration_s, 0.5, 60.0)
    brakes = rng.random() < BRAKING_SHARE
    return SimulationSettings(
        site=site(site_name),
        approach=approach,
        duration_s=duration_s,
        entry_s=duration_s * rng.uniform(0.65, 0.75),
        speed_mps=rng.uniform(*SPEEDS_MPS),
        braking_mps2=rng.uniform(*BRAKING_MPS2) if brakes else 0.0,
        parked_car=bool(rng.random() < 0.3),
    )
