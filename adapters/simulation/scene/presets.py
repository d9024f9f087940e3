"""Levels and shapes of everything that is not geometry: named, versioned, frozen.

`street-5` differs from `street-4` in this. Distant vehicles are a Poisson process that knows nothing of a
recording's ends, so that a short recording hears as many as a long one. Wind is 1 dB louder. Drivers are
slower where a wall stands opposite, faster where none does, and more of them brake (`settings.py`). Wind
and drivers were set by hand, in a dozen tries, on medians of level, peak, width, prominence and change of
the released windows of SA1, SB1 and SB2, beside simulated windows cut as those are; no classifier was
involved. The rest comes from `street-4` and `street-3`, which were set on the same medians with windows cut
too early.

Distant vehicles are the free knob of false alarms. The published rule, trained on the same simulated
junctions as in the evaluation, made on 40 hazard-free recordings of another seed: 158 false alarms
an hour with 0.4 in ten seconds at +4 dB, 227 with 0.7, 208 with 1.2 (the classifier learns to live
with them), and 336 with 0.6 at +8 dB, which is nearest to the published 350 and was taken.

`street-5-calm` is the first of those four settings under a name of its own: a street that
the published rule finds half as busy.

The history is not all clean: `street-2` was chosen among candidates after one look at a classifier's scores
on simulated windows; what was kept of it (ambient octaves) is older than that look. And before this knob
was set, the published figures had been counted on `street-4`, whose areas were too high and false alarms
too few. Earlier presets are not offered: the physics that they were set with is gone. A change is a new
name.
"""

from dataclasses import dataclass

from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError

LIMITS: dict[str, tuple[float, float]] = {
    "ambient_spread_db": (0.0, 20.0),
    "ambient_waves": (8, 512),
    "lobe_concentration": (0.0, 50.0),
    "lobe_share": (0.0, 1.0),
    "wave_fluctuation_db": (0.0, 20.0),
    "far_rate": (0.0, 10.0),
    "far_level_db": (-60.0, 30.0),
    "wind_100hz_db": (-20.0, 100.0),
    "self_noise_db": (0.0, 80.0),
    "gain_mismatch_db": (0.0, 10.0),
    "delay_mismatch_s": (0.0, 1e-3),
    "late_walled_db": (-90.0, 0.0),
    "late_open_db": (-90.0, 0.0),
    "late_decay_s": (0.05, 5.0),
    "vehicle_level_db": (-30.0, 30.0),
    "vehicle_spread_db": (0.0, 20.0),
    "screen_cap_db": (5.0, 60.0),
    "wall_scattering": (0.0, 1.0),
    "late_lobe_share": (0.0, 1.0),
}


@dataclass(frozen=True, slots=True)
class Preset:
    """Background, late field and vehicle levels; dB re 20 uPa unless said otherwise.

    Parameters
    ----------
    name : str
        Name and version.
    ambient_octaves_db : tuple of 8 float
        Level of the ambient field per octave, 62.5 Hz .. 8 kHz.
    ambient_spread_db : float
        Standard deviation of the ambient level between recordings.
    ambient_waves : int
        Number of plane waves that make the ambient field.
    lobe_concentration, lobe_share : float
        Von Mises concentration of a site's loud directions and the share of energy that comes from them.
    wave_fluctuation_db : float
        Standard deviation of the slow wander of every single wave.
    far_rate : float
        Mean number of distant vehicles in ten seconds.
    far_level_db : float
        Level of a distant vehicle at its loudest against the ambient level, dB.
    wind_100hz_db : float
        Wind noise on every microphone by itself, in the octave of 100 Hz; falls with f^-2.2.
    self_noise_db : float
        Electronic noise per microphone, whole band.
    gain_mismatch_db, delay_mismatch_s : float
        Standard deviation of the channels' gains and delays; the latter includes scattering at the roof.
    late_walled_db, late_open_db : float
        Late field of a vehicle at the mouth against its pressure at 1 m, dB, in a crossing street with a wall
        opposite (type A) and without (type B).
    late_decay_s : float
        Reverberation time of the late field.
    vehicle_level_db, vehicle_spread_db : float
        Mean level of vehicles against CNOSSOS on its reference asphalt (brick paving: some 3 to 6 dB more)
        and its standard deviation.
    screen_cap_db : float
        Largest screen attenuation.
    wall_scattering : float
        Share of the energy that rough walls scatter instead of mirroring it, at high frequencies, 0..1.
    late_lobe_share : float
        Share of the late field that comes from a site's own directions.

    Raises
    ------
    InvalidArgumentError
        If a number is outside `LIMITS`.

    Examples
    --------
    >>> Preset("windy", wind_100hz_db=66.0).wind_100hz_db
    66.0
    """

    name: str
    ambient_octaves_db: tuple[float, ...] = (57.0, 56.0, 56.0, 54.0, 52.0, 47.0, 41.0, 35.0)
    ambient_spread_db: float = 1.5
    ambient_waves: int = 72
    lobe_concentration: float = 2.0
    lobe_share: float = 0.1
    wave_fluctuation_db: float = 2.5
    far_rate: float = 0.6
    far_level_db: float = 8.0
    wind_100hz_db: float = 58.0
    self_noise_db: float = 38.0
    gain_mismatch_db: float = 0.5
    delay_mismatch_s: float = 1.05e-4
    late_walled_db: float = -14.0
    late_open_db: float = -38.0
    late_decay_s: float = 0.7
    vehicle_level_db: float = 5.0
    vehicle_spread_db: float = 1.5
    screen_cap_db: float = 24.0
    wall_scattering: float = 0.15
    late_lobe_share: float = 0.75

    def __post_init__(self) -> None:
        octaves = finite_array("ambient_octaves_db", self.ambient_octaves_db, (8,))
        in_range("ambient_octaves_db", octaves.min(), -20.0, 100.0)
        in_range("ambient_octaves_db", octaves.max(), -20.0, 100.0)
        for name, (low, high) in LIMITS.items():
            in_range(name, getattr(self, name), low, high)


PRESETS = {
    preset.name: preset
    for preset in (Preset("street-5"), Preset("street-5-calm", far_rate=0.4, far_level_db=4.0))
}
DEFAULT_PRESET = "street-5"


def preset(name: str = DEFAULT_PRESET) -> Preset:
    """Return a preset by its name.

    Parameters
    ----------
    name : str
        One of `PRESETS`.

    Returns
    -------
    Preset
        Levels of everything that is not geometry.

    Raises
    ------
    InvalidArgumentError
        For an unknown name.

    Examples
    --------
    >>> preset("street-5").ambient_waves
    72
    """
    if name not in PRESETS:
        raise InvalidArgumentError(f"preset: expected one of {', '.join(PRESETS)}, got {name!r}")
    return PRESETS[name]
