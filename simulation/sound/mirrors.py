"""The third renderer: mirror images of a source in smooth walls, and diffraction at the two corners.

It has no late field and no scattering: the sound of a hidden vehicle consists of its specular images, each
with its own delay at every microphone, and of waves that the corners diffract. Beams from the array are
traced through the plan. Each beam is the region from which a source reaches the array by one sequence of
reflections, so every reflection lies on its wall and no wall is in between. It uses no energies, rays or
screens.

Sources: J. B. Allen and D. A. Berkley, "Image method for efficiently simulating small-room acoustics", J.
Acoust. Soc. Am. 65, 943-950, 1979; T. Funkhouser et al., "A beam tracing approach to acoustic modeling for
interactive virtual environments", SIGGRAPH 1998.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import pairwise, product

import numpy as np

from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.simulation.scene.junction import Site, site_generator
from worldstate.simulation.scene.octave_bands import OCTAVES_HZ, smooth_step
from worldstate.simulation.scene.presets import Ambience

from .background import Town, direction_numbers
from .diffraction import air_gain, corner_gain, ground_gain
from .receiver import Receiver, add_to_all, passed_places
from .static_field import PlacedSource, StreetSound

ORDERS = 10  # Reflections traced
BENT_ORDERS = 4  # Reflections of paths with a corner; beyond, they are faint compared with unscreened images
# Length of a source's path over which an image appears: the first Fresnel zone at 1 kHz, 6 m away
FADE_M = 1.0
FAINTEST = 0.03  # Amplitude relative to the strongest image, below which an image is left out
NARROWEST_RAD = 1e-5  # Narrowest beam
BESIDE_M = 0.01  # A corner is reachable if a point at this distance beside it is
# Spacing of places along the path of a moving ego; gains of two places are blended. Between them (60 sources)
# the error of the level is at most 0.8 dB, and below 0.34 dB in nine of ten cases; with places every metre it
# is 0.34 and 0.14 dB, at twice the cost.
PLACES_M = 2.0
EVERY = 4  # Interval in knots at which the gains of corners are computed, because they change slowly
DIRECTIONS, SKY_SHARE, LOUDER_DB = 36, (0.1, 0.9), (-8.0, 2.0)
OWN_STREET_M, ARM_M = (10.0, 60.0), (20.0, 90.0)  # Length of walls behind the ego, and along an arm
GAP_SHARE, GAP_M = 0.3, (2.5, 6.0)  # Share of fronts in the crossing street with an opening, and its width
LOSS_PER_OCTAVE = (0.0, 0.01)
# Share of crossings without a wall opposite at which the ego's street continues between houses
BEYOND_SHARE = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Fronts:
    """Smooth walls, seen from above."""

    ends_m: FloatArray  # shape (W, 2, 2): Both ends of every wall, x and y
    kept: FloatArray  # shape (W, 8): Reflected pressure, per octave


def drawn_fronts(site: Site) -> Fronts:
    """Draw the length, the openings and the reflection of the walls of a site's plan.

    Examples
    --------
    >>> from worldstate.simulation.scene.junction import drawn_site
    >>> float(drawn_fronts(drawn_site("MA1")).kept.min()) > 0.8
    True
    """
    rng, ahead = site_generator(site.name, "fronts"), site.corner_ahead_m
    sides = ((1.0, site.corner_left_m), (-1.0, site.corner_right_m))
    walls = []
    for side, across in sides:
        corner = (ahead, side * across)
        walls.append((corner, (-1.0, 0.0), rng.uniform(*OWN_STREET_M), _kept(site.side_reflection, rng)))
        walls.append((corner, (0.0, side), rng.uniform(*ARM_M), _kept(site.facade_reflection, rng)))
    opposite, apart = site.opposite_wall_m, 0.0
    if opposite is None and rng.random() < BEYOND_SHARE:
        opposite, apart = site.far_kerb_m + site.verge_m, rng.uniform(2.0, 8.0)
    if opposite is not None:
        kept = _kept(site.facade_reflection, rng)
        walls += [((opposite, side * apart), (0.0, side), rng.uniform(*ARM_M), kept) for side, _ in sides]
    pieces = []
    for start, way, length, kept in walls:
        at: tuple[float, ...] = (0.0, length)
        # The ego's street has no openings: the array would receive sound from an arm through them, but the
        # camera's plan has none.
        if way[0] == 0.0 and rng.random() < GAP_SHARE:
            gap = rng.uniform(2.0, length - GAP_M[1])
            at = (0.0, gap, gap + rng.uniform(*GAP_M), length)
        for first, last in zip(at[::2], at[1::2], strict=True):
            pieces.append((np.array(start) + np.outer((first, last), way), kept))
    ends, factors = zip(*pieces, strict=True)
    return Fronts(np.array(ends), np.array(factors))


def _kept(reflection: float, rng: np.random.Generator) -> FloatArray:
    return np.asarray(reflection - rng.uniform(*LOSS_PER_OCTAVE) * np.arange(len(OCTAVES_HZ)))


@dataclass(frozen=True, slots=True, eq=False)
class Images:
    """Mirror images of a point (a microphone), and the regions of the plan that reach it by each image."""

    mirror: FloatArray  # shape (I, 3, 3): Maps (x, y, 1) of a point to its image
    kept: FloatArray  # shape (I, 8): Product of the reflection factors
    order: IndexArray  # shape (I,): Number of reflections
    number: IndexArray  # shape (B,): Image of each beam
    apex_m: FloatArray  # shape (B, 2)
    edges: FloatArray  # shape (B, 2, 2): Unit vectors along both edges, the second to the left of the first
    # shape (B, 2, 3): (a, b, c): a x + b y + c > 0 beyond the last wall and before the next
    bounds: FloatArray

    def inside(self, place: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return the distance from both edges, positive inside, and whether a place is between both walls.

        Shapes: place (3, T), rows x, y, 1 -> (2, B, T), (B, T).
        """
        away = place[:2] - self.apex_m[:, :, None]
        (ax, ay), (bx, by) = self.edges.transpose(1, 2, 0)[:, :, :, None]
        across = np.stack([ax * away[:, 1] - ay * away[:, 0], by * away[:, 0] - bx * away[:, 1]])
        return across, np.all(self.bounds @ place > 0.0, axis=1)

    def weights(self, place: FloatArray) -> FloatArray:
        """Return 1 if a source reaches the point by an image and 0 if a wall blocks it, shape (I, T)."""
        across, between = self.inside(place)
        # The weights of beams with a common edge sum to one across it; a beam narrower than the fade is
        # weaker.
        each = np.maximum(smooth_step(0.5 + across / FADE_M).sum(axis=0) - 1.0, 0.0) * between
        out = np.zeros((len(self.mirror), each.shape[1]))
        np.add.at(out, self.number, each)
        return np.minimum(out, 1.0)

    def of(self, image: int, point_m: FloatArray) -> FloatArray:
        """Return the mirror image of a point, shape (2,)."""
        return np.asarray(self.mirror[image, :2] @ [*point_m[:2], 1.0])

    def reached_from(self, place_m: FloatArray) -> IndexArray:
        """Return the images by which a place (2,) reaches the point."""
        across, between = self.inside(np.array([[*place_m, 1.0]]).T)
        return np.unique(self.number[(between & np.all(across > 0.0, axis=0))[:, 0]])

    def opened(self, directions: int) -> FloatArray:
        """Return the energy that leaves the walls in each of K equal sectors around the point, shape (K,)."""
        out, free = np.full(directions, 1e-9), ~self.bounds[:, 1, :2].any(axis=1)
        for number, ((ax, ay), (bx, by)) in zip(self.number[free], self.edges[free], strict=True):
            x, y = np.array([ax + bx, ay + by]) @ self.mirror[number, :2, :2]
            at = direction_numbers(np.arctan2(y, x), directions)
            out[at] += np.arcsin(ax * by - ay * bx) * self.kept[number, 3] ** 2
        return out


@dataclass(frozen=True, slots=True, eq=False)
class _Beam:
    """Directions (start, start + width) from an image, after a reflection in wall `last` (-1: none)."""

    mirror: FloatArray
    kept: FloatArray
    apex_m: FloatArray
    start_rad: float
    width_rad: float
    last: int = -1
    order: int = 0


def trace_images(fronts: Fronts, point_m: FloatArray, orders: int = ORDERS) -> Images:
    """Trace the beams from a point (2,) up to a number of reflections."""
    numbers: dict[tuple[float, ...], int] = {}
    images, found = list[tuple[object, ...]](), list[tuple[object, ...]]()
    whole = np.eye(3), np.ones(len(OCTAVES_HZ)), point_m
    waiting = [_Beam(*whole, start, 0.5 * np.pi) for start in (-np.pi, -0.5 * np.pi, 0.0, 0.5 * np.pi)]
    while waiting:
        beam = waiting.pop()
        key = *_key(beam.mirror), *beam.kept.tolist()
        if key not in numbers:
            numbers[key] = len(images)
            images.append((beam.mirror, beam.kept, beam.order))
        beyond = _side(fronts, beam.last, beam.apex_m) * (-1.0 if beam.last >= 0 else 1.0)
        for start, width, wall in _parts(fronts, beam):
            before = _side(fronts, wall, beam.apex_m)
            edges = _unit(np.array([start, start + width]))
            found.append((numbers[key], beam.apex_m, edges, (beyond, before)))
            if wall >= 0 and beam.order < orders:
                mirror = np.eye(3) - 2.0 * np.outer([*before[:2], 0.0], before)
                # In the mirror, left and right edges are exchanged.
                x, y = mirror[:2, :2] @ edges[1]
                apex, kept = mirror[:2] @ [*beam.apex_m, 1.0], beam.kept * fronts.kept[wall]
                turned = float(np.arctan2(y, x)), width, wall, beam.order + 1
                waiting.append(_Beam(mirror @ beam.mirror, kept, apex, *turned))
    return Images(*map(np.array, [*zip(*images, strict=True), *zip(*found, strict=True)]))


def _key(mirror: FloatArray) -> tuple[float, ...]:
    """Return a key of the image's position, equal for any order of walls."""
    return tuple((np.round(mirror.ravel(), 4) + 0.0).tolist())


def _unit(angle_rad: float | FloatArray) -> FloatArray:
    return np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=-1)


def _parts(fronts: Fronts, beam: _Beam) -> Iterator[tuple[float, float, int]]:
    """Split a beam at the ends of walls: start and width of each part, and its wall (-1: none)."""
    away = fronts.ends_m - beam.apex_m
    turned = np.mod(np.arctan2(away[..., 1], away[..., 0]) - beam.start_rad, 2.0 * np.pi)
    cuts = np.unique(np.r_[0.0, turned[turned < beam.width_rad], beam.width_rad])
    first, along = away[:, 0].T, (away[:, 1] - away[:, 0]).T
    for low, high in pairwise(cuts.tolist()):
        if high - low > NARROWEST_RAD:
            x, y = _unit(beam.start_rad + 0.5 * (low + high))
            with np.errstate(divide="ignore", invalid="ignore"):
                across = x * along[1] - y * along[0]
                way = (first[0] * along[1] - first[1] * along[0]) / across
                part = (first[0] * y - first[1] * x) / across
            # A beam starts at its last wall: walls between the image and that wall have no effect.
            hit = (part > 0.0) & (part < 1.0) & (way > (way[beam.last] + 1e-6 if beam.last >= 0 else 0.0))
            nearest = int(np.where(hit, way, np.inf).argmin()) if hit.any() else -1
            yield beam.start_rad + low, high - low, nearest


def _side(fronts: Fronts, wall: int, apex_m: FloatArray) -> FloatArray:
    """Return (a, b, c), (a, b) of unit length, with a x + b y + c > 0 on the apex's side of a wall."""
    if wall < 0:
        return np.array([0.0, 0.0, 1.0])
    (x, y), (to_x, to_y) = fronts.ends_m[wall]
    line = np.array([y - to_y, to_x - x, x * to_y - to_x * y]) / np.hypot(to_x - x, to_y - y)
    return np.asarray(line * np.sign(line @ [*apex_m, 1.0]))


@lru_cache(maxsize=256)
def images_at(site: Site, x_m: float, y_m: float) -> Images:
    """Return the traced beams of a place of a site, from a cache."""
    return trace_images(drawn_fronts(site), np.array([x_m, y_m]))


@dataclass(frozen=True, slots=True, eq=False)
class ImagePath:
    """One path from a source to the microphones at the emission knots."""

    gain: FloatArray  # shape (T, 8): Amplitude without spherical spreading
    from_m: FloatArray  # shape (2, T) or (2, 1): Start of the last leg, at the source or at a corner
    before_m: FloatArray | float  # shape (T,): Length before the last leg
    images: Images
    number: int  # Image of the microphones at its end
    height_m: float  # Height of the source

    def length_m(self, position_m: FloatArray, ego_x_m: float | FloatArray = 0.0) -> FloatArray:
        """Return the length to a position (3,) on an ego at `ego_x_m` (T,)."""
        ahead = self.images.mirror[self.number, :2, :1] * ego_x_m
        last = np.hypot(*(self.from_m - self.images.of(self.number, position_m)[:, None] - ahead))
        return np.asarray(np.hypot(self.before_m + last, position_m[2] - self.height_m))


def add_mirrored(street: StreetSound, source: PlacedSource, rng: np.random.Generator) -> None:
    """Add a source by all its images and by the waves that both corners diffract."""
    _, heard_x = source.straight_m(street.receiver.centre_m, street.receiver)
    for x_m, span, share in passed_places(heard_x, PLACES_M):
        _add_near(street, source.during(span), x_m, span, share)


def _add_near(street: StreetSound, source: PlacedSource, x_m: float, span: slice, share: FloatArray) -> None:
    """Add the sound of a source while the ego is near a place; lengths follow the ego's motion."""
    receiver, emission = street.receiver, source.emission
    centre = receiver.centre_m + np.array([x_m, 0.0, 0.0])
    ways, whole = ways_of(street.site, source, centre), np.zeros((len(emission.knots_s), len(OCTAVES_HZ)))
    lengths = [way.length_m(centre) for way in ways]
    loud = np.array([way.gain[:, 3] / length for way, length in zip(ways, lengths, strict=True)])
    for way, length, level in zip(ways, lengths, loud, strict=True):
        road = ground_gain(length, source.height_m, float(centre[2]))
        audible = share * (level > FAINTEST * loud.max(axis=0))
        whole[span] = way.gain * air_gain(length) * road * audible[:, None]

        def travel(position: FloatArray, way: ImagePath = way) -> FloatArray:
            out = np.zeros(len(whole))
            out[span] = receiver.arrivals(source.time_s, partial(way.length_m, position))[0]
            return out

        # For a standing ego the sound starts without a fade, as when the presets were fitted.
        add_to_all(street.static.out, emission, whole, travel, receiver, fades=not receiver.ego.stands)


def ways_of(site: Site, source: PlacedSource, centre_m: FloatArray) -> list[ImagePath]:
    """Return the paths of all visible images of a source, and of its diffracted waves."""
    images = images_at(site, *centre_m[:2].round(3).tolist())
    place = np.stack([source.x_m, source.y_m, np.ones_like(source.x_m)])
    lit, height = images.weights(place), source.height_m
    # At the shadow boundary half of the amplitude remains: a quarter from this path, a quarter round the
    # corner.
    seen = [
        ImagePath(lit[number, :, None] ** 2 * images.kept[number], place[:2], 0.0, images, number, height)
        for number in np.flatnonzero(lit.any(axis=1)).tolist()
    ]
    return [*seen, *_diffracted(site, images, lit, place, centre_m, height)]


def _diffracted(
    site: Site, images: Images, lit: FloatArray, place: FloatArray, centre_m: FloatArray, height_m: float
) -> Iterator[ImagePath]:
    """Yield the paths from images of a source in an arm round its corner to images of the microphones."""
    keys = [_key(one) for one in images.mirror]
    knots = np.arange(lit.shape[1])
    some = np.r_[knots[:-1:EVERY], knots[-1]]
    for side, across in ((1.0, site.corner_left_m), (-1.0, site.corner_right_m)):
        corner, here = np.array([site.corner_ahead_m, side * across]), np.array([BESIDE_M, side * BESIDE_M])
        arm = images_at(site, corner[0] + here[0], corner[1] - here[1])
        reached = arm.weights(place[:, some]) * (side * place[1, some] > 0.0)
        both = product(images.reached_from(corner - here).tolist(), np.flatnonzero(reached.any(axis=1)))
        for ear, there in both:
            at, mirror = images.of(ear, centre_m), arm.mirror[there]
            unfolded = (np.linalg.inv(mirror) @ place)[:2]
            # The coefficient of the wedge already includes images behind a face of the corner.
            open_to = reached[there] * (unfolded[0, some] > corner[0]) * (side * at[1] < across)
            key = _key(mirror @ images.mirror[ear])
            straight = lit[[one == key for one in keys]].sum(axis=0)
            hidden = open_to * np.maximum(1.0 - straight[some], 0.0)
            if images.order[ear] + arm.order[there] <= BENT_ORDERS and hidden.any():
                before = np.hypot(*(unfolded - corner[:, None]))
                gain = corner_gain(tuple(corner - at), *(unfolded[:, some] - at[:, None]))
                gain *= hidden[:, None] * images.kept[ear] * arm.kept[there]
                gain = np.stack([np.interp(knots, some, band) for band in gain.T], axis=1)
                way = ImagePath(gain, corner[:, None], before, images, ear, height_m)
                yield replace(way, gain=gain * way.length_m(centre_m)[:, None])


def town_by_mirrors(receiver: Receiver, site: Site, here: Ambience) -> Town:
    """Return a background that enters at the ends of the walls, at the site's own level."""
    opened = images_at(site, *receiver.centre_m[:2].round(3).tolist()).opened(DIRECTIONS)
    return Town(here, site_generator(site.name, "town"), opened, SKY_SHARE, LOUDER_DB)
