"""The late, diffuse part of a vehicle's sound: its energy without its direction.

Every direction gets a tail of its own. One common tail on all microphones would be a source at broadside.
"""

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from worldstate.adapters.simulation.scene.junction import Site, site_generator
from worldstate.ground.typing import Float32Array, FloatArray

from .static_field import StaticSources, plane_wave_delays, unit_vectors

DIRECTIONS = 48
LOBES, LOBE_CONCENTRATION, LOBE_SPAN_RAD = 4, 8.0, 1.3
ELEVATION_RAD = 0.3
TAIL_DECAYS = 1.0  # length of a tail in reverberation times (60 dB)


def street_field(site: Site, lobe_share: float) -> tuple[FloatArray, FloatArray]:
    """Directions from which late sound reaches the array in a street, and their shares of the energy.

    Examples
    --------
    >>> from worldstate.adapters.simulation.scene.junction import site
    >>> directions, shares = street_field(site("SA1"), 0.5)
    >>> directions.shape, round(float(shares.sum()), 6)
    ((48, 3), 1.0)
    """
    # Between walls and under an open sky late sound is near the horizon; it comes in by the mouth and from
    # what stands there, so that a site has late directions of its own, ahead.
    rng = site_generator(site.name, "late")
    azimuth = 2.0 * np.pi * (np.arange(DIRECTIONS) + rng.random()) / DIRECTIONS
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
    for wave, share in zip(waves, shares, strict=True):
        response = (np.sqrt(share) * envelope * rng.standard_normal(tail)).astype(np.float32)
        wave[:] = irfft(spectrum * rfft(response, n), n)[len(dry) - samples : len(dry)]
    offsets = positions_m - positions_m.mean(axis=0)
    static.add(waves, plane_wave_delays(directions, offsets))
