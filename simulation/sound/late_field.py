"""The late, diffuse part of a vehicle's sound: its energy without its direction.

Every direction gets a tail of its own. One common tail on all microphones would be a source at broadside.
"""

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.scene.junction import Site, site_generator
from worldstate.simulation.scene.presets import Preset

from .delay import KNOT_SAMPLES
from .receiver import Receiver
from .static_field import StaticSources, azimuths_all_round, plane_wave_delays, unit_vectors

DIRECTIONS = 48
LOBES, LOBE_CONCENTRATION, LOBE_SPAN_RAD = 4, 8.0, 1.3
ELEVATION_RAD = 0.3
LATE_DISTANCE_M = 8.0  # so far from the mouth a source feeds the late field half as much
WAVES_AT_ONCE = 4
TAIL_DECAYS = 1.0  # length of a tail in reverberation times (60 dB)


def street_field(site: Site, lobe_share: float) -> tuple[FloatArray, FloatArray]:
    """Directions from which late sound reaches the array in a street, and their shares of the energy.

    Examples
    --------
    >>> from worldstate.simulation.scene.junction import site
    >>> directions, shares = street_field(site("SA1"), 0.5)
    >>> directions.shape, round(float(shares.sum()), 6)
    ((48, 3), 1.0)
    """
    # Between walls and under an open sky late sound is near the horizon; it comes in by the mouth and from
    # what stands there, so that a site has late directions of its own, ahead.
    rng = site_generator(site.name, "late")
    azimuth = azimuths_all_round(DIRECTIONS, rng)
    elevation = np.abs(rng.normal(0.0, ELEVATION_RAD, DIRECTIONS))
    centres, weights = rng.uniform(-LOBE_SPAN_RAD, LOBE_SPAN_RAD, LOBES), rng.dirichlet(np.full(LOBES, 3.0))
    lobes = np.exp(LOBE_CONCENTRATION * (np.cos(azimuth[:, None] - centres) - 1.0))
    shares = lobe_share * (lobes / lobes.sum(axis=0)) @ weights + (1.0 - lobe_share) / DIRECTIONS
    return unit_vectors(azimuth, elevation), shares


def add_late_field(
    static: StaticSources,
    dry: Float32Array,
    decay_s: float,
    positions_m: FloatArray,
    rng: np.random.Generator,
    field: tuple[FloatArray, FloatArray],
) -> None:
    """Add a diffuse tail of a dry signal.

    Shapes: dry (pre + samples,), positions_m (M, 3), field (ndarray, ndarray).
    """
    directions, shares = field
    samples = static.out.shape[1]
    tail = max(int(TAIL_DECAYS * decay_s * static.sample_rate_hz), 1)
    n = next_fast_len(len(dry) + tail, real=True)
    spectrum = rfft(dry, n)
    envelope = 10.0 ** (-3.0 * np.arange(tail) / tail * TAIL_DECAYS)
    envelope /= np.sqrt((envelope**2).sum())
    waves = np.empty((len(shares), samples), np.float32)
    # Transforms of a few are done side by side: one by one they take twice as long, all at once as well.
    for first in range(0, len(shares), WAVES_AT_ONCE):
        some = slice(first, first + WAVES_AT_ONCE)
        drawn = rng.standard_normal((len(shares[some]), tail))
        responses = (np.sqrt(shares[some])[:, None] * envelope * drawn).astype(np.float32)
        tails = rfft(responses, n)
        tails *= spectrum
        waves[some] = irfft(tails, n)[:, len(dry) - samples : len(dry)]
    offsets = positions_m - positions_m.mean(axis=0)
    static.add(waves, plane_wave_delays(directions, offsets))


def add_late_sound(
    static: StaticSources,
    signal: Float32Array,
    place_m: tuple[FloatArray, FloatArray],
    time_s: FloatArray,
    site: Site,
    preset: Preset,
    receiver: Receiver,
    rng: np.random.Generator,
) -> None:
    """Add the late sound of a source; its signal lasts from the first of its emission knots to the last.

    Shapes: signal (n,), place_m (x (T,), y (T,)), time_s (T,).
    """
    if site.is_open:
        return  # nothing stands there that could send late sound
    dry = _until_the_end(signal * _late_gain(site, preset, *place_m, time_s, receiver), time_s[0], receiver)
    field = street_field(site, preset.late_lobe_share)
    add_late_field(static, dry, preset.late_decay_s, receiver.positions_m, rng, field)


def late_level_db(site: Site, preset: Preset) -> float:
    """Late field of a source at the mouth against its pressure at 1 m."""
    return preset.late_open_db if site.opposite_wall_m is None else preset.late_walled_db


def _late_gain(
    site: Site, preset: Preset, x_m: FloatArray, y_m: FloatArray, time_s: FloatArray, receiver: Receiver
) -> Float32Array:
    """How strongly a source feeds the late field: less the farther it, or the ego, is from the mouth."""
    away = np.hypot(x_m - site.corner_ahead_m, y_m) - receiver.ego.x_m(time_s)
    gain = 10.0 ** (late_level_db(site, preset) / 20.0) * LATE_DISTANCE_M / (LATE_DISTANCE_M + away)
    knots = np.arange(len(gain)) * KNOT_SAMPLES
    samples = np.arange((len(gain) - 1) * KNOT_SAMPLES)
    return np.asarray(np.interp(samples, knots, gain), np.float32)


def _until_the_end(signal: Float32Array, start_s: float, receiver: Receiver) -> Float32Array:
    """Return a signal from its start, or the recording's if that is earlier, to the recording's end."""
    offset = round((start_s - receiver.knots_s[0]) * receiver.sample_rate_hz)
    before = max(-offset, 0)
    out = np.zeros(before + receiver.samples, np.float32)
    at = max(offset, 0)
    piece = signal[: max(len(out) - at, 0)]
    out[at : at + len(piece)] = piece
    return out
