"""Everything that one vehicle adds to the microphones: its paths, its scattered and its late sound."""

import numpy as np

from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.octave_bands import OCTAVES_HZ
from worldstate.simulation.scene.presets import Preset
from worldstate.simulation.scene.vehicle import SOURCE_HEIGHT_M, Trajectory, emit

from .delay import KNOT_SAMPLES, Emission, MovingSource
from .propagation import ANY_ORDER, add_sources
from .receiver import Receiver, Surroundings
from .scatter import add_scattered, scattering
from .static_field import StaticSources, add_late_sound

# From so many reflections on a vehicle is one point; its parts would cost three times as much. Not from 2 on:
# whether the second image is lit, on the vehicle's own side, hangs on a metre.
POINT_REFLECTIONS = 3
BASS_BELOW_HZ = 177.0  # between the octaves of 125 and 250 Hz


def add_vehicle(
    static: StaticSources,
    site: Site,
    preset: Preset,
    path: Trajectory,
    receiver: Receiver,
    rng: np.random.Generator,
) -> None:
    """Add one vehicle, whose motion is given at the emission knots, to all microphones."""
    rate = receiver.sample_rate_hz
    level = preset.vehicle_level_db + site.surface_db + preset.vehicle_spread_db * rng.standard_normal()
    # What the road adds is heard of the tyres alone.
    engine_db = preset.engine_spread_db * rng.standard_normal() - site.surface_db + engine_bass_db(preset)
    parts = emit(path, (len(path.time_s) - 1) * KNOT_SAMPLES, rate, level, rng, engine_db)
    sources = [_moving(path, one.signal, one.behind_m, one.height_m, rate) for one in parts]
    around = Surroundings(site, receiver, preset.screen_cap_db, scattering(preset), outdoors=True)
    whole = np.sum([one.signal for one in parts], axis=0)
    middle = 0.5 * (path.kind.axles_m[0] + path.kind.axles_m[-1])
    far = _moving(path, whole, middle, SOURCE_HEIGHT_M, rate)
    add_sources(static, sources, around, ANY_ORDER[:POINT_REFLECTIONS])
    add_sources(static, [far], around, ANY_ORDER[POINT_REFLECTIONS:])
    add_scattered(static, far, around)
    add_late_sound(static, whole, path.behind(0.0), path.time_s, site, preset, receiver, rng)


def engine_bass_db(preset: Preset) -> FloatArray:
    """Level of an engine per octave against CNOSSOS, shape (8, 1).

    Examples
    --------
    >>> engine_bass_db(Preset("deep", engine_bass_db=3.0))[:3, 0].tolist()
    [3.0, 3.0, 0.0]
    """
    return np.where(OCTAVES_HZ < BASS_BELOW_HZ, preset.engine_bass_db, 0.0)[:, None]


def _moving(
    path: Trajectory, signal: Float32Array, behind_m: float, height_m: float, rate: float
) -> MovingSource:
    return MovingSource(Emission.of(signal, path.time_s[0], rate), *path.behind(behind_m), height_m)
