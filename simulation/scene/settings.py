"""Settings of a recording: site, approach, motion of the vehicles, and further sounds, given or drawn.

Levels of sounds are A-weighted, in dB re 20 uPa at 1 m in front in the free field, over all blocks of 1/8 s
within 10 dB of the loudest. So the level of a horn is that of its blasts, without its pauses.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from worldstate.ground import FloatArray, InvalidArgumentError
from worldstate.ground.checks import check_ranges, finite_array, in_range, one_of

from .junction import Site, Way, ego_moves, place_of, site
from .kinds import FLAT, Octaves, VehicleKind, vehicle_kind
from .presets import Preset, preset, site_ambience
from .vehicle import EgoMotion, along

PLACE, VEHICLE, MICROPHONES = "a place", "a vehicle", "the microphones"


@dataclass(frozen=True, slots=True)
class SoundKind:
    """One kind of sound."""

    name: str
    label: str
    level_db: float  # See the head of this file; for rain and gusts, the level at a microphone
    height_m: float = 1.0
    # Level behind relative to ahead, per octave. The amplitude at other angles is a mean with the weight (1 +
    # cos angle) / 2 for ahead.
    back_db: Octaves = FLAT
    origin: str = PLACE  # Origin of the sound: PLACE, VEHICLE or MICROPHONES
    faces: float = 1.0  # Signals of a vehicle: 1 from the front forwards, -1 from the rear backwards


# A talker's head shadows high frequencies, after the polar patterns of Chu and Warnock, "Detailed directivity
# of sound fields around human talkers", NRC Canada, 2002; rounded.
HEAD_DB: Octaves = (-1.0, -2.0, -3.0, -5.0, -6.0, -9.0, -14.0, -18.0)
# A piston of 0.1 m in a box is directional if its circumference exceeds a wavelength, about 500 Hz (assumed).
BOX_DB: Octaves = (0.0, -1.0, -3.0, -7.0, -11.0, -15.0, -18.0, -20.0)
# A horn mouth on a car's front or roof, and the car's body behind it (assumed).
MOUTH_DB: Octaves = (-2.0, -3.0, -6.0, -9.0, -12.0, -15.0, -17.0, -18.0)

_TABLE = (
    # ISO 9921:2003: raised effort is 66 dB(A) at 1 m with pauses, normal effort 60, loud 72.
    SoundKind("voice", "one talker, raised effort", 68.3, 1.5, HEAD_DB),
    # Assumed: a few children at play, and a dog in a yard, about 90 dB(A) at 1 m.
    SoundKind("children", "children at play", 78.0, 1.0, HEAD_DB),
    SoundKind("dog", "barking dog", 90.0, 0.5, HEAD_DB),
    # Hard heels on paving; assumed.
    SoundKind("steps", "one person walking", 58.0, 0.05),
    # Assumed: about 65 dB(A) at 100 m.
    SoundKind("bell", "church bell", 105.0, 25.0),
    # Manufacturers declare 90 to 100 dB(A) at the operator for hand-held tools; assumed.
    SoundKind("saw", "circular saw, grinder or another machine with a motor", 95.0, 1.0),
    SoundKind("drill", "hammer drill in masonry", 93.0, 1.2),
    SoundKind("jackhammer", "breaker on a road", 105.0, 0.5),
    # Assumed: a loudspeaker in an open window.
    SoundKind("music", "music with beat and bass", 80.0, 2.5, BOX_DB),
    SoundKind("tune", "instruments that play a tune", 80.0, 1.5),
    SoundKind("drums", "drums", 90.0, 1.0),
    # Assumed: fireworks, a nail gun.
    SoundKind("shots", "shots", 115.0, 1.5),
    # Assumed: small songbirds at full song.
    SoundKind("birds", "songbirds", 82.0, 5.0),
    # Assumed: an air conditioner's fan, a transformer.
    SoundKind("tone", "steady tones of a machine", 85.0, 2.0, BOX_DB),
    # 110 dB(A) at 3.5 m in front, DIN 14610, is 121 at 1 m.
    SoundKind("siren", "two-tone siren", 121.0, 1.8, MOUTH_DB, VEHICLE),
    # Assumed as loud as the two-tone one.
    SoundKind("wail", "wailing siren", 121.0, 1.8, MOUTH_DB, VEHICLE),
    SoundKind("sweeps", "siren that rises and falls at any pace", 121.0, 1.8, MOUTH_DB, VEHICLE),
    SoundKind("turns", "siren of any two tones", 121.0, 1.8, MOUTH_DB, VEHICLE),
    # 93 dB(A) at 7 m in front of the vehicle, the minimum of UN Regulation No. 28, is 110 at 1 m.
    SoundKind("horn", "horn of a car", 110.0, 0.5, MOUTH_DB, VEHICLE),
    SoundKind("horns", "one horn or two of any pitch", 110.0, 0.5, MOUTH_DB, VEHICLE),
    # 97 dB(A) at 1.2 m, class C of SAE J994, is 98.6 at 1 m.
    SoundKind("beeper", "reversing beeper", 98.6, 0.8, MOUTH_DB, VEHICLE, faces=-1.0),
    # Assumed.
    SoundKind("bicycle-bell", "bell of a bicycle", 80.0, 1.0, origin=VEHICLE),
    # Drops on the roof round each microphone and the rain of the whole street; assumed: moderate rain.
    SoundKind("rain", "rain on roof and street", 58.0, origin=MICROPHONES),
    # Octave of 100 Hz, unweighted: the level of `ego_sound` at 10 m/s behind a windscreen, plus 6 dB.
    SoundKind("gusts", "gusts at one to three microphones", 82.0, origin=MICROPHONES),
    # Same measure: the wind of the preset `street-6`, 60.5 dB, plus the mean swell.
    SoundKind("wind", "one swell of wind at all microphones", 77.0, origin=MICROPHONES),
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
        Time of emission, -60 to 120 s, and duration, up to 120 s.
    place_m : tuple of float
        Position or start: x ahead and y left of the ego's stop. Ignored for weather.
    route_m : tuple of (float, float)
        Further points of its route; empty for a sound at rest.
    speed_mps : float
        Speed on that route, up to 30; afterwards the sound rests at its end.
    level_offset_db : float
        Added to the level of its kind.
    facing_rad : float, optional
        Direction that a sound at rest faces, 0 along the ego's street; towards the ego's stop by default. A
        moving sound faces forwards.
    channels : tuple of int
        Microphones that gusts hit, at most 3.
    lens_missed : float
        Share of the camera's detections that is lost meanwhile, 0 to 1, because rain wets the lens.

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
        check_ranges(self, start_s=(-60.0, 120.0), duration_s=(0.05, 120.0))
        points = finite_array("place_m and route_m", (self.place_m, *self.route_m), (None, 2))
        in_range("place_m and route_m: farthest", np.abs(points).max(), 0.0, FARTHEST_M)
        if self.route_m and np.hypot(*np.diff(points, axis=0).T).min() < 0.1:
            raise InvalidArgumentError("route_m: expected points apart from each other and from place_m")
        check_ranges(self, speed_mps=(0.1, 30.0), level_offset_db=(-60.0, 30.0), lens_missed=(0.0, 1.0))
        if kind.name == "gusts" and not 1 <= len(self.channels) <= MAX_CHANNELS:
            problem = f"expected 1 to {MAX_CHANNELS} of gusts, got {self.channels}"
            raise InvalidArgumentError(f"channels: {problem}")

    @property
    def what(self) -> SoundKind:
        """Kind of the sound."""
        return sound_kind(self.kind)

    @property
    def has_place(self) -> bool:
        """Whether the sound has a position and is not generated at the microphones."""
        return self.what.origin != MICROPHONES

    @property
    def end_s(self) -> float:
        """Time at which the sound ends."""
        return self.start_s + self.duration_s

    def at(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the position of the sound, x and y, shape (T,) each."""
        if not self.route_m:
            return tuple(np.full_like(time_s, value) for value in self.place_m)  # type: ignore[return-value]
        points = np.array((self.place_m, *self.route_m))
        length = float(np.hypot(*np.diff(points, axis=0).T).sum())
        return along(points).at(np.clip(self.speed_mps * (time_s - self.start_s), 0.0, length))

    def facing(self, time_s: FloatArray) -> FloatArray:
        """Return the direction that the sound faces, rad, shape (T,)."""
        if self.route_m:
            (x, y), (ahead_x, ahead_y) = self.at(time_s - 0.5), self.at(time_s + 0.5)
            return np.arctan2(ahead_y - y, ahead_x - x)
        back_x, back_y = (-value for value in self.place_m)
        faces_rad = np.arctan2(back_y, back_x) if self.facing_rad is None else self.facing_rad
        return np.full_like(time_s, faces_rad)


APPROACHES = ("left", "none", "right")  # OVAD's class numbers 1, 2, 3, in this order
SAMPLE_RATE_HZ = 47_998.0
MAX_OTHERS, MAX_SOUNDS, MAX_ROUTE_POINTS, SHORTEST_STEP_M = 8, 16, 64, 0.1
# Fitted to the motion of the released patterns in the two seconds round T0: 3 to 5 m/s at all three fitted
# places, with little braking. With drivers at 9 m/s and 3 m/s2 of braking, simulated vehicles arrived in
# front half a second late.
SPEEDS_MPS, WALLED_SPEEDS_MPS = (3.8, 6.2), (3.4, 4.8)
BRAKING_SHARE, BRAKING_MPS2 = 0.6, (0.3, 1.4)
EGO_SPEEDS_MPS, EGO_STOPS_AFTER_S = (10.0 / 3.6, 30.0 / 3.6), (0.3, 2.0)


def rate_for(bandwidth_hz: float) -> float:
    """Return the sample rate for sound of a bandwidth, three to six times it.

    Examples
    --------
    >>> rate_for(2000.0), rate_for(2500.0), rate_for(16_000.0)
    (6000.0, 12000.0, 47998.0)
    """
    # Halving the full rate keeps the bins, because frames of 512 samples become 256, 128 or 64. Files need
    # integer rates: if 5,999.75 Hz were read as 6,000 Hz, the error would be a tenth of a second after an
    # hour.
    halvings = max(int(np.floor(np.log2(SAMPLE_RATE_HZ / (3.0 * bandwidth_hz)) + 1e-3)), 0)
    return float(round(SAMPLE_RATE_HZ / 2**halvings))


@dataclass(frozen=True, slots=True)
class VehicleSettings:
    """One vehicle.

    Parameters
    ----------
    approach : str
        "left" or "right".
    entry_s : float
        Time at which its front comes into the camera's line of sight, -60 to 120 s.
    speed_mps : float
        Speed before braking, 1 to 30.
    braking_mps2 : float
        Deceleration in the two seconds before line of sight, 0 to 8.
    kind : str
        One of `KINDS`.
    route_m : tuple of (float, float)
        Route in place of the crossing street: points x, y, at least 2; empty for none.
    signal : str
        Continuous warning signal, one of `SIGNALS`; empty for none.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range or a word is unknown.

    Examples
    --------
    >>> VehicleSettings("left", entry_s=4.0, kind="heavy").speed_mps > 8
    True
    """

    approach: str
    entry_s: float = 7.0
    speed_mps: float = 30.0 / 3.6
    braking_mps2: float = 0.0
    kind: str = "light"
    route_m: tuple[tuple[float, float], ...] = ()
    signal: str = ""

    def __post_init__(self) -> None:
        one_of("approach", self.approach, ("left", "right"))
        one_of("signal", self.signal, ("", *SIGNALS))
        vehicle_kind(self.kind)
        check_ranges(self, entry_s=(-60.0, 120.0), speed_mps=(1.0, 30.0), braking_mps2=(0.0, 8.0))
        if self.route_m:
            points = finite_array("route_m", self.route_m, (None, 2))
            steps = np.hypot(*np.diff(points, axis=0).T)
            if not 2 <= len(points) <= MAX_ROUTE_POINTS or steps.min() < SHORTEST_STEP_M:
                expected = f"expected 2 to {MAX_ROUTE_POINTS} points apart from each other"
                raise InvalidArgumentError(f"route_m: {expected}")


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
        Time at which the vehicle's front comes into line of sight; ignored without a vehicle.
    speed_mps : float
        Speed before braking, 1 to 30.
    braking_mps2 : float
        Deceleration in the two seconds before line of sight, 0 to 8.
    parked_car : bool
        Whether a parked car is in view.
    sample_rate_hz : float
        2 to 96 kHz; sound is rendered up to a third of it.
    preset : Preset
        Levels and spectra of everything else.
    kind, route_m, signal
        Of the vehicle: see `VehicleSettings`.
    others : tuple of VehicleSettings
        At most 8 further vehicles; with `approach` "none" they are all, and none of them is a hidden hazard.
    ego : EgoMotion
        Motion of the ego; it stands by default.
    sounds : tuple of SoundSettings
        Further sounds, at most 16.

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
    kind: str = "light"
    route_m: tuple[tuple[float, float], ...] = ()
    others: tuple[VehicleSettings, ...] = ()
    ego: EgoMotion = field(default_factory=EgoMotion)
    signal: str = ""
    sounds: tuple[SoundSettings, ...] = ()

    def __post_init__(self) -> None:
        one_of("approach", self.approach, APPROACHES)
        latest_s = self.duration_s if self.approach != "none" else 60.0
        check_ranges(self, duration_s=(0.5, 60.0), entry_s=(0.0, latest_s), speed_mps=(1.0, 30.0))
        check_ranges(self, braking_mps2=(0.0, 8.0), sample_rate_hz=(2_000.0, 96_000.0))
        in_range("others: number of vehicles", len(self.others), 0, MAX_OTHERS)
        in_range("sounds: their number", len(self.sounds), 0, MAX_SOUNDS)
        self.traffic  # noqa: B018  (building the first vehicle checks what is left)

    @property
    def traffic(self) -> tuple[VehicleSettings, ...]:
        """All vehicles; the vehicle of `approach` comes first."""
        if self.approach == "none":
            return self.others
        own = {one.name: getattr(self, one.name) for one in fields(VehicleSettings)}
        return (VehicleSettings(**own), *self.others)


def draw_settings(
    site_name: str,
    approach: str,
    rng: np.random.Generator,
    duration_s: float = 10.0,
    kind: str = "light",
    levels: Preset | None = None,
) -> SimulationSettings:
    """Draw the motion of a vehicle that comes into sight at 65 to 75 % of the recording.

    Most vehicles brake a little; before that their speed is 14 to 22 km/h, or 12 to 17 with a wall opposite
    (type A).

    Parameters
    ----------
    site_name : str
        One of `SITES`; of `MOVING_SITES`, where the ego drives up to the corner at 10 to 30 km/h; or of
        `PLACES`, where a vehicle takes one of the place's routes. Half of the hazard-free recordings there
        have a vehicle that is always in view, or never.
    approach : str
        "left", "right" or "none".
    rng : numpy.random.Generator
        Source of randomness.
    duration_s : float
        Length of the recording.
    kind : str
        One of `KINDS`.
    levels : Preset, optional
        Levels of everything else; the default preset if not given.

    Returns
    -------
    SimulationSettings
        Settings of one recording.

    Raises
    ------
    InvalidArgumentError
        If a name is unknown or the place has no such approach.

    Examples
    --------
    >>> draw_settings("SB1", "right", np.random.default_rng(1)).site.name
    'SB1'
    """
    in_range("duration_s", duration_s, 0.5, 60.0)
    known = place_of(site_name)
    if known is not None:
        one_of("approach", approach, (*known.approaches, "none"))
    brakes = rng.random() < BRAKING_SHARE
    plan = site(site_name) if known is None else known.site
    levels = levels or preset()
    drawn = SimulationSettings(
        site=plan,
        approach=approach,
        duration_s=duration_s,
        entry_s=duration_s * rng.uniform(0.65, 0.75),
        speed_mps=rng.uniform(*speeds_mps(plan, vehicle_kind(kind), levels)),
        braking_mps2=rng.uniform(*BRAKING_MPS2) if brakes else 0.0,
        parked_car=bool(rng.random() < 0.3) and known is None,
        kind=kind,
        ego=_draw_ego(rng, duration_s) if ego_moves(site_name) else EgoMotion(),
        preset=levels,
    )
    way = None if known is None else known.drawn_way(approach, rng)
    return drawn if way is None else _on_way(drawn, way)


def _on_way(settings: SimulationSettings, way: Way) -> SimulationSettings:
    """Return a recording whose vehicle takes a route: that of the approach, or one without a hazard."""
    if way.approach != "none":
        return replace(settings, route_m=way.route_m)
    own = settings.entry_s, settings.speed_mps, 0.0, settings.kind
    return replace(settings, others=(VehicleSettings("left", *own, route_m=way.route_m),))


def speeds_mps(site: Site, kind: VehicleKind, levels: Preset) -> tuple[float, float]:
    """Return the range of speeds of a kind of vehicle at a site, before braking."""
    slow, fast = SPEEDS_MPS if site.opposite_wall_m is None else WALLED_SPEEDS_MPS
    return kind.ridden_mps or (levels.speed_factor * slow, levels.speed_factor * fast)


def _draw_ego(rng: np.random.Generator, duration_s: float) -> EgoMotion:
    """Draw an ego that stops shortly after the vehicle comes into sight."""
    stop_s = 0.7 * duration_s + rng.uniform(*EGO_STOPS_AFTER_S)
    return EgoMotion(rng.uniform(*EGO_SPEEDS_MPS), stop_s)


# Share of the recording in which a sound is audible; the kinds of `LASTING` last throughout.
SHARE, LASTING = (0.3, 0.8), ("rain", "music", "bell")
WALKING_MPS = (1.1, 1.6)
NEAR_M, SIDE_STREET_M = (3.0, 12.0), (6.0, 30.0)  # Behind the ego, and along the crossing street
FAR_M, BELL_M = (60.0, 200.0), (80.0, 250.0)
FROM_WALL_M = 0.6
LENS_SHARE, LENS_MISSED = 0.5, (0.2, 0.8)  # Half of the rain wets the lens, too
# Duration of a swell of wind, and its level above the mean wind of the site, dB (assumed).
SWELL_S, SWELL_DB = (1.0, 5.0), (8.0, 25.0)


def with_sounds(
    settings: SimulationSettings, kinds: Sequence[str], microphones: int, rng: np.random.Generator
) -> SimulationSettings:
    """Add a sound of each kind; the last signal of a vehicle is assigned to the vehicle, if there is one.

    Examples
    --------
    >>> from worldstate.simulation import draw_settings
    >>> rng = np.random.default_rng(1)
    >>> settings = with_sounds(draw_settings("SA1", "left", rng), ["voice", "horn"], 56, rng)
    >>> [sound.kind for sound in settings.sounds], settings.signal
    (['voice'], 'horn')
    """
    signals = ["", *(kind for kind in kinds if sound_kind(kind).origin == VEHICLE)]
    carried = "" if settings.approach == "none" else signals[-1]
    drawn = [_drawn(kind, settings, microphones, rng) for kind in kinds if kind != carried]
    return replace(settings, sounds=(*settings.sounds, *drawn), signal=carried)


def _drawn(
    kind: str, settings: SimulationSettings, microphones: int, rng: np.random.Generator
) -> SoundSettings:
    whole = settings.duration_s
    long = whole if kind in LASTING else max(whole * rng.uniform(*SHARE), 0.05)
    start = rng.uniform(0.0, whole - long) if long < whole else 0.0
    if kind == "gusts":
        count = int(rng.integers(1, min(MAX_CHANNELS, microphones) + 1))
        # A gust is narrow: it hits neighbouring microphones.
        first = int(rng.integers(microphones - count + 1))
        return SoundSettings(kind, start, long, channels=tuple(range(first, first + count)))
    if kind == "wind":
        mean_db = settings.preset.wind_100hz_db + site_ambience(settings.site, settings.preset).wind_db
        over_db = mean_db + rng.uniform(*SWELL_DB) - sound_kind(kind).level_db
        return SoundSettings(kind, start, min(rng.uniform(*SWELL_S), whole), level_offset_db=over_db)
    if kind == "rain":
        missed = rng.uniform(*LENS_MISSED) if rng.random() < LENS_SHARE else 0.0
        return SoundSettings(kind, start, long, lens_missed=missed)
    sound = SoundSettings(kind, start, long, facing_rad=rng.uniform(-np.pi, np.pi))
    # A signal of a vehicle comes from another street if this one has no vehicle.
    far = BELL_M if kind == "bell" else FAR_M if sound.what.origin == VEHICLE else None
    if far is not None:
        azimuth, away = rng.uniform(-np.pi, np.pi), rng.uniform(*far)
        return replace(sound, place_m=(away * np.cos(azimuth), away * np.sin(azimuth)), facing_rad=None)
    return _in_a_street(sound, settings.site, rng)


def _in_a_street(sound: SoundSettings, site: Site, rng: np.random.Generator) -> SoundSettings:
    """Place a sound before a wall, behind the ego or in the crossing street; steps move along it."""
    side, walk = rng.choice([-1.0, 1.0]), rng.uniform(*WALKING_MPS)
    if rng.random() < 0.5:
        wall = site.side_wall_left_m if side > 0.0 else site.side_wall_right_m
        place = -rng.uniform(*NEAR_M), side * (wall - FROM_WALL_M)
        to = site.corner_ahead_m, place[1]
    else:
        place = site.corner_ahead_m + FROM_WALL_M, side * rng.uniform(*SIDE_STREET_M)
        to = place[0], -place[1]
    if sound.kind == "steps":
        return replace(sound, place_m=place, route_m=(to,), speed_mps=walk)
    return replace(sound, place_m=place)
