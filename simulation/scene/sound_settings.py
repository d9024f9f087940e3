"""Kinds of sounds that are no engine and no tyre: what they are, how loud, where to, how high.

Levels are A-weighted, in dB re 20 uPa at 1 m in front in the free field, over the eighths of a second that
are within 10 dB of the loudest: a horn is as loud as its blast, whatever its pauses.
"""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.checks import finite_array, in_range, one_of
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray

from .kinds import FLAT, Octaves
from .route import along

PLACE, VEHICLE, MICROPHONES = "a place", "a vehicle", "the microphones"


@dataclass(frozen=True, slots=True)
class SoundKind:
    """One kind of sound."""

    name: str
    label: str
    level_db: float  # See the head of this file; of rain and gusts at a microphone
    height_m: float = 1.0
    # Level straight behind against straight ahead, per octave; in between the mean over (1 + cos angle) / 2.
    back_db: Octaves = FLAT
    origin: str = PLACE  # What it belongs to: PLACE, VEHICLE or MICROPHONES
    faces: float = 1.0  # Of a signal of a vehicle: 1 from the front forwards, -1 from the rear backwards


# A talker's head shades high frequencies, after the polar patterns of Chu and Warnock, "Detailed directivity
# of sound fields around human talkers", NRC Canada, 2002; rounded by us.
HEAD_DB: Octaves = (-1.0, -2.0, -3.0, -5.0, -6.0, -9.0, -14.0, -18.0)
# A piston of 0.1 m in a box turns directional where its circumference is a wavelength, some 500 Hz (assumed).
BOX_DB: Octaves = (0.0, -1.0, -3.0, -7.0, -11.0, -15.0, -18.0, -20.0)
# A horn mouth on a car's front or roof, and the car's body behind it (assumed).
MOUTH_DB: Octaves = (-2.0, -3.0, -6.0, -9.0, -12.0, -15.0, -17.0, -18.0)

_TABLE = (
    # ISO 9921:2003: raised effort is 66 dB(A) at 1 m with its pauses, normal 60, loud 72.
    SoundKind("voice", "one talker, raised effort", 68.3, 1.5, HEAD_DB),
    # Hard heels on paving; assumed.
    SoundKind("steps", "one person walking", 58.0, 0.05),
    # Assumed: some 65 dB(A) at 100 m.
    SoundKind("bell", "church bell", 105.0, 25.0),
    # Makers' declarations of hand-held tools lie at 90 to 100 dB(A) at the operator; assumed.
    SoundKind("saw", "circular saw", 95.0, 1.0),
    SoundKind("drill", "hammer drill in masonry", 93.0, 1.2),
    # Assumed: a loudspeaker in an open window.
    SoundKind("music", "music with beat and bass", 80.0, 2.5, BOX_DB),
    # Assumed: small songbirds at full song.
    SoundKind("birds", "songbirds", 82.0, 5.0),
    # Assumed: an air conditioner's fan, a transformer.
    SoundKind("tone", "steady tones of a machine", 85.0, 2.0, BOX_DB),
    # 110 dB(A) at 3.5 m in front, DIN 14610, is 121 at 1 m.
    SoundKind("siren", "two-tone siren", 121.0, 1.8, MOUTH_DB, VEHICLE),
    # Assumed as loud as the two-tone one.
    SoundKind("wail", "wailing siren", 121.0, 1.8, MOUTH_DB, VEHICLE),
    # 93 dB(A) at 7 m in front of the vehicle, the least that UN Regulation No. 28 asks, is 110 at 1 m.
    SoundKind("horn", "horn of a car", 110.0, 0.5, MOUTH_DB, VEHICLE),
    # 97 dB(A) at 1.2 m, class C of SAE J994, is 98.6 at 1 m.
    SoundKind("beeper", "reversing beeper", 98.6, 0.8, MOUTH_DB, VEHICLE, faces=-1.0),
    # Assumed.
    SoundKind("bicycle-bell", "bell of a bicycle", 80.0, 1.0, origin=VEHICLE),
    # Drops on the roof round each microphone and the rain of the whole street; assumed: moderate rain.
    SoundKind("rain", "rain on roof and street", 58.0, origin=MICROPHONES),
    # In the octave of 100 Hz, unweighted, as `ego_sound` has it at 10 m/s behind a windscreen and 6 dB more.
    SoundKind("gusts", "gusts at one to three microphones", 82.0, origin=MICROPHONES),
)
SOUNDS = {kind.name: kind for kind in _TABLE}
SIGNALS = tuple(kind.name for kind in _TABLE if kind.origin == VEHICLE)


def sound_kind(name: str) -> SoundKind:
    """Return a kind of sound by its name."""
    return SOUNDS[one_of("sound", name, SOUNDS)]


FARTHEST_M, MAX_CHANNELS = 500.0, 3


@dataclass(frozen=True, slots=True)
class SoundSettings:
    """One sound.

    Parameters
    ----------
    kind : str
        One of `SOUNDS`.
    start_s, duration_s : float
        When it is emitted, -60 to 120 s, and how long, up to 120 s.
    place_m : tuple of float
        Where it stands, or starts: x ahead and y left of where the ego stops. Not of rain and gusts.
    route_m : tuple of (float, float)
        More points of its way; empty for a sound that stands.
    speed_mps : float
        On that way, up to 30; at its end the sound stands.
    level_offset_db : float
        Over the level of its kind.
    facing_rad : float, optional
        Where a standing sound faces, 0 along the ego's street; towards where the ego stops if not given. A
        moving one faces forwards.
    channels : tuple of int
        Microphones that gusts hit, at most 3.
    lens_missed : float
        Share of the camera's detections that is lost meanwhile, 0 to 1: rain soils the lens, too.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range, the kind is unknown, or gusts hit no microphone.

    Examples
    --------
    >>> x, y = SoundSettings("steps", 1.0, 4.0, (2.0, 3.0), ((12.0, 3.0),), 1.3).at(np.array([0.0, 3.0]))
    >>> x, y
    (array([2. , 4.6]), array([3., 3.]))
    """

    kind: str
    start_s: float = 0.0
    duration_s: float = 5.0
    place_m: tuple[float, float] = (5.0, 0.0)
    route_m: tuple[tuple[float, float], ...] = ()
    speed_mps: float = 1.4
    level_offset_db: float = 0.0
    facing_rad: float | None = None
    channels: tuple[int, ...] = ()
    lens_missed: float = 0.0

    def __post_init__(self) -> None:
        kind = sound_kind(self.kind)
        in_range("start_s", self.start_s, -60.0, 120.0)
        in_range("duration_s", self.duration_s, 0.05, 120.0)
        points = finite_array("place_m and route_m", (self.place_m, *self.route_m), (None, 2))
        in_range("place_m and route_m: farthest", np.abs(points).max(), 0.0, FARTHEST_M)
        if self.route_m and np.hypot(*np.diff(points, axis=0).T).min() < 0.1:
            raise InvalidArgumentError("route_m: expected points apart from each other and from place_m")
        in_range("speed_mps", self.speed_mps, 0.1, 30.0)
        in_range("level_offset_db", self.level_offset_db, -60.0, 30.0)
        in_range("lens_missed", self.lens_missed, 0.0, 1.0)
        if kind.name == "gusts" and not 1 <= len(self.channels) <= MAX_CHANNELS:
            raise InvalidArgumentError(
                f"channels: expected 1 to {MAX_CHANNELS} of gusts, got {self.channels}"
            )

    @property
    def what(self) -> SoundKind:
        """Its kind."""
        return sound_kind(self.kind)

    @property
    def has_place(self) -> bool:
        """Whether it comes from somewhere, and is not the microphones' own."""
        return self.what.origin != MICROPHONES

    @property
    def end_s(self) -> float:
        """When it ends."""
        return self.start_s + self.duration_s

    def at(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return where it is, x and y, shape (T,) each."""
        if not self.route_m:
            return tuple(np.full_like(time_s, value) for value in self.place_m)  # type: ignore[return-value]
        points = np.array((self.place_m, *self.route_m))
        length = float(np.hypot(*np.diff(points, axis=0).T).sum())
        return along(points).at(np.clip(self.speed_mps * (time_s - self.start_s), 0.0, length))

    def facing(self, time_s: FloatArray) -> FloatArray:
        """Return where it faces, rad, shape (T,)."""
        if self.route_m:
            (x, y), (ahead_x, ahead_y) = self.at(time_s - 0.5), self.at(time_s + 0.5)
            return np.arctan2(ahead_y - y, ahead_x - x)
        back_x, back_y = (-value for value in self.place_m)
        return np.full_like(
            time_s, np.arctan2(back_y, back_x) if self.facing_rad is None else self.facing_rad
        )
