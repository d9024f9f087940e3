"""Noise of the ego vehicle on its own roof: engine, exhaust, tyres, airflow and wind.

Every source has a fixed position relative to the array, so its delay at each microphone is constant: the
noise is coherent across the array and comes from a few near directions. Sound from below the roof passes over
the nearest point of the roof's edge, once from the source and once from its image in the road. Wind is the
turbulence at the microphones and is uncorrelated between them. Reflections of the street's walls are a
separate field (`add_ego_echo`): they arrive near the horizon and pass the roof's edge with hardly any loss,
so they are as loud as the screened sources. Reflections by the upper side of the body are not rendered.
"""

import numpy as np

from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.scene import vehicle
from worldstate.simulation.scene.junction import Site, site_generator
from worldstate.simulation.scene.octave_bands import (
    OCTAVES_HZ,
    REFERENCE_PA,
    level_curve,
    octave_masks,
    split_octaves,
)
from worldstate.simulation.scene.presets import Preset

from .background import BlockGrid, WaveField, noise_frequencies, shaped_noise, wind_density
from .diffraction import SPEED_OF_SOUND_MPS, screen_attenuation_db
from .receiver import Receiver
from .static_field import StaticSources, azimuths_all_round, plane_wave_delays

# Positions in base_link, m: x = 0 at the array, about two metres behind the front bumper; z above the road.
TYRES_M = np.array([[1.1, 0.75, 0.1], [1.1, -0.75, 0.1], [-1.5, 0.75, 0.1], [-1.5, -0.75, 0.1]])
ENGINE_M = np.array([1.3, 0.1, 0.6])
EXHAUST_M = np.array([-2.2, -0.5, 0.3])
PILLARS_M = np.array([[0.6, 0.75, 1.1], [0.6, -0.75, 1.1]])
ROOF_X_M, ROOF_Y_M = (-1.6, 0.4), (-0.6, 0.6)
ROOF_BELOW_ARRAY_M = 0.05
ROAD_REFLECTION = 0.9
SCREEN_CAP_DB = 24.0

EXHAUST_SHARE = 0.3  # Share of the propulsion power; the rest leaves through the engine bay
# Level at 1 m and 70 km/h, per octave and pillar
FLOW_AT_70_DB = np.array([70.0, 72.0, 73.0, 72.0, 70.0, 67.0, 63.0, 58.0])
# dB per decade of speed: the power of a dipole grows with the sixth power of the flow speed
FLOW_EXPONENT = 60.0
# Octave of 100 Hz at 10 m/s behind a windscreen, fitted to the level of windows of DA1 and DB1: with 71 dB it
# is a quarter too high there, with 77 dB single seconds vary too much.
WIND_AT_10_DB = 74.0
WIND_EXPONENT = 40.0  # dB per decade: the pressure of turbulence is dynamic pressure

# Firing frequency of four cylinders over speed in gears 1 to 5, Hz per m/s; the engine idles at 800 rpm.
GEARS_HZ_PER_MPS = (14.7, 8.0, 5.4, 4.0, 3.2)
IDLE_HZ, SHIFT_UP_HZ = 26.7, 45.0
ENGINE_WANDER, WANDER_STEP_S = 0.01, 0.5

ECHO_WAVES, ECHO_ORDERS, ECHO_AT_MPS = 36, 4, 5.0
# The images of a car in the walls beside it are at its sides. Reveals and parked cars ahead return sound that
# travels forward, and contribute most of the echo. Fitted to prominence and peak of the empty and hidden
# windows of DA1 and DB1: with a share of 0.2 from all around and no channel mismatch, an empty street has a
# prominence of 1.5 (real 1.16).
ECHO_RAD, ECHO_CONCENTRATION, ECHO_AROUND, ECHO_SPREAD_DB = 1.15, 9.0, 0.8, 3.0

HEAD_START_S = 0.05  # Longer than any path on the vehicle
KNOT = 1024  # Interval at which levels are evaluated, samples


def ego_noise(
    positions_m: FloatArray,
    speed_mps: FloatArray,
    sample_rate_hz: float,
    rng: np.random.Generator,
    engine_db: float = 0.0,
    tyre_db: float = 0.0,
) -> Float32Array:
    r"""Render the noise of the ego vehicle at its own microphones, shape (n, M), Pa.

    .. math:: n_m(t) = w_m(t) + \sum_q \sum_{i \in \{0, 1\}} \frac{\rho^i\, g_{q,i}}{d_{q,i,m}}\,
              s_q\Big(t - \frac{d_{q,i,m}}{c}\Big)

    Shapes: positions_m (M, 3), speed_mps (n,).

    References
    ----------
    Directive (EU) 2015/996 as amended by (EU) 2021/1226 (sound power of vehicles). N. Curle, "The influence
    of solid boundaries upon aerodynamic sound", 1955 (sixth power). U. J. Kurze and G. S. Anderson, 1971
    (screens).
    """
    # Sum over the sources q (four tyres, engine, exhaust, two pillars) and their road images i, with the path
    # length d over the roof's edge, the screen attenuation g per octave, and wind w. Tyres and engine emit
    # the sound power of CNOSSOS-EU, category 1, the airflow that of a dipole (sixth power of the speed); wind
    # grows with the dynamic pressure. The sources run before the recording begins, so that its start is
    # complete.
    lead = round(HEAD_START_S * sample_rate_hz)
    driven = np.pad(speed_mps, (lead, 0), mode="edge")
    to_engine, to_noise, to_wind = rng.spawn(3)
    firing = _firing_hz(driven, sample_rate_hz, to_engine)
    out = np.zeros((len(positions_m), len(driven)), np.float32)
    _add_sources(out, positions_m, driven, firing, sample_rate_hz, to_noise, (engine_db, tyre_db))
    _add_wind(out, driven, sample_rate_hz, to_wind)
    return np.ascontiguousarray(out[:, lead:].T)


def add_ego(
    out: Float32Array, receiver: Receiver, site: Site, preset: Preset, rng: np.random.Generator
) -> None:
    """Add the sound of a moving ego and its echoes from the walls beside it.

    Shapes: out (M, n).
    """
    to_ego, to_echo = rng.spawn(2)
    rate, engine_db = receiver.sample_rate_hz, preset.ego_engine_db
    speed = receiver.ego.at_mps(np.arange(out.shape[1]) / rate)
    out += ego_noise(receiver.positions_m, speed, rate, to_ego, engine_db, site.surface_db).T
    add_ego_echo(out, receiver, site, engine_db, to_echo)


def add_ego_echo(
    out: Float32Array, receiver: Receiver, site: Site, engine_db: float, rng: np.random.Generator
) -> None:
    """Add the echoes of a moving ego's own sound from the walls beside it.

    Shapes: out (M, n).
    """
    if site.is_open:
        return
    grid = BlockGrid(out.shape[1], receiver.sample_rate_hz)
    speed = receiver.ego.at_mps(grid.middles_s)
    levels = _levels_db(np.append(speed, ECHO_AT_MPS), engine_db, site.surface_db)
    power = np.sum([_pressure_pa(level) ** 2 for level in levels], axis=0)
    loudness = power[:, :-1].sum(axis=0) / power[:, -1].sum()
    octaves_db = 10.0 * np.log10(power[:, -1] * echo_gain(site) / REFERENCE_PA**2)
    azimuth = azimuths_all_round(ECHO_WAVES, rng)
    field = WaveField(
        grid,
        plane_wave_delays(azimuth, np.zeros(ECHO_WAVES), receiver) + receiver.skew_s,
        level_curve(octaves_db, grid.frequencies_hz),
        loudness[:, None] * echo_lobes(site, azimuth),
        np.zeros(len(grid.frequencies_hz)),
    )
    field.add_to(out, rng)


def echo_gain(site: Site) -> float:
    """Return the power of all images in both side walls relative to 1 m; the body hides half of each.

    Examples
    --------
    >>> from worldstate.simulation.scene.junction import site
    >>> bool(0.01 < echo_gain(site("DB1")) < 0.1)
    True
    """
    order = np.arange(1, ECHO_ORDERS + 1)
    width = site.side_wall_left_m + site.side_wall_right_m
    return float((site.side_reflection ** (2 * order) / (order * width) ** 2).sum())


def echo_lobes(site: Site, azimuth_rad: FloatArray) -> FloatArray:
    """Return the share of every direction in the echoes of the walls, shape (Q,)."""
    # The two walls differ: the side with the stronger echo is a property of the site.
    level = 10.0 ** (ECHO_SPREAD_DB * site_generator(site.name, "echo").standard_normal(2) / 10.0)
    beside = np.exp(ECHO_CONCENTRATION * (np.cos(azimuth_rad[:, None] - [ECHO_RAD, -ECHO_RAD]) - 1.0))
    lobes = (beside / beside.sum(axis=0)) @ (level / level.sum())
    return np.asarray((1.0 - ECHO_AROUND) * lobes + ECHO_AROUND / len(azimuth_rad))


def _add_sources(
    out: Float32Array,
    positions: FloatArray,
    speed: FloatArray,
    firing: FloatArray,
    rate: float,
    rng: np.random.Generator,
    offsets_db: tuple[float, float],
) -> None:
    roof = _roof_edge(float(positions[:, 2].min()) - ROOF_BELOW_ARRAY_M)
    levels, static = _levels_db(speed[::KNOT], *offsets_db), StaticSources(out, rate)
    for place, level_db, lines in zip(_PLACES_M, levels, _LINE_SHARES, strict=True):
        bands = split_octaves(_emission(firing, lines, rate, rng), rate)
        bands *= _at_samples(_pressure_pa(level_db), len(speed))
        for image, reflection in ((1.0, 1.0), (-1.0, ROAD_REFLECTION)):
            length, detour = _paths_m(place * [1.0, 1.0, image], positions, roof)
            screen = 10.0 ** (-screen_attenuation_db(detour, OCTAVES_HZ, SCREEN_CAP_DB) / 20.0)
            signal = (reflection * screen).astype(np.float32) @ bands
            static.add(signal[None], length[None] / SPEED_OF_SOUND_MPS, 1.0 / length[None])
    static.render()


_PLACES_M = np.concatenate([TYRES_M, ENGINE_M[None], EXHAUST_M[None], PILLARS_M])
# Share of each source's power in harmonics of the firing frequency
_LINE_SHARES = (0.0,) * 4 + (vehicle.HARMONIC_SHARE, vehicle.HARMONIC_SHARE) + (0.0,) * 2


def _levels_db(speed: FloatArray, engine_db: float, tyre_db: float) -> list[FloatArray]:
    """Return the pressure level of every source at 1 m per octave, (8, knots), dB re 20 uPa."""
    slowest = vehicle.SLOWEST_KMH / 3.6
    # The law does not cover very low speeds; there, rolling noise fades with the speed.
    fade = 20.0 * np.log10(np.clip(speed / slowest, 1e-5, 1.0))
    tyre = vehicle.rolling_level_db(speed) + tyre_db + vehicle.POWER_TO_1M_DB
    tyre = tyre - 10.0 * np.log10(len(TYRES_M)) + fade
    propulsion = vehicle.propulsion_level_db(speed) + vehicle.POWER_TO_1M_DB + engine_db
    bay = propulsion + 10.0 * np.log10(1.0 - EXHAUST_SHARE)
    exhaust = propulsion + 10.0 * np.log10(EXHAUST_SHARE)
    relative = np.log10(np.maximum(speed, 0.1) / (70.0 / 3.6))
    flow = FLOW_AT_70_DB[:, None] + FLOW_EXPONENT * relative
    return [tyre] * len(TYRES_M) + [bay, exhaust] + [flow] * len(PILLARS_M)


def _pressure_pa(level_db: FloatArray) -> FloatArray:
    return np.asarray(REFERENCE_PA * 10.0 ** (level_db / 20.0))


def _at_samples(knots: FloatArray, samples: int) -> Float32Array:
    """Interpolate linearly between the knots, (8, knots) -> (8, n)."""
    time = np.arange(samples)
    return np.stack([np.interp(time, np.arange(len(row)) * KNOT, row) for row in knots]).astype(np.float32)


def _emission(firing: FloatArray, line_share: float, rate: float, rng: np.random.Generator) -> Float32Array:
    """Return noise and engine lines with a joint mean square of one in every octave, shape (n,)."""
    samples = len(firing)
    masks = octave_masks(noise_frequencies(samples, rate))
    # White noise divided by its own power per octave has unit pressure in each of them.
    shares = np.maximum((masks**2).mean(axis=1), 1e-6)
    shape = (masks / np.sqrt(shares)[:, None]).sum(axis=0)
    noise = shaped_noise(2.0 * (1.0 - line_share) * shape**2, samples, rng)
    if line_share == 0.0:
        return noise
    octave, crowd = vehicle.octaves_of_lines(firing)
    levels = np.sqrt(2.0 * line_share / crowd[octave]).astype(np.float32)
    drawn = zip(levels, vehicle.engine_lines(firing, np.cumsum(firing) / rate, rate, rng), strict=True)
    return np.asarray(noise + sum(level * line for level, line in drawn))


def _firing_hz(speed: FloatArray, rate: float, rng: np.random.Generator) -> FloatArray:
    """Draw the firing frequency in the highest gear for the mean speed, at least idle; it fluctuates."""
    mean = float(speed.mean())
    gear = next((g for g in reversed(GEARS_HZ_PER_MPS) if g * mean >= SHIFT_UP_HZ), GEARS_HZ_PER_MPS[0])
    knots = np.arange(0.0, len(speed) / rate + 2.0 * WANDER_STEP_S, WANDER_STEP_S)
    wander = np.interp(np.arange(len(speed)) / rate, knots, rng.standard_normal(len(knots)))
    return np.asarray(np.maximum(gear * speed, IDLE_HZ) * (1.0 + ENGINE_WANDER * np.clip(wander, -2.0, 2.0)))


def _roof_edge(height_m: float) -> FloatArray:
    """Return points round the roof, five centimetres apart, shape (E, 3)."""
    x, y = (np.linspace(*ends, round((ends[1] - ends[0]) / 0.05) + 1) for ends in (ROOF_X_M, ROOF_Y_M))
    sides = [np.stack([x, np.full_like(x, edge)], axis=1) for edge in ROOF_Y_M]
    ends = [np.stack([np.full_like(y, edge), y], axis=1) for edge in ROOF_X_M]
    flat = np.concatenate([*sides, *ends])
    return np.column_stack([flat, np.full(len(flat), height_m)])


def _paths_m(source: FloatArray, positions: FloatArray, roof: FloatArray) -> tuple[FloatArray, float]:
    """Return the shortest path over the roof's edge to every microphone, and its detour."""
    to_edge = np.linalg.norm(roof - source, axis=1)
    onward = np.linalg.norm(roof[:, None] - positions, axis=2)
    length = (to_edge[:, None] + onward).min(axis=0)
    detour = (length - np.linalg.norm(positions - source, axis=1)).mean()
    return length, float(detour)


def _add_wind(out: Float32Array, speed: FloatArray, rate: float, rng: np.random.Generator) -> None:
    """Add independent turbulence at every microphone, with a level that follows the speed."""
    shape = wind_density(WIND_AT_10_DB, noise_frequencies(len(speed), rate)) * rate
    gain = (np.maximum(speed, 0.1) / 10.0) ** (WIND_EXPONENT / 20.0)
    for channel in out:
        channel += shaped_noise(shape, len(speed), rng) * gain.astype(np.float32)
