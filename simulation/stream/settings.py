"""Settings of a stream, before anything is drawn."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np

from worldstate.ground.checks import check_ranges, in_range, one_of
from worldstate.ground.errors import InvalidArgumentError
from worldstate.simulation.scene.junction import Site, ego_moves
from worldstate.simulation.scene.kinds import KINDS
from worldstate.simulation.scene.presets import Preset, preset
from worldstate.simulation.scene.settings import EGO_SPEEDS_MPS, SAMPLE_RATE_HZ, SIGNALS, SOUNDS
from worldstate.simulation.scene.vehicle import EgoMotion

# `manoeuvres.py` draws each flow; these flows bring vehicles out of a hidden arm.
HAZARDS = ("left", "right", "both", "waits", "queue", "stops")
_ELSEWHERE = ("turns_away", "parks", "far", "distant", "stands", "leaves", "joins")
FLOWS = (*HAZARDS, *_ELSEWHERE, "from_behind", "from_ahead")
MOST_PER_HOUR = 3600.0
# Cars, delivery vans and lorries, electric cars, bicycles and kick scooters of a side street; assumed shares.
TOWN_KINDS = {
    **{"light": 0.70, "medium": 0.07, "heavy": 0.03, "electric": 0.08},
    **{"bicycle": 0.10, "scooter": 0.02},
}


@dataclass(frozen=True, slots=True)
class Traffic:
    """Weather, and arrivals per hour of every flow: Poisson processes unless hazards are evenly spaced."""

    name: str
    per_hour: Mapping[str, float]  # Rate of each of `FLOWS`; missing flows have none
    follower_share: float = 0.0  # Probability that a vehicle out of a hidden arm has a follower
    evenly: bool = False  # Whether arrivals out of hidden arms are spaced evenly rather than at random
    headway_s: tuple[float, float] = (1.5, 4.0)  # Time between a leader and its follower
    # Maximum time between two vehicles from both sides, in either order; None: normally distributed, 0.7 s
    apart_s: float | None = None
    kinds: Mapping[str, float] = field(default_factory=lambda: TOWN_KINDS)  # Shares, which are normalised
    sounds: Mapping[str, float] = field(default_factory=dict)  # Other sounds per hour, by kind
    # Shares of the vehicles with a warning signal, by signal
    signals: Mapping[str, float] = field(default_factory=dict)
    # Range of ambience and wind above the preset's, dB; each stream draws its level uniformly.
    background_db: tuple[float, float] = (0.0, 0.0)
    rain_share: float = 0.0  # Probability of rain throughout a stream

    def __post_init__(self) -> None:
        for name, known, most in (
            ("per_hour", FLOWS, MOST_PER_HOUR),
            ("sounds", SOUNDS, MOST_PER_HOUR),
            ("signals", SIGNALS, 1.0),
            ("kinds", KINDS, 1.0),
        ):
            for key, number in getattr(self, name).items():
                one_of(name, key, known)
                in_range(f"{name}[{key!r}]", number, 0.0, most)
        in_range("headway_s[0]", self.headway_s[0], 0.1, self.headway_s[1])
        in_range("headway_s[1]", self.headway_s[1], self.headway_s[0], 10.0)
        if self.apart_s is not None:
            in_range("apart_s", self.apart_s, 0.0, 10.0)
        in_range("background_db[0]", self.background_db[0], -40.0, self.background_db[1])
        in_range("background_db[1]", self.background_db[1], -40.0, 30.0)
        # A share of followers of one would make an endless queue.
        check_ranges(self, rain_share=(0.0, 1.0), follower_share=(0.0, 0.9))
        in_range("kinds: sum of the shares", sum(self.kinds.values()), 1e-6, 1e6)

    @property
    def hazard_free(self) -> bool:
        """Whether no vehicle ever comes out of a hidden arm."""
        return not any(self.per_hour.get(flow, 0.0) for flow in HAZARDS)


_OTHERS = {"turns_away": 20.0, "parks": 8.0, "far": 40.0, "from_behind": 12.0, "from_ahead": 12.0}
_STOPPING = {"queue": 25.0, "stops": 25.0}
_IN_PAIRS: Mapping[str, Any] = {"evenly": True, "headway_s": (0.8, 6.0), "apart_s": 6.0}
_MISLEADING = {
    "voice tone beeper horn dog": 20.0,
    "children music drill birds steps horns": 10.0,
    "saw siren wail sweeps turns tune drums shots bell": 5.0,
}
# A side street at midday and a district road in the rush hour; `no-hazard` is the latter without vehicles out
# of a hidden arm, so that every alarm in it is false. `empty` is background alone.
TRAFFICS = {
    traffic.name: traffic
    for traffic in (
        Traffic(
            "calm",
            {"left": 12, "right": 12, "both": 2, "waits": 3, "turns_away": 6, "parks": 3, "far": 15}
            | {"from_behind": 4, "from_ahead": 4},
            follower_share=0.15,
        ),
        Traffic("busy", {"left": 45, "right": 45, "both": 8, "waits": 10} | _OTHERS, follower_share=0.3),
        # One hazard after another, for an exam of approaches: of 36 arrivals in 14.4 minutes, 20 are single
        # vehicles, 10 come from both sides at once and 6 have a follower.
        Traffic(
            "approaches",
            {"left": 125 / 3, "right": 125 / 3, "both": 125 / 3, "queue": 25} | _OTHERS,
            evenly=True,
        ),
        # Like `approaches`, with realistic arrivals: independent arms, and followers at any possible
        # distance. Of 36 arrivals in 14.4 minutes, 17 are single vehicles and 12 come from both sides.
        Traffic("pairs", {"left": 35, "right": 35, "both": 50, "queue": 30} | _OTHERS, **_IN_PAIRS),
        Traffic("no-hazard", _OTHERS),
        # Misleading traffic: near, loud or increasingly loud vehicles that never come out of an arm.
        Traffic(
            "misleading",
            {"turns_away": 20, "parks": 20, "far": 60, "from_behind": 20, "from_ahead": 20}
            | {"stands": 30, "leaves": 50, "joins": 40},
            sounds={kind: rate for kinds, rate in _MISLEADING.items() for kind in kinds.split()},
        ),
        # Misleading traffic of one kind at a time, for exams; stationary sources sound nearly all the time.
        Traffic("receding", {"leaves": 30, "joins": 30}),
        Traffic("standing", {"stands": 60}),
        Traffic("far", {"far": 60}),
        Traffic("machines", {}, sounds={"tone": 100, "saw": 100, "drill": 100}),
        Traffic(
            "signals", {}, sounds=dict.fromkeys(("siren", "wail", "sweeps", "turns", "horns", "beeper"), 40)
        ),
        Traffic("speech", {}, sounds={"voice": 150, "children": 150}),
        Traffic("music", {}, sounds={"music": 100, "tune": 100, "drums": 100}),
        Traffic("empty", {}),
        # Training traffic in varying weather: like `pairs`, with a sixth of the vehicles after a stop of 2 to
        # 10 s.
        Traffic("town", {"left": 30, "right": 30, "both": 40} | _STOPPING | _OTHERS, **_IN_PAIRS),
        # One kind of hazard alone, for exams.
        Traffic("stops", {"stops": 150}, evenly=True),
        *(
            Traffic(f"{kind}-only", {"left": 75, "right": 75}, evenly=True, kinds={kind: 1.0})
            for kind in ("bicycle", "scooter", "electric")
        ),
    )
}
# In its last 3 s before T0, at 300 to 2000 Hz, a vehicle of `pairs` raises the level above ambience and wind
# by 8.7 dB in the median stream of the first renderer and by 3.6 dB of the second; streams range from 4.6 to
# 13.2 and from 0.2 to 8.2 dB (5 to 95 %; 16 and 8 streams). With a background of -14 to 8 dB it is 14.0 and
# 5.7 dB, from 3.0 to 24.8 and from 1.2 to 11.4; for `varied` it was not measured. Rates of gusts and the
# share of rain are assumed.
_WEATHERS: Mapping[str, Mapping[str, Any]] = {
    "gusts": {"sounds": {"wind": 360.0}},
    "rain": {"rain_share": 1.0},
    "quiet": {"background_db": (-10.0, -10.0)},
    "varied": {"background_db": (-10.0, 8.0), "rain_share": 0.15, "sounds": {"wind": 60.0}}
    | {"per_hour": {"distant": 40.0}},
}


def _under(base: Traffic, weather: str) -> Traffic:
    """Return a traffic in a weather, with both names joined."""
    changed: dict[str, Any] = {"name": f"{base.name}-{weather}"}
    for key, value in _WEATHERS[weather].items():
        changed[key] = {**getattr(base, key), **value} if isinstance(value, Mapping) else value
    return replace(base, **changed)


for _name, _weather in product(("pairs", "no-hazard", "town", "misleading"), _WEATHERS):
    TRAFFICS[f"{_name}-{_weather}"] = _under(TRAFFICS[_name], _weather)


def traffic_named(name: str) -> Traffic:
    """Return a traffic by its name.

    Examples
    --------
    >>> traffic_named("no-hazard").hazard_free, traffic_named("calm").per_hour["both"]
    (True, 2)
    """
    return TRAFFICS[one_of("traffic", name, TRAFFICS)]


# A log of detections has at most 100,000 images, ten per second.
MAX_MINUTES = 160.0
# A drive along the ego's street to the corner. Five seconds before line of sight are evaluated, and the first
# second has no hop; recordings of a moving ego stop after 7.3 to 9 s.
MAX_DRIVE_MINUTES, STOPS_S = 1.0, (8.0, 9.0)
EGO, BACKGROUND, RAIN = 7, 9, 10  # Purposes of generators
# Light rain of 1 mm/h to a downpour of some 16 mm/h, relative to the moderate 4 mm/h of the table of sounds,
# if the power of drops rises a little faster than their volume (assumed).
RAIN_DB = (-8.0, 8.0)


@dataclass(frozen=True, slots=True)
class StreamSettings:
    """One continuous stream.

    Parameters
    ----------
    site : Site
        The junction. At a site with a moving ego the stream is one drive up to the corner.
    minutes : float
        Length, 0.05 to 160; of a drive up to 1.
    seed : int
        Seed of everything that is drawn.
    traffic : Traffic
        Arrivals of every flow.
    preset : Preset
        Levels and spectra of everything else.
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
        check_ranges(self, minutes=(0.05, longest), seed=(0, 2**63), sample_rate_hz=(2_000.0, 96_000.0))
        if self.site.is_open:
            problem = f"expected a junction, got {self.site.name}: no arms to come out of"
            raise InvalidArgumentError(f"site: {problem}")

    @property
    def name(self) -> str:
        """Site, traffic and seed."""
        return f"{self.site.name}-{self.traffic.name}-{self.seed}"

    @property
    def ego(self) -> EgoMotion:
        """Motion of the ego, drawn as for recordings; it stands except in a drive."""
        if not ego_moves(self.site.name):
            return EgoMotion()
        rng = self.generator(EGO)
        return EgoMotion(rng.uniform(*EGO_SPEEDS_MPS), rng.uniform(*STOPS_S))

    @property
    def background_db(self) -> float:
        """Drawn level of ambience and wind of this stream, above the preset's."""
        return float(self.generator(BACKGROUND).uniform(*self.traffic.background_db))

    @property
    def drawn_preset(self) -> Preset:
        """The preset with the ambience and wind of this stream."""
        level_db, usual = self.background_db, self.preset
        octaves_db = tuple(octave_db + level_db for octave_db in usual.ambient_octaves_db)
        return replace(usual, ambient_octaves_db=octaves_db, wind_100hz_db=usual.wind_100hz_db + level_db)

    @property
    def rain_db(self) -> float | None:
        """Level of continuous rain above moderate rain; None without rain."""
        rng = self.generator(RAIN)
        return float(rng.uniform(*RAIN_DB)) if rng.random() < self.traffic.rain_share else None

    @property
    def duration_s(self) -> float:
        """Length in seconds."""
        return 60.0 * self.minutes

    @property
    def samples(self) -> int:
        """Length in samples."""
        return round(self.duration_s * self.sample_rate_hz)

    def generator(self, *purpose: int) -> np.random.Generator:
        """Return the generator of one purpose, independent of draws for others."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=purpose))
