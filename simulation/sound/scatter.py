r"""Rough walls: patches of facade that scatter a vehicle's sound.

A wall with reveals, doors, pipes and gaps mirrors only a part of the incident sound; the rest leaves every
patch in all directions (Lambert). Patches do not move, so their sound arrives from fixed azimuths for any
motion of the vehicle. Patches on the side walls near the mouth are lit long before the array is: they are the
first sound from a street that looks empty.

.. math:: p_i(t) = \frac{a_i(f)}{d_i\, r_i}\, s\Big(t - \frac{d_i + r_i}{c}\Big), \qquad
          a_i^2 = w_i\, \sigma(f)\, \rho^2\, \frac{A}{\pi} \cos\theta_{in} \cos\theta_{out}

with the patch's area A, the wall's reflection rho, its scattering coefficient sigma(f), and a weight w_i of
mean one that is drawn once for a site.
"""

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from worldstate.ground.typing import BoolArray, Float32Array, FloatArray, IndexArray
from worldstate.simulation.scene.junction import Site, site_generator
from worldstate.simulation.scene.octave_bands import OCTAVES_HZ

from . import paths
from .delay import KNOT_SAMPLES, Emission
from .diffraction import SPEED_OF_SOUND_MPS
from .receiver import NEAREST_M, Receiver, add_along, add_turning, distance_m
from .static_field import PlacedSource, StaticSources, StreetSound

PATCH_M = 0.9  # Length along the wall
WALL_HEIGHT_M = 3.0  # Height of the part of a wall that is near enough to matter
HEIGHTS_M = (0.4, 2.8)
BEHIND_M = 1.5  # Side walls scatter from this distance behind the array
OPPOSITE_PATCH_M = 1.4
# Factor on the part of the wall opposite in view of the array: the side walls see more of it, from aside
OPPOSITE_REACH = 2.2
IMAGE_ORDERS = 2  # Reflections in the crossing street before a patch


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    r"""Patches of wall, all of one kind."""

    positions_m: FloatArray  # shape (P, 3): Middles, z above the road
    normals: FloatArray  # shape (P, 2): Towards the street
    # shape (P,): :math:`\sqrt{w A \rho^2 / \pi}`, the scattering length at normal incidence.
    strengths_m: FloatArray
    beyond_mouth: bool  # Whether the patches are in the crossing street


def patches(site: Site) -> list[Patches]:
    """Return the patches of the ego street's side walls and, if there is one, of the wall opposite.

    Examples
    --------
    >>> from worldstate.simulation.scene.junction import site
    >>> [(len(group.strengths_m), group.beyond_mouth) for group in patches(site("SA1"))]
    [(12, False), (15, True)]
    """
    rng = site_generator(site.name, "facades")
    groups = [_side_walls(site, rng)]
    if site.opposite_wall_m is not None:
        groups.append(_opposite_wall(site, site.opposite_wall_m, rng))
    return groups


def _side_walls(site: Site, rng: np.random.Generator) -> Patches:
    left = site.side_wall_left_m, site.left_openings_m, site.side_shares[0]
    right = -site.side_wall_right_m, site.right_openings_m, site.side_shares[1]
    positions, walled = [], []
    for y, openings, share in (left, right):
        x = _spread(-BEHIND_M, site.corner_ahead_m, rng)
        positions.append(np.column_stack([x, np.full_like(x, y), rng.uniform(*HEIGHTS_M, len(x))]))
        walled.append(share * paths.on_wall(openings, x))
    normals = np.repeat([[0.0, -1.0], [0.0, 1.0]], list(map(len, positions)), axis=0)
    strengths = _strengths(len(normals), site.side_reflection, rng) * np.concatenate(walled)
    return Patches(np.concatenate(positions), normals, strengths, False)


def _opposite_wall(site: Site, wall_m: float, rng: np.random.Generator) -> Patches:
    right, left = site.sight_m(wall_m)
    y = _spread(OPPOSITE_REACH * right, OPPOSITE_REACH * left, rng, OPPOSITE_PATCH_M)
    positions = np.column_stack([np.full_like(y, wall_m), y, rng.uniform(*HEIGHTS_M, len(y))])
    normals = np.tile([-1.0, 0.0], (len(y), 1))
    strengths = _strengths(len(y), site.facade_reflection, rng, OPPOSITE_PATCH_M)
    return Patches(positions, normals, strengths, True)


def _spread(low: float, high: float, rng: np.random.Generator, patch_m: float = PATCH_M) -> FloatArray:
    """Return positions along a wall, one in every patch, near its middle."""
    count = max(int((high - low) / patch_m), 1)
    return np.asarray(low + (high - low) * (np.arange(count) + rng.uniform(0.2, 0.8, count)) / count)


def _strengths(
    count: int, reflection: float, rng: np.random.Generator, patch_m: float = PATCH_M
) -> FloatArray:
    weights = rng.exponential(1.0, count)
    return np.asarray(reflection * np.sqrt(weights * patch_m * WALL_HEIGHT_M / np.pi))


# Length of the path to a patch at a series of emission times, shape (T,), and amplitude factor per octave
# without spherical spreading, shape (T, 8); the angle of the last leg is not included.
FirstLeg: TypeAlias = tuple[FloatArray, FloatArray]


def first_legs(group: Patches, index: int, source: PlacedSource, street: StreetSound) -> list[FirstLeg]:
    """Return the paths of one source to one patch: direct and by the facades of the crossing street."""
    if not group.beyond_mouth:
        images = paths.source_images(street.site, source.x_m)[: IMAGE_ORDERS + 1]
        return [_mouth_leg(group, index, image, source, street) for image in images]
    x, y, z = group.positions_m[index]
    away = np.stack([source.x_m - x, source.y_m - y], axis=1)
    length = np.sqrt((away**2).sum(axis=1) + (z - source.height_m) ** 2)
    cosine = np.abs(away @ group.normals[index]) / np.maximum(length, NEAREST_M)
    return [(length, (group.strengths_m[index] * np.sqrt(cosine))[:, None] * np.ones(len(OCTAVES_HZ)))]


def _mouth_leg(
    group: Patches, index: int, image: paths.SourceImage, source: PlacedSource, street: StreetSound
) -> FirstLeg:
    site, (x, y, z) = street.site, group.positions_m[index]
    passage = paths.through_mouth(site, (image.x_m, source.y_m), (x, y), z - source.height_m)
    away = np.stack([np.full_like(source.y_m, site.corner_ahead_m - x), passage.aim_y_m - y], axis=1)
    cosine = np.abs(away @ group.normals[index]) / np.maximum(np.hypot(*away.T), NEAREST_M)
    length = passage.lit * passage.straight_m + (1.0 - passage.lit) * passage.bent_m
    walls = image.gain * paths.near_facade(site, image, source.y_m, passage.aim_y_m)
    gain = group.strengths_m[index] * np.sqrt(cosine) * walls
    return length, gain[:, None] * passage.screen_gain(street.preset.screen_cap_db)


def last_leg(group: Patches, positions_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the distance of every patch to every microphone and the amplitude factor, shape (P, M) each."""
    away = positions_m[None] - group.positions_m[:, None]
    distance = np.maximum(np.linalg.norm(away, axis=2), NEAREST_M)
    cosine = np.abs(np.einsum("pmk,pk->pm", away[:, :, :2], group.normals)) / distance
    return distance, np.sqrt(cosine) / distance


def mirrored(group: Patches, image: paths.ReceiverImage) -> Patches:
    """Return the images of the patches in the side walls."""
    turn = np.array([1.0, image.sign])
    positions = (group.positions_m - np.array([0.0, image.offset_m, 0.0])) * np.array([1.0, image.sign, 1.0])
    return replace(group, positions_m=positions, normals=group.normals * turn)


def seen_through_mouth(
    site: Site, place_m: FloatArray, ego_x_m: FloatArray, image: paths.ReceiverImage
) -> FloatArray:
    """Return the share of a place in the crossing street that an ego receives by one image, 0 in shadow.

    Shapes: ego_x_m (T,).
    """
    end_m = ego_x_m, image.offset_m
    passage = paths.through_mouth(site, (float(place_m[0]), np.full_like(ego_x_m, place_m[1])), end_m, 0.0)
    walls = paths.side_walls(site, image, ego_x_m, (site.corner_ahead_m, passage.aim_y_m))
    return passage.lit * image.gain * walls


# Patches and images 30 dB below all scattered sound are left out; for a moving ego most of them are, at any
# time. Features change by 1e-4 rms.
FAINTEST = 1e-3
STRETCH_KNOTS = 64  # A sixth of a second: interval of that decision


def add_scattered(street: StreetSound, source: PlacedSource) -> None:
    """Add the sound of one moving source that rough walls scatter, to all microphones."""
    if not street.preset.wall_scattering or street.site.is_open:
        return
    every: list[_Shown] = []
    for group in patches(street.site):
        arrived = np.zeros((len(group.strengths_m), street.receiver.samples), np.float32)
        for index, signal in enumerate(arrived):
            for length_m, gain in first_legs(group, index, source, street):
                sent = length_m, gain * np.sqrt(street.scattered(group.beyond_mouth))
                _add_leg(signal, source.emission, sent, street.receiver, group.positions_m[index])
        every += _shown(group, arrived, street)
    _add_shown(street.static, every, street.receiver)


def _add_leg(
    out: Float32Array, emission: Emission, leg: FirstLeg, receiver: Receiver, patch_m: FloatArray
) -> None:
    """Add the sound of one patch, delayed as at the array's centre."""
    length_m, gain = leg
    made = emission.table(gain)
    if made is None:
        return
    table, span = made
    knots, first = emission.knots_s[span], length_m[span]
    total, _ = receiver.arrivals(knots, lambda x: first + distance_m(patch_m, x, receiver.centre_m))
    add_along(out, table, knots, total, receiver.knots_s, first)


@dataclass(frozen=True, slots=True, eq=False)
class _Shown:
    """Patches in view of the array, directly or in a side wall."""

    group: Patches
    arrived: Float32Array  # shape (P, n)
    later: IndexArray  # shape (P,): Delay of the path to the array relative to the direct one, samples
    gain: FloatArray  # shape (P, K + 1): Amplitude factor of the last leg to the array's centre
    share: FloatArray  # shape (P, K + 1): Visible share of each

    def signal(self, index: int) -> Float32Array:
        """Return the signal of one patch, delayed as at the array's centre."""
        sent, by = self.arrived[index], int(self.later[index])
        return np.concatenate([np.zeros(by, np.float32), sent[: len(sent) - by]])


def _shown(group: Patches, arrived: Float32Array, street: StreetSound) -> list[_Shown]:
    """Return the patches and, for the wall opposite, their images in the side walls."""
    site, receiver = street.site, street.receiver
    x, count = receiver.ego.x_m(receiver.knots_s), len(arrived)
    if not group.beyond_mouth:
        seen = np.ones((count, len(x)))
        return [_Shown(group, arrived, np.zeros(count, int), _last_gain(group, receiver), seen)]
    away, every = np.linalg.norm(group.positions_m - receiver.centre_m, axis=1), []
    for image in (one for one in paths.receiver_images(site) if one.order <= IMAGE_ORDERS):
        shown = mirrored(group, image)
        seen = np.stack([seen_through_mouth(site, place, x, image) for place in group.positions_m])
        # The path by a wall is longer: without its delay every image would be in phase with the patch.
        later_s = (np.linalg.norm(shown.positions_m - receiver.centre_m, axis=1) - away) / SPEED_OF_SOUND_MPS
        # A patch beyond the plane of a wall has no image in it: the image would be nearer than the patch.
        seen *= (later_s >= 0.0)[:, None]
        later = np.round(np.maximum(later_s, 0.0) * receiver.sample_rate_hz).astype(int)
        every.append(_Shown(shown, arrived, later, _last_gain(shown, receiver), seen))
    return every


def _last_gain(group: Patches, receiver: Receiver) -> FloatArray:
    """Return the amplitude factor from every patch to the array's centre, shape (P, K + 1)."""
    x = receiver.ego.x_m(receiver.knots_s)
    gains = []
    for place, normal in zip(group.positions_m, group.normals, strict=True):
        distance = np.maximum(distance_m(place, x, receiver.centre_m), NEAREST_M)
        cosine = np.abs((x - place[0]) * normal[0] - place[1] * normal[1]) / distance
        gains.append(np.sqrt(np.minimum(cosine, 1.0)) / distance)
    return np.stack(gains)


def _add_shown(static: StaticSources, every: list[_Shown], receiver: Receiver) -> None:
    """Add every patch and image to all microphones while it is loud enough to matter."""
    power = [_power(one) for one in every]
    whole = np.sum([own.sum(axis=0) for own in power], axis=0)
    for one, own in zip(every, power, strict=True):
        loud = own > FAINTEST * whole
        used = np.flatnonzero(loud.any(axis=1))
        if receiver.ego.stands and len(used):
            signals = np.stack([one.signal(i) for i in used.tolist()])
            distance, gain = last_leg(one.group, receiver.positions_m)
            centre = np.linalg.norm(one.group.positions_m - receiver.centre_m, axis=1)
            delays = (distance - centre[:, None]) / SPEED_OF_SOUND_MPS + receiver.skew_s
            static.add(signals, delays[used], gain[used] * one.share[used, :1])
            continue
        for i in used.tolist():
            gain = one.gain[i] * one.share[i] * _within(loud[i], one.gain.shape[1])
            add_turning(static.out, one.signal(i), one.group.positions_m[i], gain, receiver)


def _power(one: _Shown) -> FloatArray:
    """Return the power at the array's centre in stretches of time, shape (P, S)."""
    sent = np.stack([np.square(signal).reshape(-1, KNOT_SAMPLES).sum(axis=1) for signal in one.arrived])
    heard = sent * (one.gain * one.share)[:, :-1] ** 2
    return np.add.reduceat(heard, np.arange(0, heard.shape[1], STRETCH_KNOTS), axis=1)


def _within(loud: BoolArray, knots: int) -> FloatArray:
    """Return 1 from a stretch before the first loud one to one after the last, shape (K + 1,)."""
    first, last = np.flatnonzero(loud)[[0, -1]]
    at = np.arange(knots) // STRETCH_KNOTS
    return np.asarray((at >= first - 1) & (at <= last + 1), np.float64)
