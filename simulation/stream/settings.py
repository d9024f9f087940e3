"""What a stream is, before anything is drawn."""

from dataclasses import dataclass, field

import numpy as np

from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.simulation.scene.junction import Site, ego_moves
from worldstate.simulation.scene.presets import Preset, preset
from worldstate.simulation.scene.route import EgoMotion
from worldstate.simulation.scene.settings import EGO_SPEEDS_MPS, SAMPLE_RATE_HZ

from .traffic import Traffic, traffic_named

# A log of detections holds 100,000 images, ten a second.
MAX_MINUTES = 160.0
# A drive down the own street to the corner. Five seconds before line of sight are judged, and the first one
# has no hop yet; recordings of a moving ego stop after 7.3 to 9 s.
MAX_DRIVE_MINUTES, STOPS_S = 1.0, (8.0, 9.0)
EGO = 7  # purpose of a generator


@dataclass(frozen=True, slots=True)
class StreamSettings:
    """One continuous stream.

    Parameters
    ----------
    site : Site
        The junction. Where its name says that the ego moves, the stream is one drive up to the corner.
    minutes : float
        Length, 0.05 to 160; of a drive up to 1.
    seed : int
        Of everything that is drawn.
    traffic : Traffic
        Who drives how often.
    preset : Preset
        Levels of everything else.
    sample_rate_hz : float
        2 to 96 kHz; sound is rendered up to half of it.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range or the site is in the open.

    Examples
    --------
    >>> from worldstate.simulation import site
    >>> settings = StreamSettings(site("SA1"), minutes=60.0, sample_rate_hz=6000.0)
    >>> settings.samples, settings.traffic.name
    (21600000, 'calm')
    """

    site: Site
    minutes: float
    seed: int = 1
    traffic: Traffic = field(default_factory=lambda: traffic_named("calm"))
    preset: Preset = field(default_factory=preset)
    sample_rate_hz: float = SAMPLE_RATE_HZ

    def __post_init__(self) -> None:
        longest = MAX_DRIVE_MINUTES if ego_moves(self.site.name) else MAX_MINUTES
        in_range("minutes", self.minutes, 0.05, longest)
        in_range("seed", self.seed, 0, 2**63)
        in_range("sample_rate_hz", self.sample_rate_hz, 2_000.0, 96_000.0)
        if self.site.is_open:
            raise InvalidArgumentError(
                f"site: expected a junction, got {self.site.name}: no arms to come out of"
            )

    @property
    def name(self) -> str:
        """Site, traffic and seed."""
        return f"{self.site.name}-{self.traffic.name}-{self.seed}"

    @property
    def ego(self) -> EgoMotion:
        """How the ego moves, as drawn for recordings; it stands but for a drive."""
        if not ego_moves(self.site.name):
            return EgoMotion()
        rng = self.generator(EGO)
        return EgoMotion(rng.uniform(*EGO_SPEEDS_MPS), rng.uniform(*STOPS_S))

    @property
    def duration_s(self) -> float:
        """Length in seconds."""
        return 60.0 * self.minutes

    @property
    def samples(self) -> int:
        """Length in samples."""
        return round(self.duration_s * self.sample_rate_hz)

    def generator(self, *purpose: int) -> np.random.Generator:
        """Return the generator of one purpose, whatever was drawn before for others."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=purpose))
