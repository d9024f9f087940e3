"""What belongs to a place of what is heard there when nothing drives near: its face in sound.

A court at night and a street beside a main road differ by more than two recordings of either. Level,
spectrum and openings of a site are drawn once from its name and kept from recording to recording.
"""

from dataclasses import dataclass, replace

import numpy as np

from worldstate.ground.typing import FloatArray

from .junction import Site, site_generator
from .presets import Preset

OPENINGS = ("left", "right", "ahead", "behind")
# Neighbouring octaves of traffic noise rise and fall together: a tilt, and little beside it.
TILT_DB_PER_OCTAVE, OCTAVE_SPREAD_DB = 0.7, 0.7
# So much of what comes from ahead a facade opposite, two or three floors high, leaves.
OVER_THE_WALL_DB = -8.0
# Between walls hardly, on an open corner much: levels of the released windows of SB1, hidden and in front
# alike, spread three times as far as those of SA1 and SB2. The logarithm is drawn evenly.
GUSTINESS = (0.13, 2.5)
TURNED_RAD = 0.12  # no street is exactly in line with another


@dataclass(frozen=True, slots=True, eq=False)
class Ambience:
    """Ambient field of one site, or of one recording there."""

    octaves_db: FloatArray  # shape (8,): Level of the whole field, dB re 20 uPa
    wind_db: float  # Of the wind at the microphones, against the preset's
    gustiness: float  # How much more it differs from recording to recording than the preset says
    openings_db: FloatArray  # shape (4,): Share of each of `OPENINGS` of that level, dB
    turned_rad: FloatArray  # shape (4,): Azimuth of each against its nominal one


def site_ambience(site: Site, preset: Preset) -> Ambience:
    """Draw what a site keeps.

    Examples
    --------
    >>> from worldstate.simulation.scene import junction, presets
    >>> one, again = (site_ambience(junction.site("SA1"), presets.preset()) for _ in range(2))
    >>> bool(np.array_equal(one.octaves_db, again.octaves_db))
    True
    """
    fixed = site_generator(site.name, "ambience")
    tilt = TILT_DB_PER_OCTAVE * fixed.standard_normal() * (np.arange(8) - 3.5)
    shape = tilt + OCTAVE_SPREAD_DB * fixed.standard_normal(8)
    octaves = np.array(preset.ambient_octaves_db) + preset.site_ambient_db * fixed.standard_normal() + shape
    openings = preset.opening_db + preset.site_opening_db * fixed.standard_normal(len(OPENINGS))
    if site.opposite_wall_m is not None:
        openings[OPENINGS.index("ahead")] += OVER_THE_WALL_DB
    wind_db = preset.site_wind_db * fixed.standard_normal()
    turned = TURNED_RAD * fixed.standard_normal(len(OPENINGS))
    return Ambience(octaves, wind_db, float(np.exp(fixed.uniform(*np.log(GUSTINESS)))), openings, turned)


def recording_ambience(of_site: Ambience, preset: Preset, rng: np.random.Generator) -> Ambience:
    """Draw what one recording makes of it."""
    # No two draws depend on each other: how loud the town is, how it blows, which street is busy.
    octaves = of_site.octaves_db + preset.ambient_spread_db * rng.standard_normal()
    wind_db = of_site.wind_db + of_site.gustiness * preset.wind_spread_db * rng.standard_normal()
    openings = of_site.openings_db + preset.opening_spread_db * rng.standard_normal(len(OPENINGS))
    return replace(of_site, octaves_db=octaves, wind_db=wind_db, openings_db=openings)
