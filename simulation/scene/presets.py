"""Levels and spectra of everything that is not geometry, as named and frozen presets.

`street-6` changed the physics of `street-5`. Each site has its own ambient level, spectrum, wind and openings
(`Ambience`). Ambience and distant traffic enter through these openings as extended sources that fluctuate and
move slowly; in `street-5` a distant vehicle was one plane wave, or two with its echo. The channel mismatch
applies to the background as it does to vehicles. Vehicles vary more in level and in engine load, which
follows the acceleration.

Levels and spreads were fitted to OVAD's released windows of SA1, SB1 and SB2 (moving ego: DA1, DB1), first by
hand in some fifty trials. Then the parts of 36 approaches and 36 empty windows (tyres and engine along
mirrored, scattered and late paths; ambience) were rendered once and mixed at other levels. A random search of
about 350 steps minimised the summed squared differences of level, peak, prominence, change and spread of the
level, overall and per site. The result was rounded and checked with other seeds. The main finding: low bins,
at which the array cannot resolve directions, must be incoherent (`wind_100hz_db`, `engine_bass_db`) and high
bins coherent (`delay_mismatch_s`); otherwise no vehicle is prominent. The search used no classifier and no
count of false alarms.

The plans of sites and the drivers were fitted after that search. Four joint checks of 8 to 12 windows per
class, side and site then changed the wind, the late field and the level of vehicles by a few dB. The last
check (seed 203) gave, for real and simulated windows:

- hidden: level 0.192, 0.191; peak 0.280, 0.289; prominence 1.44, 1.50; change 0.173, 0.177; deviation of the
  log level 0.113, 0.125;
- in front: 0.196, 0.201; 0.328, 0.347; 1.80, 1.86; 0.222, 0.206; 0.106, 0.116;
- empty: 0.149, 0.153; 0.193, 0.192; 1.25, 1.23; 0.050, 0.059; 0.305, 0.226.

Remaining differences: real hidden windows of SB1 are quieter (0.186, 0.164), and their pattern has deeper
valleys (deviation 0.379, 0.477). For a moving ego, simulated windows are a quarter too loud (empty 0.157,
0.198) and hidden vehicles too prominent (1.17, 1.28).

`street-7` is fitted to the inputs of a sequence in 23 approaches and 22 hazard-free recordings at SA1, SB1
and SB3 (two microphones): level and bands by time before T0, and their deviation and autocorrelation without
a vehicle. Vehicles are a quarter faster (seven real ones pass SB1 at 5.0 to 6.5 m/s), which makes their tyres
2.9 dB louder; their level is 4.5 dB lower. Between walls the late field is 3 dB lower, distant vehicles are 2
dB lower, the ambience has more energy at 1 and 2 kHz, and the whole background flickers. Seven candidates
were rendered at four junctions; the chosen one has the smallest distance to SA1 and SB1, as the median over
the inputs. No classification score was used.

`street-6-calm` has half as many distant vehicles, 4 dB fainter.

Two earlier choices used evaluation data. The wind and drivers of `street-5` were set on medians of the same
sites, and its distant vehicles on the published false alarms. `street-2` was chosen after one look at a
classifier's scores on simulated windows; the part of it that remains (ambient octaves) is older than that
look. Earlier presets are not offered, because the code of their physics was removed. A changed preset gets a
new name.
"""

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from worldstate.ground.checks import finite_array, in_range, one_of
from worldstate.ground.typing import FloatArray

from .junction import Site, site_generator


def _within(low: float, high: float, default: float) -> Any:
    """Declare a number of a preset and its limits."""
    return field(default=default, metadata={"limits": (low, high)})


@dataclass(frozen=True, slots=True)
class Preset:
    """Background, late field and vehicle levels; dB re 20 uPa unless stated otherwise.

    Parameters
    ----------
    name : str
        Name and version.
    ambient_octaves_db : tuple of 8 float
        Level of the ambient field per octave, 62.5 Hz .. 8 kHz.
    site_ambient_db, ambient_spread_db : float
        Standard deviation of the ambient level between sites, and between recordings of a site.
    ambient_waves : int
        Number of directions of the ambient field.
    sky_share : float
        Share of the ambient field that arrives from all directions; the rest enters by the street's openings.
    opening_db, site_opening_db, opening_spread_db : float
        Level of one opening relative to the ambient level, and its standard deviations between sites and
        between recordings.
    wave_fluctuation_db : float
        Standard deviation of the level of each single direction over time.
    flicker_db : float
        Standard deviation of the fast change of the whole background in one octave.
    far_rate : float
        Mean number of distant vehicles in ten seconds.
    far_level_db, far_spread_db : float
        Maximum level of a distant vehicle relative to the ambient level, and its standard deviation.
    wind_100hz_db : float
        Level of the uncorrelated noise of wind and roof at each microphone in the octave of 100 Hz; falls
        with f^-3.7.
    site_wind_db, wind_spread_db : float
        Standard deviation of the wind between sites and between recordings.
    self_noise_db : float
        Electronic noise per microphone, up to 24 kHz.
    gain_mismatch_db, delay_mismatch_s : float
        Standard deviation of the channels' gains and delays; the latter includes scattering at the roof.
    late_walled_db, late_open_db : float
        Late field of a vehicle at the mouth of the street relative to its pressure at 1 m, dB, with a wall
        opposite (type A) and without (type B).
    late_decay_s : float
        Reverberation time of the late field.
    vehicle_level_db, vehicle_spread_db : float
        Mean level of vehicles relative to CNOSSOS on its reference asphalt, and its standard deviation; the
        road surface of a site is added to the tyres.
    traced_vehicle_db : float
        Level that is added to that mean in streets of the second renderer, which are wider.
    speed_factor : float
        Speed of vehicles relative to `SPEEDS_MPS`.
    engine_spread_db : float
        Standard deviation of an engine's level relative to its vehicle's: make, gear and load, from coasting
        or battery to full power.
    engine_bass_db : float
        Level of vehicles' engines in the octaves of 62.5 and 125 Hz relative to CNOSSOS: below 30 km/h a
        modern petrol engine has less bass than the fleet of its coefficients.
    ego_engine_db : float
        Level of a moving ego's engine and exhaust relative to a car's in CNOSSOS; a hybrid approaches a
        corner on its battery.
    screen_cap_db : float
        Largest screen attenuation.
    wall_scattering : float
        Share of the energy that rough walls scatter at high frequencies in place of mirroring it, 0..1.
    late_lobe_share : float
        Share of the late field that arrives from a site's own directions.
    sounds_folder : str
        Folder of recordings, one folder per kind of sound, that replace synthesis; none if empty.

    Raises
    ------
    InvalidArgumentError
        If a number is outside its limits.

    Examples
    --------
    >>> Preset("windy", wind_100hz_db=75.0).wind_100hz_db
    75.0
    """

    name: str
    ambient_octaves_db: tuple[float, ...] = (55.0, 54.5, 54.0, 52.0, 47.5, 40.0, 34.0, 28.0)
    ambient_spread_db: float = _within(0.0, 20.0, 1.6)
    ambient_waves: int = _within(8, 512, 72)
    wave_fluctuation_db: float = _within(0.0, 20.0, 2.0)
    flicker_db: float = _within(0.0, 10.0, 0.0)
    sky_share: float = _within(0.0, 1.0, 0.7)
    opening_db: float = _within(-40.0, 20.0, -6.0)
    site_ambient_db: float = _within(0.0, 20.0, 4.0)
    site_wind_db: float = _within(0.0, 20.0, 3.0)
    site_opening_db: float = _within(0.0, 20.0, 3.0)
    opening_spread_db: float = _within(0.0, 20.0, 2.0)
    wind_spread_db: float = _within(0.0, 20.0, 2.6)
    far_spread_db: float = _within(0.0, 20.0, 3.0)
    far_rate: float = _within(0.0, 10.0, 0.6)
    far_level_db: float = _within(-60.0, 30.0, -1.0)
    wind_100hz_db: float = _within(-20.0, 100.0, 60.5)
    self_noise_db: float = _within(0.0, 80.0, 40.0)
    gain_mismatch_db: float = _within(0.0, 10.0, 0.5)
    delay_mismatch_s: float = _within(0.0, 1e-3, 1e-5)
    late_walled_db: float = _within(-90.0, 0.0, -12.0)
    late_open_db: float = _within(-90.0, 0.0, -24.0)
    late_decay_s: float = _within(0.05, 5.0, 0.7)
    vehicle_level_db: float = _within(-30.0, 30.0, 3.0)
    vehicle_spread_db: float = _within(0.0, 20.0, 2.4)
    traced_vehicle_db: float = _within(-30.0, 30.0, 0.0)
    speed_factor: float = _within(0.2, 5.0, 1.0)
    engine_spread_db: float = _within(0.0, 20.0, 3.4)
    engine_bass_db: float = _within(-40.0, 20.0, -10.0)
    ego_engine_db: float = _within(-60.0, 20.0, -15.0)
    screen_cap_db: float = _within(5.0, 60.0, 24.0)
    wall_scattering: float = _within(0.0, 1.0, 0.15)
    late_lobe_share: float = _within(0.0, 1.0, 0.75)
    sounds_folder: str = ""

    def __post_init__(self) -> None:
        octaves = finite_array("ambient_octaves_db", self.ambient_octaves_db, (8,))
        in_range("ambient_octaves_db", octaves.min(), -20.0, 100.0)
        in_range("ambient_octaves_db", octaves.max(), -20.0, 100.0)
        for one in fields(self):
            if "limits" in one.metadata:
                in_range(one.name, getattr(self, one.name), *one.metadata["limits"])

    def vehicles_db(self, site: Site) -> float:
        """Return the mean level of vehicles at a site relative to CNOSSOS, without its road surface."""
        return self.vehicle_level_db + self.traced_vehicle_db * (site.renderer == "rays")


PRESETS = {
    preset.name: preset
    for preset in (
        Preset("street-6"),
        Preset("street-6-calm", far_rate=0.3, far_level_db=-5.0),
        Preset(
            "street-7",
            (55.0, 54.5, 54.0, 52.0, 48.5, 42.5, 34.0, 28.0),
            flicker_db=1.1,
            far_level_db=-3.0,
            late_walled_db=-15.0,
            vehicle_level_db=-1.5,
            traced_vehicle_db=3.0,
            speed_factor=1.25,
        ),
    )
}
DEFAULT_PRESET = "street-6"


def preset(name: str = DEFAULT_PRESET) -> Preset:
    """Return a preset by its name.

    Parameters
    ----------
    name : str
        One of `PRESETS`.

    Returns
    -------
    Preset
        Levels and spectra of everything that is not geometry.

    Raises
    ------
    InvalidArgumentError
        If the name is unknown.

    Examples
    --------
    >>> preset("street-6").ambient_waves
    72
    """
    return PRESETS[one_of("preset", name, PRESETS)]


OPENINGS = ("left", "right", "ahead", "behind")
# Neighbouring octaves of traffic noise rise and fall together: a common tilt and a small residue.
TILT_DB_PER_OCTAVE, OCTAVE_SPREAD_DB = 0.7, 0.7
# Level of the sound from ahead that passes over a facade opposite, two or three floors high.
OVER_THE_WALL_DB = -8.0
# Factor on the spread of the wind: low between walls, high at an open corner. The levels of released windows
# of SB1, hidden and in front alike, spread three times as far as those of SA1 and SB2. The logarithm is drawn
# uniformly.
GUSTINESS = (0.13, 2.5)
TURNED_RAD = 0.12  # No street is exactly in line with another


@dataclass(frozen=True, slots=True, eq=False)
class Ambience:
    """Ambient field of one site, or of one recording there.

    A court at night and a street beside a main road differ more than two recordings of the same place. Level,
    spectrum and openings of a site are drawn once from its name and are the same in all its recordings.
    """

    octaves_db: FloatArray  # shape (8,): Level of the whole field, dB re 20 uPa
    wind_db: float  # Level of the wind at the microphones relative to the preset's
    gustiness: float  # Factor on the spread of the wind between recordings
    openings_db: FloatArray  # shape (4,): Level of each of `OPENINGS` relative to the whole field, dB
    turned_rad: FloatArray  # shape (4,): Azimuth of each relative to its nominal one


def site_ambience(site: Site, preset: Preset) -> Ambience:
    """Draw the constant part of a site's ambience.

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
    """Draw the ambience of one recording."""
    # All draws are independent: level of the town, wind, traffic of each street.
    octaves = of_site.octaves_db + preset.ambient_spread_db * rng.standard_normal()
    wind_db = of_site.wind_db + of_site.gustiness * preset.wind_spread_db * rng.standard_normal()
    openings = of_site.openings_db + preset.opening_spread_db * rng.standard_normal(len(OPENINGS))
    return replace(of_site, octaves_db=octaves, wind_db=wind_db, openings_db=openings)
