"""Where and when what else sounds in a recording, drawn by kind."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .junction import Site
from .settings import SimulationSettings
from .sound_settings import VEHICLE, SoundSettings, sound_kind

# How long one of them is heard, of the recording; rain and music last.
SHARE, LASTING = (0.3, 0.8), ("rain", "music", "bell")
WALKING_MPS = (1.1, 1.6)
NEAR_M, SIDE_STREET_M = (3.0, 12.0), (6.0, 30.0)  # behind the ego, and along the crossing street
FAR_M, BELL_M = (60.0, 200.0), (80.0, 250.0)
FROM_WALL_M = 0.6
LENS_SHARE, LENS_MISSED = 0.5, (0.2, 0.8)  # every other rain soils the lens, too
MAX_GUSTY = 3


def with_sounds(
    settings: SimulationSettings, kinds: Sequence[str], microphones: int, rng: np.random.Generator
) -> SimulationSettings:
    """Add a sound of each kind; the last signal of a vehicle goes to the vehicle, if there is one.

    Examples
    --------
    >>> from worldstate.simulation import draw_settings
    >>> rng = np.random.default_rng(1)
    >>> settings = with_sounds(draw_settings("SA1", "left", rng), ["voice", "horn"], 56, rng)
    >>> [sound.kind for sound in settings.sounds], settings.signal
    (['voice'], 'horn')
    """
    carried = "" if settings.approach == "none" else _last_signal(kinds)
    drawn = [_drawn(kind, settings, microphones, rng) for kind in kinds if kind != carried]
    return replace(settings, sounds=(*settings.sounds, *drawn), signal=carried)


def _last_signal(kinds: Sequence[str]) -> str:
    return next((kind for kind in reversed(kinds) if sound_kind(kind).origin == VEHICLE), "")


def _drawn(
    kind: str, settings: SimulationSettings, microphones: int, rng: np.random.Generator
) -> SoundSettings:
    whole = settings.duration_s
    long = whole if kind in LASTING else max(whole * rng.uniform(*SHARE), 0.05)
    start = rng.uniform(0.0, whole - long) if long < whole else 0.0
    if kind == "gusts":
        count = int(rng.integers(1, min(MAX_GUSTY, microphones) + 1))
        # Neighbours: a gust is as wide as an arm.
        first = int(rng.integers(microphones - count + 1))
        return SoundSettings(kind, start, long, channels=tuple(range(first, first + count)))
    if kind == "rain":
        missed = rng.uniform(*LENS_MISSED) if rng.random() < LENS_SHARE else 0.0
        return SoundSettings(kind, start, long, lens_missed=missed)
    sound = SoundSettings(kind, start, long, facing_rad=rng.uniform(-np.pi, np.pi))
    # What only a vehicle carries comes from another street where this one has none.
    far = BELL_M if kind == "bell" else FAR_M if sound.what.origin == VEHICLE else None
    if far is not None:
        azimuth, away = rng.uniform(-np.pi, np.pi), rng.uniform(*far)
        return replace(sound, place_m=(away * np.cos(azimuth), away * np.sin(azimuth)), facing_rad=None)
    return _in_a_street(sound, settings.site, rng)


def _in_a_street(sound: SoundSettings, site: Site, rng: np.random.Generator) -> SoundSettings:
    """Stand before a wall, behind the ego or in the crossing street; walkers walk on along it."""
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
