"""The second renderer: rays through houses carry energy, from which sound is synthesised.

It shares no propagation code with the first renderer: no images, no screens, no late field. Rays leave the
array, meet houses with setbacks, gaps and ends, and are mirrored or scattered; by reciprocity the path of a
ray is the path of sound to the array. The energy that they deposit in a cell of the plan is the level of a
source there from every direction, per octave. Direct sound and the two corners, which rays do not cover, are
added by the uniform theory of diffraction. Delays of single echoes are not kept: every direction is a plane
wave with the source's sound, convolved with its own decaying noise.

Sources: H. Kuttruff, "Room Acoustics", 6th ed., 2016, ch. 9 (rays); R. G. Kouyoumjian and P. H. Pathak, "A
uniform geometrical theory of diffraction for an edge in a perfectly conducting surface", Proc. IEEE 62,
1448-1461, 1974.
"""

from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import product

import numpy as np
import scipy

from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.simulation.scene.junction import Site, site_generator
from worldstate.simulation.scene.octave_bands import OCTAVES_HZ
from worldstate.simulation.scene.presets import Ambience

from .background import Town, direction_numbers
from .delay import SampledSignal
from .diffraction import OCTAVE_DB_PER_M, SPEED_OF_SOUND_MPS, corner_gain
from .receiver import Receiver, add_along, add_to_all, passed_places
from .static_field import PlacedSource, StreetSound, plane_wave_delays

RAYS, BOUNCES, STEP_M = 100_000, 40, 1.0
CELL_M, PLAN_M = 2.0, ((-40.0, 40.0), (-90.0, 90.0))  # x and y limits of the stored plan
BELOW_M = 2.0  # Upper limit of the height of sources
STEEPEST = 0.5  # Sine of the elevation of rays; steeper ones leave over the roofs
DIRECTIONS, ELEVATION_RAD, LATER_M = 24, 0.1, 3.0
ABSORBED, SCATTERED, HEIGHT_M = (0.03, 0.3), (0.05, 0.6), (5.0, 14.0)  # Ranges for a house
FRONT_M, SETBACK_M, GAP_M, GAPS = (6.0, 18.0), 1.0, (2.5, 5.0), 0.2
EARLY_BOUNCES = 2
FAINTEST = 1e-3  # Directions below this share of the maximum energy are left out


@dataclass(frozen=True, slots=True, eq=False)
class Houses:
    """Fronts of the houses along two streets, seen from above."""

    ends_m: FloatArray  # shape (W, 2, 2): Both ends of every front, x and y
    height_m: FloatArray  # shape (W,)
    kept: FloatArray  # shape (W, 8): Reflected share of the energy, per octave
    scattered: FloatArray  # shape (W,): Scattered share of the reflected energy


def drawn_houses(site: Site) -> Houses:
    """Draw the houses of a site; those at its corners follow its plan.

    Examples
    --------
    >>> from worldstate.simulation.scene.junction import drawn_site
    >>> drawn_houses(drawn_site("TA1")).ends_m.shape[1:]
    (2, 2)
    """
    rng = site_generator(site.name, "houses")
    ahead, (left, right) = site.corner_ahead_m, (site.corner_left_m, -site.corner_right_m)
    (back, _), (_, far) = PLAN_M
    # Each row: start, direction, length, and the direction away from the street.
    rows = [
        ((ahead, left), (0.0, 1.0), far, (-1.0, 0.0)),
        ((ahead, right), (0.0, -1.0), far, (-1.0, 0.0)),
        ((ahead, left), (-1.0, 0.0), ahead - back, (0.0, 1.0)),
        ((ahead, right), (-1.0, 0.0), ahead - back, (0.0, -1.0)),
    ]
    if site.opposite_wall_m is not None:
        rows += [((site.opposite_wall_m, 0.0), (0.0, side), far, (1.0, 0.0)) for side in (1.0, -1.0)]
    elif rng.random() < 0.5:  # The ego's street continues beyond a crossing
        beyond = site.far_kerb_m + site.verge_m
        rows += [((beyond, side * 4.0), (0.0, side), far, (1.0, 0.0)) for side in (1.0, -1.0)]
    fronts = [front for row in rows for front in _row(*row, rng)]
    count = len(fronts)
    kept = np.clip(1.0 - rng.uniform(*ABSORBED, (count, 1)) * rng.uniform(0.7, 1.3, (1, 8)), 0.0, 1.0)
    scattered = rng.uniform(*SCATTERED) * rng.uniform(0.5, 1.5, count)
    return Houses(np.array(fronts), rng.uniform(*HEIGHT_M, count), kept, np.minimum(scattered, 1.0))


Point = tuple[float, float]


def _row(
    begin_m: Point, along: Point, length_m: float, back: Point, rng: np.random.Generator
) -> list[tuple[FloatArray, FloatArray]]:
    """Draw a row of houses; the first one is at the street, the others up to some metres behind."""
    at, fronts, behind = 0.0, [], 0.0
    while at < length_m:
        width = rng.uniform(*FRONT_M)
        start = np.array(begin_m) + at * np.array(along) + behind * np.array(back)
        end = start + width * np.array(along)
        side = 12.0 * np.array(back)  # Depth of a house: gaps have walls
        fronts += [(start, end), (end, end + side), (start, start + side)]
        at += width + (rng.uniform(*GAP_M) if rng.random() < GAPS else 0.0)
        behind = abs(SETBACK_M * rng.standard_normal())
    return fronts


@dataclass(frozen=True, slots=True, eq=False)
class Reached:
    """Level at the array of a source in every cell of the plan, without the direct sound."""

    # shape (X, Y, K, 8): Squared pressure from every direction, relative to 1 m in the open
    energy: FloatArray
    early: FloatArray  # shape (K,): Share of it after few reflections
    open: FloatArray  # shape (K,): Share of each direction in the sound from outside; they sum to one
    decay_s: float  # Reverberation time


def azimuths_rad() -> FloatArray:
    """Middle of every direction, shape (K,)."""
    return -np.pi + (np.arange(DIRECTIONS) + 0.5) * 2.0 * np.pi / DIRECTIONS


@lru_cache(maxsize=40)  # All places of a drive
def reached(site: Site, height_m: float, x_m: float = 0.0) -> Reached:
    """Trace the rays of a site once, from the ego's stop or from another place on its way there."""
    rays = RAYS if x_m == 0.0 else RAYS // 4
    return trace_rays(drawn_houses(site), height_m, site_generator(site.name, "rays"), rays, x_m)


def _reached_by(receiver: Receiver, site: Site, x_m: float = 0.0) -> Reached:
    return reached(site, round(float(receiver.centre_m[2]), 3), x_m)


def trace_rays(
    houses: Houses, height_m: float, rng: np.random.Generator, rays: int = RAYS, x_m: float = 0.0
) -> Reached:
    r"""Send rays from the array at (x, 0) and a height, and collect their energy in the plan.

    .. math:: p^2(\text{cell}, \text{direction}) = 4 \pi \frac{\sum E\, l}{V}

    of rays that left in this direction, l metres of which are in the cell of volume V. The road mirrors;
    source levels already include hard ground.
    """
    going = _launched(height_m, rays, rng, x_m)
    shape = (*(round((high - low) / CELL_M) for low, high in PLAN_M), DIRECTIONS, len(OCTAVES_HZ))
    left, early, out = np.zeros(shape), np.zeros(DIRECTIONS), np.zeros(DIRECTIONS)
    lengths, heard = [], []
    for bounce in range(BOUNCES):
        wall, way = _next_wall(houses, going)
        if bounce:
            deposit = _deposit(left, going, way, rng)
            early += deposit if bounce <= EARLY_BOUNCES else 0.0
            lengths.append(going.gone_m)
            heard.append(going.energy[:, 3] * np.minimum(way, 20.0))
        escaped = ~np.isfinite(way)
        np.add.at(out, going.direction[escaped], going.energy[escaped].mean(axis=1))
        going = _reflected(houses, going, wall, np.where(escaped, 0.0, way), ~escaped, rng)
        if not len(going.height_m):
            break
    whole = left.sum(axis=(0, 1, 3))
    decay_s = _decay_s(np.concatenate(lengths), np.concatenate(heard))
    volume = CELL_M**2 * 2.0 * BELOW_M
    shares = (out + 1e-9) / (out + 1e-9).sum()
    return Reached(4.0 * np.pi * left / volume, np.minimum(early / (whole + 1e-30), 1.0), shares, decay_s)


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """Rays that are still between the houses; the road is unfolded, so heights may be negative."""

    direction: IndexArray  # shape (n,): Direction in which each left the array
    at_m: FloatArray  # shape (n, 2)
    flat: FloatArray  # shape (n, 2): Horizontal unit vector of its path
    height_m: FloatArray  # shape (n,)
    slope: FloatArray  # shape (n,): Rise per horizontal metre
    gone_m: FloatArray  # shape (n,)
    energy: FloatArray  # shape (n, 8)


def _launched(height_m: float, count: int, rng: np.random.Generator, x_m: float) -> _Rays:
    """Send rays from the array uniformly into all azimuths and elevations up to the steepest."""
    azimuth = rng.uniform(-np.pi, np.pi, count)
    sine = rng.uniform(-STEEPEST, STEEPEST, count)
    return _Rays(
        direction_numbers(azimuth, DIRECTIONS),
        np.tile([x_m, 0.0], (count, 1)),
        np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1),
        np.full(count, height_m),
        np.asarray(sine / np.sqrt(1.0 - sine**2)),
        np.zeros(count),
        np.full((count, len(OCTAVES_HZ)), STEEPEST / count),
    )


def _next_wall(houses: Houses, rays: _Rays) -> tuple[IndexArray, FloatArray]:
    """Return the next front that every ray meets and its horizontal distance; infinite for none."""
    (x, y), (flat_x, flat_y) = rays.at_m.T, rays.flat.T
    nearest, which = np.full(len(x), np.inf), np.zeros(len(x), np.intp)
    for number, (start, end) in enumerate(houses.ends_m):
        along = end - start
        across = flat_x * along[1] - flat_y * along[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            way = ((start[0] - x) * along[1] - (start[1] - y) * along[0]) / across
            part = ((start[0] - x) * flat_y - (start[1] - y) * flat_x) / across
        hit = (way > 1e-5) & (part >= 0.0) & (part <= 1.0) & (way < nearest)
        nearest[hit], which[hit] = way[hit], number
    return which, nearest


def _deposit(left: FloatArray, rays: _Rays, way_m: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Add the energy of every ray to the cells on its path, and return the energy that left per direction."""
    longest = np.minimum(way_m, 120.0)
    count = np.ceil(longest / STEP_M).astype(int)
    ray = np.repeat(np.arange(len(way_m)), count)
    number = np.arange(len(ray)) - np.repeat(np.cumsum(count) - count, count)
    metres = (number + rng.random(len(ray))) * longest[ray] / count[ray]
    low = np.abs(rays.height_m[ray] + rays.slope[ray] * metres) < BELOW_M
    ray, metres, share = ray[low], metres[low], (longest[ray] / count[ray])[low]
    place = rays.at_m[ray] + metres[:, None] * rays.flat[ray]
    cell = np.floor((place - np.array(PLAN_M)[:, 0]) / CELL_M).astype(int)
    inside = ((cell >= 0) & (cell < left.shape[:2])).all(axis=1)
    ray, cell, length = ray[inside], cell[inside], (share * np.hypot(1.0, rays.slope[ray]))[inside]
    index = (cell[:, 0] * left.shape[1] + cell[:, 1]) * DIRECTIONS + rays.direction[ray]
    each, size = rays.energy[ray] * length[:, None], left[..., 0].size
    for band in range(left.shape[3]):
        left[..., band] += np.bincount(index, each[:, band], size).reshape(left.shape[:3])
    return np.asarray(np.bincount(rays.direction[ray], each.sum(axis=1), DIRECTIONS))


def _reflected(
    houses: Houses, rays: _Rays, wall: IndexArray, way_m: FloatArray, met: BoolArray, rng: np.random.Generator
) -> _Rays:
    """Return the rays that met a front below its roof, mirrored or scattered by Lambert's law."""
    on = met & (np.abs(rays.height_m + rays.slope * way_m) < houses.height_m[wall])
    wall, way, slope, flat = wall[on], way_m[on], rays.slope[on], rays.flat[on]
    at, far = rays.at_m[on] + way[:, None] * flat, way * np.hypot(1.0, slope)
    new_flat, new_slope = _new_ways(houses, wall, flat, slope, rng)
    return _Rays(
        rays.direction[on],
        at + 1e-6 * new_flat,  # Away from the front, so that the next front is another one
        new_flat,
        rays.height_m[on] + slope * way,
        new_slope,
        rays.gone_m[on] + far,
        rays.energy[on] * houses.kept[wall] * 10.0 ** (-far[:, None] * OCTAVE_DB_PER_M / 10.0),
    )


def _new_ways(
    houses: Houses, wall: IndexArray, flat: FloatArray, slope: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return the horizontal directions of rays after a front, and their slopes."""
    along = houses.ends_m[wall, 1] - houses.ends_m[wall, 0]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1)[:, None]
    towards = np.einsum("nd,nd->n", flat, normal)
    mirrored = flat - 2.0 * towards[:, None] * normal
    # Cosine lobe: the distance from the normal in the plane of the front, drawn uniformly over the unit disc.
    radius, turn = np.sqrt(rng.random(len(flat))), rng.uniform(0.0, 2.0 * np.pi, len(flat))
    outward = -np.sign(towards)[:, None] * normal
    beside = np.stack([-outward[:, 1], outward[:, 0]], axis=1)
    sideways = np.sqrt(1.0 - radius**2)[:, None] * outward + (radius * np.cos(turn))[:, None] * beside
    level = np.linalg.norm(sideways, axis=1)
    diffuse = rng.random(len(flat)) < houses.scattered[wall]
    new = np.where(diffuse[:, None], sideways / level[:, None], mirrored)
    return new, np.where(diffuse, radius * np.sin(turn) / level, slope)


def _decay_s(length_m: FloatArray, energy: FloatArray) -> float:
    """Return the reverberation time of energy that has travelled 40 to 160 m."""
    edges = np.linspace(40.0, 160.0, 7)
    total, _ = np.histogram(length_m, edges, weights=energy)
    if (total <= 0.0).any():
        return 0.3
    per_m = np.polyfit(0.5 * (edges[1:] + edges[:-1]), 10.0 * np.log10(total), 1)[0]
    return float(np.clip(-60.0 / (min(per_m, -1e-3) * SPEED_OF_SOUND_MPS), 0.15, 1.5))


LIT_BLEND_M = 0.5  # Length of a source's path over which direct sound appears


def add_traced(street: StreetSound, source: PlacedSource, rng: np.random.Generator) -> None:
    """Add a source by all ray directions, round both corners, over roofs, and straight."""
    static, site, receiver = street.static, street.site, street.receiver
    emission = source.emission
    length, heard_x = receiver.arrivals(source.time_s, partial(_way_m, site, source))
    lit = _lit(site, source, heard_x)
    ways = [*_echoes(source, street, heard_x, rng), *_edges(source, street, heard_x, lit)]
    waves = np.zeros((len(ways), receiver.samples), np.float32)
    for wave, way in zip(waves, ways, strict=True):
        made = emission.table(way.gain * length[:, None], fades=not receiver.ego.stands)
        if made is not None:
            table, span = made
            if way.early < 1.0:
                table = _smeared(table, way.early, way.decay_s, rng)
            add_along(wave, table, emission.knots_s[span], length[span] + way.later_m, receiver.knots_s)
    azimuth, elevation = np.array([(way.azimuth_rad, way.elevation_rad) for way in ways]).T
    static.add(waves, plane_wave_delays(azimuth, elevation, receiver) + receiver.skew_s)
    straight = np.repeat(lit[:, None], len(OCTAVES_HZ), axis=1)
    add_to_all(static.out, emission, straight, lambda place: source.straight_m(place, receiver)[0], receiver)


@dataclass(frozen=True, slots=True, eq=False)
class _Way:
    """A direction from which the sound of a source arrives."""

    azimuth_rad: float
    elevation_rad: float
    gain: FloatArray  # shape (T, 8): Relative to the pressure at 1 m
    early: float = 1.0  # Share of the energy in an echo; the rest decays
    decay_s: float = 0.0
    later_m: float = 0.0  # Length beyond the path through the mouth


def _echoes(
    source: PlacedSource, street: StreetSound, heard_x_m: FloatArray, rng: np.random.Generator
) -> list[_Way]:
    """Return the directions of the rays; the energy is blended between two places."""
    energy = np.zeros((len(heard_x_m), DIRECTIONS, len(OCTAVES_HZ)))
    early, decay_s = np.zeros(DIRECTIONS), 0.0
    for x_m, span, share in passed_places(heard_x_m, CELL_M):
        here, part = _reached_by(street.receiver, street.site, x_m), float(share.sum()) / len(energy)
        energy[span] += share[:, None, None] * _at(here.energy, source.x_m[span], source.y_m[span])
        early, decay_s = early + part * here.early, decay_s + part * here.decay_s
    loud = energy.sum(axis=2).max(axis=0)
    # Echoes arrive at different times.
    return [
        _Way(
            azimuths_rad()[k],
            abs(ELEVATION_RAD * rng.standard_normal()),
            np.sqrt(energy[:, k]),
            float(early[k]),
            decay_s,
            rng.exponential(LATER_M),
        )
        for k in np.flatnonzero(loud > FAINTEST * loud.max())
    ]


def _edges(source: PlacedSource, street: StreetSound, heard_x_m: FloatArray, lit: FloatArray) -> list[_Way]:
    """Return the paths of a hidden source round both corners and over the nearest roof."""
    site, ways, dark = street.site, list[_Way](), 1.0 - lit
    corners = site.corner_left_m, -site.corner_right_m
    for (x_m, span, share), across in product(passed_places(heard_x_m, CELL_M), corners):
        near, corner = source.during(span), (site.corner_ahead_m - x_m, across)
        hidden = share * dark[span] * (np.sign(near.y_m) == np.sign(across))
        gain = np.zeros((len(dark), len(OCTAVES_HZ)))
        gain[span] = corner_gain(corner, near.x_m - x_m, near.y_m) * hidden[:, None]
        ways.append(_Way(float(np.arctan2(*corner[::-1])), 0.0, gain))
    x, y, middle = source.x_m - heard_x_m, source.y_m, len(dark) // 2
    over = _roof_gain(np.hypot(x, y), source.height_m, street.receiver) * dark[:, None]
    return [*ways, _Way(float(np.arctan2(y[middle], x[middle])), ROOF_RAD, over)]


def _roof_gain(way_m: FloatArray, height_m: float, receiver: Receiver) -> FloatArray:
    r"""Return the amplitude over the nearest roof, (T, 8): ISO 9613-2, eq. (14), thin screen, at most 20 dB.

    .. math:: D = 10 \log_{10}(3 + 20 z / \lambda)
    """
    away = np.maximum(way_m, 2.0 * ROOF_M[0])
    low, high = (ROOF_M[1] - height for height in (float(receiver.centre_m[2]), height_m))
    detour = np.hypot(ROOF_M[0], low) + np.hypot(away - ROOF_M[0], max(high, 0.0)) - away
    loss = 10.0 * np.log10(3.0 + 20.0 * detour[:, None] * OCTAVES_HZ / SPEED_OF_SOUND_MPS)
    return np.asarray(10.0 ** (-np.minimum(loss, 20.0) / 20.0) / away[:, None])


ROOF_M, ROOF_RAD = (6.0, 8.0), 0.5  # Distance and height of the roof, and elevation of the sound from there


def _lit(site: Site, source: PlacedSource, heard_x_m: FloatArray) -> FloatArray:
    """Return 1 if the array has line of sight to a source and 0 if a corner blocks it, shape (T,)."""
    right, left = site.sights_m(np.maximum(source.x_m, site.corner_ahead_m), (heard_x_m, 0.0))
    inside = np.minimum(left - source.y_m, source.y_m - right)
    return np.clip(0.5 + inside / LIT_BLEND_M, 0.0, 1.0) ** 2


def _way_m(site: Site, source: PlacedSource, ego_x_m: FloatArray) -> FloatArray:
    """Return the horizontal path length, through the middle of the mouth if the source is beside it, (T,)."""
    wide = min(site.corner_left_m, site.corner_right_m)
    over = np.sign(source.y_m) * np.minimum(np.abs(source.y_m), wide)
    return np.asarray(
        np.hypot(source.x_m - site.corner_ahead_m, source.y_m - over)
        + np.hypot(site.corner_ahead_m - ego_x_m, over)
    )


def _at(energy: FloatArray, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
    """Return the energy at positions in the plan, interpolated between cells, shape (T, K, 8)."""
    out = np.zeros((len(x_m), *energy.shape[2:]))
    low = np.array(PLAN_M)[:, 0]
    at = (np.stack([x_m, y_m], axis=1) - low) / CELL_M - 0.5
    first = np.floor(at).astype(int)
    part = at - first
    for i in (0, 1):
        for j in (0, 1):
            weight = np.abs(1 - i - part[:, 0]) * np.abs(1 - j - part[:, 1])
            x, y = (np.clip(first[:, a] + b, 0, energy.shape[a] - 1) for a, b in ((0, i), (1, j)))
            out += weight[:, None, None] * energy[x, y]
    return out


def _smeared(table: SampledSignal, early: float, decay_s: float, rng: np.random.Generator) -> SampledSignal:
    """Convolve a signal with an echo and a decaying noise, of unit energy together."""
    tail = np.arange(max(int(0.7 * decay_s * table.rate_hz), 2))
    noise = rng.standard_normal(len(tail)) * 10.0 ** (-3.0 * tail / (decay_s * table.rate_hz))
    response = np.sqrt(max(1.0 - early, 0.0) / np.square(noise).sum()) * noise
    response[0] += np.sqrt(early)
    values = scipy.signal.oaconvolve(table.values, response.astype(np.float32))[: len(table.values)]
    return SampledSignal(np.asarray(values, np.float32), table.start_s, table.rate_hz)


def town_by_rays(receiver: Receiver, site: Site, here: Ambience) -> Town:
    """Return a background that enters through the gaps and ends of the streets."""
    return Town(here, site_generator(site.name, "town"), _reached_by(receiver, site).open)
