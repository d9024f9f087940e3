"""One sound that is no vehicle: what, when and where."""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray

from .route import along
from .sound_kinds import MICROPHONES, SoundKind, sound_kind

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
