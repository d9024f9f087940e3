"""Sound of a vehicle, its signal or a placed source at the microphones: paths, scattering, late field."""

from dataclasses import replace

import numpy as np

from worldstate.ground.typing import BoolArray, Float32Array, FloatArray
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.octave_bands import OCTAVES_HZ, split_octaves
from worldstate.simulation.scene.presets import Preset
from worldstate.simulation.scene.settings import SoundKind, SoundSettings, sound_kind
from worldstate.simulation.scene.vehicle import Trajectory, emit
from worldstate.simulation.sound.delay import KNOT_SAMPLES
from worldstate.simulation.sound.diffraction import screen_attenuation_db
from worldstate.simulation.sound.propagation import ANY_ORDER, add_sources
from worldstate.simulation.sound.renderers import ADD_SOURCE
from worldstate.simulation.sound.scatter import add_scattered
from worldstate.simulation.sound.static_field import StreetSound, add_late_sound

from .emitter import emitted
from .weather import add_gusts, add_rain, add_wind

# From this reflection order on, a vehicle is one point, because its parts would cost three times as much.
# Order 2 is too low: a shift of one metre decides whether the second image on the vehicle's own side is lit.
POINT_REFLECTIONS = 3
BASS_BELOW_HZ = 177.0  # Between the octaves of 125 and 250 Hz


def add_vehicle(street: StreetSound, path: Trajectory, rng: np.random.Generator) -> None:
    """Add one vehicle to all microphones; its motion is given at the emission knots."""
    site, preset, rate = street.site, street.preset, street.receiver.sample_rate_hz
    level = preset.vehicles_db(site) + site.surface_db + preset.vehicle_spread_db * rng.standard_normal()
    # The road surface affects the tyres alone.
    engine_db = preset.engine_spread_db * rng.standard_normal() - site.surface_db + engine_bass_db(preset)
    parts = emit(path, (len(path.time_s) - 1) * KNOT_SAMPLES, rate, level, rng, engine_db)
    whole = np.sum([one.signal for one in parts], axis=0)
    middle = 0.5 * (path.kind.axles_m[0] + path.kind.axles_m[-1])
    point = street.source(whole, path.time_s, path.behind(middle))
    if add_source := ADD_SOURCE.get(site.renderer):
        add_source(street, point, rng)
        return
    near = [street.source(one.signal, path.time_s, path.behind(one.behind_m), one.height_m) for one in parts]
    add_sources(street, near, ANY_ORDER[:POINT_REFLECTIONS])
    add_sources(street, [point], ANY_ORDER[POINT_REFLECTIONS:])
    add_scattered(street, point)
    add_late_sound(street, whole, path.behind(0.0), path.time_s, rng)


def engine_bass_db(preset: Preset) -> FloatArray:
    """Return the level of an engine per octave relative to CNOSSOS, shape (8, 1).

    Examples
    --------
    >>> engine_bass_db(Preset("deep", engine_bass_db=3.0))[:3, 0].tolist()
    [3.0, 3.0, 0.0]
    """
    return np.where(OCTAVES_HZ < BASS_BELOW_HZ, preset.engine_bass_db, 0.0)[:, None]


# Blocks of silence before and after a sound, because the octave bands of a sudden sound begin a little
# earlier than the sound.
SILENT_BLOCKS = 8
# Levels of the table are free-field levels; those in `diffraction.ground_gain` include hard ground.
GROUND_GAIN = np.sqrt(2.0)
# Height and distance of the roofs, two storeys high, over which sound from outside both streets arrives.
ROOF_HEIGHT_M, ROOF_AWAY_M = 7.0, 4.0
# Generated at the microphones, without a position
WEATHER = {"rain": add_rain, "gusts": add_gusts, "wind": add_wind}


def add_sound(street: StreetSound, sound: SoundSettings, rng: np.random.Generator) -> None:
    """Add one sound that does not belong to a vehicle to all microphones."""
    if sound.kind in WEATHER:
        WEATHER[sound.kind](street.static, sound, street.receiver, rng)
        return
    rate, folder = street.receiver.sample_rate_hz, street.preset.sounds_folder
    samples = round(sound.duration_s * rate)
    blocks = -(-samples // KNOT_SAMPLES) + 2 * SILENT_BLOCKS
    before = SILENT_BLOCKS * KNOT_SAMPLES
    signal = np.zeros(blocks * KNOT_SAMPLES, np.float32)
    level = np.float32(10.0 ** (sound.level_offset_db / 20.0))
    signal[before : before + samples] = level * emitted(sound.what, samples, rate, rng, folder)
    time = sound.start_s + (np.arange(blocks + 1) - SILENT_BLOCKS) * KNOT_SAMPLES / rate
    _add_from(street, signal, time, sound.at(time), sound.facing(time), sound.what, rng)


def add_signal(street: StreetSound, signal: str, path: Trajectory, rng: np.random.Generator) -> None:
    """Add the warning signal of a vehicle, from its front or rear, along its path."""
    kind = sound_kind(signal)
    samples = (len(path.time_s) - 1) * KNOT_SAMPLES
    (front_x, front_y), (rear_x, rear_y) = path.behind(0.0), path.behind(path.kind.length_m)
    heading = np.arctan2(kind.faces * (front_y - rear_y), kind.faces * (front_x - rear_x))
    place = (front_x, front_y) if kind.faces > 0.0 else (rear_x, rear_y)
    pressure = emitted(kind, samples, street.receiver.sample_rate_hz, rng, street.preset.sounds_folder)
    _add_from(street, pressure, path.time_s, place, heading, kind, rng)


def _add_from(
    street: StreetSound,
    signal: Float32Array,
    time_s: FloatArray,
    place_m: tuple[FloatArray, FloatArray],
    facing_rad: FloatArray,
    kind: SoundKind,
    rng: np.random.Generator,
) -> None:
    """Add a sound along every path; walls and the late field receive its mean over all directions."""
    site, rate, (x, y) = street.site, street.receiver.sample_rate_hz, place_m
    to_ego = street.receiver.ego.x_m(time_s) - x
    angle = np.arctan2(-y, to_ego) - facing_rad
    towards = _gained(signal, directivity(kind, angle), rate) * GROUND_GAIN
    # Rays carry sound over roofs.
    if site.renderer != "rays" and not in_the_streets(site, x, y).all():
        over = _gained(towards, over_roofs(street, np.hypot(to_ego, y), kind.height_m), rate)
        beyond = street.source(over, time_s, place_m, kind.height_m)
        add_sources(replace(street, site=in_the_open(site)), [beyond])
        return
    source = street.source(towards, time_s, place_m, kind.height_m)
    if add_source := ADD_SOURCE.get(site.renderer):
        add_source(street, source, rng)
        return
    add_sources(street, [source])
    mean = _gained(signal, np.broadcast_to(mean_gain(kind), (len(angle), 8)), rate) * GROUND_GAIN
    add_scattered(street, street.source(mean, time_s, place_m, kind.height_m))
    add_late_sound(street, mean, place_m, time_s, rng)


def directivity(kind: SoundKind, angle_rad: FloatArray) -> FloatArray:
    r"""Return the amplitude per octave at an angle from the direction that a sound faces, shape (T, 8).

    .. math:: g(\theta) = \frac{1 + \cos\theta}{2} + \frac{1 - \cos\theta}{2}\, 10^{D / 20}
    """
    back = 10.0 ** (np.array(kind.back_db) / 20.0)
    ahead = 0.5 * (1.0 + np.cos(angle_rad))[:, None]
    return np.asarray(ahead + (1.0 - ahead) * back)


def mean_gain(kind: SoundKind) -> FloatArray:
    """Return the RMS of the directivity over all horizontal directions per octave, shape (8,)."""
    every = directivity(kind, np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False))
    return np.asarray(np.sqrt(np.square(every).mean(axis=0)))


def in_the_streets(site: Site, x: FloatArray, y: FloatArray) -> BoolArray:
    """Return when a sound is in the ego's or the crossing street, or in the open, shape (T,)."""
    if site.is_open:
        return np.ones(len(x), np.bool_)
    own = (x <= site.corner_ahead_m) & (y <= site.side_wall_left_m) & (y >= -site.side_wall_right_m)
    end = site.corner_ahead_m + site.street_width_m if site.opposite_wall_m is None else site.opposite_wall_m
    return own | ((x >= site.corner_ahead_m) & (x <= end))


def over_roofs(street: StreetSound, away: FloatArray, height_m: float) -> FloatArray:
    """Return the amplitude over the nearest roof, relative to a straight line, per octave, shape (T, 8)."""
    (_, _, array_z), cap_db = street.receiver.centre_m, street.preset.screen_cap_db
    beyond, rise = np.maximum(away - ROOF_AWAY_M, 0.0), ROOF_HEIGHT_M - array_z
    bent = np.hypot(ROOF_AWAY_M, rise) + np.hypot(beyond, ROOF_HEIGHT_M - height_m)
    detour = bent - np.hypot(away, height_m - array_z)
    clear = array_z + (height_m - array_z) * ROOF_AWAY_M / np.maximum(away, ROOF_AWAY_M) > ROOF_HEIGHT_M
    loss_db = screen_attenuation_db(np.where(clear, -detour, detour)[:, None], OCTAVES_HZ, cap_db)
    return np.asarray(10.0 ** (-loss_db / 20.0))


def in_the_open(site: Site) -> Site:
    """Return a site of the same name without streets."""
    return replace(site, opposite_wall_m=None, in_the_open=True)


def _gained(signal: Float32Array, gain: FloatArray, rate_hz: float) -> Float32Array:
    """Weight the octaves of a signal by gains (T, 8) at its knots."""
    knots = np.arange(len(gain)) * KNOT_SAMPLES
    out, samples = np.zeros(len(signal), np.float32), np.arange(len(signal))
    for band, values in zip(split_octaves(signal, rate_hz), gain.T, strict=True):
        out += band * np.interp(samples, knots, values).astype(np.float32)
    return out
