r"""Rough walls: patches of facade that send a vehicle's sound on from where they are.

A wall with reveals, doors, pipes and gaps mirrors only a part of what falls on it; the rest leaves every
patch in all directions (Lambert). Patches stand still, so what they send arrives from fixed azimuths however
the vehicle moves, and those on the side walls near the mouth are lit long before the array is: this is how
an empty-looking street is heard to fill up.

.. math:: p_i(t) = \frac{a_i(f)}{d_i\, r_i}\, s\Big(t - \frac{d_i + r_i}{c}\Big), \qquad
          a_i^2 = w_i\, \sigma(f)\, \rho^2\, \frac{A}{\pi} \cos\theta_{in} \cos\theta_{out}

with the patch's area A, the wall's reflection rho, its scattering coefficient sigma(f), and a weight w_i of
mean one that is drawn once for a site: its face.
"""

from dataclasses import dataclass, replace

import numpy as np

from worldstate.ground.typing import FloatArray
from worldstate.simulation.scene.junction import Site, site_generator
from worldstate.simulation.scene.octave_bands import OCTAVES_HZ
from worldstate.simulation.scene.presets import Preset

from .emission import MovingSource
from .paths import (
    ReceiverImage,
    SourceImage,
    near_facade,
    on_wall,
    side_walls,
    source_images,
    through_mouth,
)
from .receiver import NEAREST_M, Surroundings

PATCH_M = 0.9  # along the wall
WALL_HEIGHT_M = 3.0  # what of a wall is near enough to matter
HEIGHTS_M = (0.4, 2.8)
BEHIND_M = 1.5  # side walls scatter from this far behind the array
OPPOSITE_PATCH_M = 1.4
OPPOSITE_REACH = 2.2  # of the part seen through the mouth: the side walls show more of it, from aside
SCATTER_HZ = 400.0  # relief of a few decimetres: below, a facade is smooth
IMAGE_ORDERS = 2  # reflections in the crossing street before a patch is met


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    r"""Pieces of wall, all of one kind."""

    positions_m: FloatArray  # shape (P, 3): Middles, z above the road
    normals: FloatArray  # shape (P, 2): Towards the street
    # shape (P,): :math:`\sqrt{w A \rho^2 / \pi}`, the length that scatters at grazing angles of 0.
    strengths_m: FloatArray
    beyond_mouth: bool  # Whether they stand in the crossing street


def scattering(preset: Preset) -> FloatArray:
    """Scattering coefficient sigma per octave, shape (8,).

    Examples
    --------
    >>> from worldstate.simulation.scene.presets import preset
    >>> sigma = scattering(preset())
    >>> sigma[[0, -1]].round(3)
    array([0.004, 0.15 ])
    """
    relief = (OCTAVES_HZ / SCATTER_HZ) ** 2
    return preset.wall_scattering * relief / (1.0 + relief)


def patches(site: Site) -> list[Patches]:
    """Patches of the ego street's side walls and, where there is one, of the wall opposite.

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
    x = _spread(-BEHIND_M, site.corner_ahead_m, rng)
    left = np.column_stack([x, np.full_like(x, site.side_wall_left_m), rng.uniform(*HEIGHTS_M, len(x))])
    x = _spread(-BEHIND_M, site.corner_ahead_m, rng)
    right = np.column_stack([x, np.full_like(x, -site.side_wall_right_m), rng.uniform(*HEIGHTS_M, len(x))])
    normals = np.repeat([[0.0, -1.0], [0.0, 1.0]], [len(left), len(right)], axis=0)
    positions = np.concatenate([left, right])
    strengths = _strengths(len(positions), site.side_reflection, rng)
    sides = (site.left_openings_m, left), (site.right_openings_m, right)
    walled = [
        share * on_wall(openings, places[:, 0])
        for share, (openings, places) in zip(site.side_shares, sides, strict=True)
    ]
    return Patches(positions, normals, strengths * np.concatenate(walled), False)


def _opposite_wall(site: Site, wall_m: float, rng: np.random.Generator) -> Patches:
    right, left = site.sight_m(wall_m)
    y = _spread(OPPOSITE_REACH * right, OPPOSITE_REACH * left, rng, OPPOSITE_PATCH_M)
    positions = np.column_stack([np.full_like(y, wall_m), y, rng.uniform(*HEIGHTS_M, len(y))])
    normals = np.tile([-1.0, 0.0], (len(y), 1))
    return Patches(
        positions, normals, _strengths(len(y), site.facade_reflection, rng, OPPOSITE_PATCH_M), True
    )


def _spread(low: float, high: float, rng: np.random.Generator, patch_m: float = PATCH_M) -> FloatArray:
    """Places along a wall, one in every patch, not quite in its middle."""
    count = max(int((high - low) / patch_m), 1)
    return np.asarray(low + (high - low) * (np.arange(count) + rng.uniform(0.2, 0.8, count)) / count)


def _strengths(
    count: int, reflection: float, rng: np.random.Generator, patch_m: float = PATCH_M
) -> FloatArray:
    weights = rng.exponential(1.0, count)
    return np.asarray(reflection * np.sqrt(weights * patch_m * WALL_HEIGHT_M / np.pi))


@dataclass(frozen=True, slots=True, eq=False)
class FirstLeg:
    """From the source to one patch, at a series of emission times."""

    length_m: FloatArray  # shape (T,): Way to the patch
    # shape (T, 8): Amplitude factor per octave without spherical spreading; the last leg's angle is not in
    # it.
    gain: FloatArray


def first_legs(group: Patches, index: int, source: MovingSource, around: Surroundings) -> list[FirstLeg]:
    """Ways of one source to one patch: direct and by the facades of the crossing street."""
    if group.beyond_mouth:
        return [_open_leg(group, index, source)]
    near = [image for image in source_images(around.site, source.x_m) if image.order <= IMAGE_ORDERS]
    return [_mouth_leg(group, index, image, source, around) for image in near]


def _open_leg(group: Patches, index: int, source: MovingSource) -> FirstLeg:
    x, y, z = group.positions_m[index]
    away = np.stack([source.ahead_m - x, source.y_m - y], axis=1)
    length = np.sqrt((away**2).sum(axis=1) + (z - source.height_m) ** 2)
    cosine = np.abs(away @ group.normals[index]) / np.maximum(length, NEAREST_M)
    return FirstLeg(length, (group.strengths_m[index] * np.sqrt(cosine))[:, None] * np.ones(len(OCTAVES_HZ)))


def _mouth_leg(
    group: Patches, index: int, image: SourceImage, source: MovingSource, around: Surroundings
) -> FirstLeg:
    site, (x, y, z) = around.site, group.positions_m[index]
    passage = through_mouth(site, (image.x_m, source.y_m), (x, y), z - source.height_m)
    away = np.stack([np.full_like(source.y_m, site.corner_ahead_m - x), passage.aim_y_m - y], axis=1)
    cosine = np.abs(away @ group.normals[index]) / np.maximum(np.hypot(*away.T), NEAREST_M)
    length = passage.lit * passage.straight_m + (1.0 - passage.lit) * passage.bent_m
    walls = image.gain * near_facade(site, image, source.y_m, passage.aim_y_m)
    gain = group.strengths_m[index] * np.sqrt(cosine) * walls
    return FirstLeg(length, gain[:, None] * passage.screen_gain(around.cap_db))


def last_leg(group: Patches, positions_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance of every patch to every microphone and the amplitude factor there, shape (P, M) each."""
    away = positions_m[None] - group.positions_m[:, None]
    distance = np.maximum(np.linalg.norm(away, axis=2), NEAREST_M)
    cosine = np.abs(np.einsum("pmk,pk->pm", away[:, :, :2], group.normals)) / distance
    return distance, np.sqrt(cosine) / distance


def mirrored(group: Patches, image: ReceiverImage) -> Patches:
    """Return the patches as they are seen in the side walls: an array hears them from there, too."""
    turn = np.array([1.0, image.sign])
    positions = (group.positions_m - np.array([0.0, image.offset_m, 0.0])) * np.array([1.0, image.sign, 1.0])
    return replace(group, positions_m=positions, normals=group.normals * turn)


def seen_through_mouth(
    site: Site, place_m: FloatArray, ego_x_m: FloatArray, image: ReceiverImage
) -> FloatArray:
    """Share that an ego hears of a place in the crossing street by one image, 0 where a corner hides it.

    Shapes: ego_x_m (T,).
    """
    end_m = ego_x_m, float(image.mirror(np.zeros(1))[0])
    passage = through_mouth(site, (float(place_m[0]), np.full_like(ego_x_m, place_m[1])), end_m, 0.0)
    return passage.lit * image.gain * side_walls(site, image, ego_x_m, (site.corner_ahead_m, passage.aim_y_m))
