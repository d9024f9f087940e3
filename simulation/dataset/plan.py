"""What a data set is made of, before anything is drawn."""

from dataclasses import dataclass

import numpy as np

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.simulation.scene.junction import MOVING_SITES, PLACES, SITES, place, place_of
from worldstate.simulation.scene.kinds import vehicle_kind
from worldstate.simulation.scene.presets import DEFAULT_PRESET, preset
from worldstate.simulation.scene.settings import MAX_SOUNDS, sound_kind

# The running number in an ID has four digits.
MAX_RECORDINGS = 10_000
JUNCTION, ALL = "junction", "all"
# Below, nothing is left of the band that bearings and features are taken from.
BANDWIDTHS_HZ = (700.0, 32_000.0)
APPROACH_SIDES = ("left", "right")


@dataclass(frozen=True, slots=True)
class Plan:
    """What the recording number `number` of a data set is, before anything is drawn."""

    number: int
    environment: str
    approach: str
    seed: np.random.SeedSequence
    kind: str = "light"


@dataclass(frozen=True, slots=True)
class DatasetSettings:
    """How a data set is made up.

    Parameters
    ----------
    n_static, n_dynamic : int
        Recordings with a standing ego and with one that drives up to the corner; in either group every other
        one is hazard-free.
    seed : int
        Of the whole data set.
    scene : str
        "junction", or one of `PLACES`, where the ego only stands and a vehicle comes from the sides that the
        place has; "all" for the junctions and every place in turn.
    kind : str
        What drives there, one of `KINDS`.
    duration_s : float
        Length of every recording, 0.5 to 60 s.
    video : bool
        Write what the camera sees, too; sound, detections and truth are the same with and without. Only for
        a standing ego at a junction.
    video_width_px : int
        Width of its images, 64 to 1936, OVAD's; the height follows. Boxes are those of the full size.
    bandwidth_hz : float, optional
        Render up to here only, 700 to 32,000 Hz, at the rate `rate_for`; the full rate if not given.
    sounds : tuple of str
        What else sounds in every recording, of `SOUNDS`; a vehicle's signal is its own where there is one.
    preset : str
        Name of the levels of everything that is not geometry.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range, a word unknown or a combination not to be had.

    Examples
    --------
    >>> DatasetSettings(n_static=6, kind="electric").preset
    'street-6'
    """

    n_static: int = 4
    n_dynamic: int = 0
    seed: int = 1
    scene: str = JUNCTION
    kind: str = "light"
    duration_s: float = 10.0
    video: bool = False
    video_width_px: int = PinholeCamera().width_px
    preset: str = DEFAULT_PRESET
    sounds: tuple[str, ...] = ()
    bandwidth_hz: float | None = None

    def __post_init__(self) -> None:
        in_range("n_static", self.n_static, 0, MAX_RECORDINGS)
        in_range("n_dynamic", self.n_dynamic, 0, MAX_RECORDINGS)
        in_range("n_static + n_dynamic", self.n_static + self.n_dynamic, 1, MAX_RECORDINGS)
        in_range("seed", self.seed, 0, 2**63)
        in_range("duration_s", self.duration_s, 0.5, 60.0)
        in_range("video_width_px", self.video_width_px, 64, PinholeCamera().width_px)
        vehicle_kind(self.kind)
        if self.bandwidth_hz is not None:
            in_range("bandwidth_hz", self.bandwidth_hz, *BANDWIDTHS_HZ)
        in_range("sounds: their number", len(self.sounds), 0, MAX_SOUNDS)
        for name in self.sounds:
            sound_kind(name)
        preset(self.preset)
        if self.scene not in (JUNCTION, ALL):
            place(self.scene)
        if self.n_dynamic and self.scene != JUNCTION:
            raise InvalidArgumentError(
                f"n_dynamic: expected 0 with scene {self.scene!r}, got {self.n_dynamic}"
            )
        if self.video and (self.n_dynamic or self.scene != JUNCTION):
            raise InvalidArgumentError("video: expected only static recordings of the scene 'junction'")

    def camera(self) -> PinholeCamera:
        """Return the camera of the video: OVAD's, with images of the width that is wanted."""
        whole = PinholeCamera()
        # An even height: the codec takes no other.
        height_px = 2 * round(0.5 * whole.height_px * self.video_width_px / whole.width_px)
        return PinholeCamera(width_px=self.video_width_px, height_px=height_px)

    def plans(self) -> list[Plan]:
        """Return what every recording is: site after site, the standing ego first.

        Examples
        --------
        >>> [(p.environment, p.approach) for p in DatasetSettings(n_static=1, n_dynamic=2).plans()]
        [('SA1', 'left'), ('DA1', 'left'), ('DA1', 'none')]
        """
        children = np.random.SeedSequence(self.seed).spawn(self.n_static + self.n_dynamic)
        groups = (range(self.n_static), self._sites()), (range(self.n_dynamic), MOVING_SITES)
        wanted = [_site_and_approach(i, names) for group, names in groups for i in group]
        return [
            Plan(number, *what, child, self.kind)
            for number, (what, child) in enumerate(zip(wanted, children, strict=True))
        ]

    def _sites(self) -> tuple[str, ...]:
        if self.scene == JUNCTION:
            return SITES
        names = PLACES if self.scene == ALL else (self.scene,)
        return (*(SITES if self.scene == ALL else ()), *(place(name).site.name for name in names))


def _site_and_approach(number: int, names: tuple[str, ...]) -> tuple[str, str]:
    """Return site after site with an approach each, and the same without."""
    pair = number // 2
    name = names[pair % len(names)]
    if number % 2:
        return name, "none"
    known = place_of(name)
    sides = APPROACH_SIDES if known is None else known.approaches
    # An even number of sites would otherwise give each the same side for ever.
    turn = pair + (pair // len(names) if len(names) % 2 == 0 else 0)
    return name, sides[turn % len(sides)]
