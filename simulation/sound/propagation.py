"""Propagation of moving sources along all paths to all microphones, which may move as well."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TypeAlias

import numpy as np

from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.occluders import OccludingBody, detours, walls
from worldstate.simulation.scene.octave_bands import OCTAVES_HZ, smooth_step
from worldstate.simulation.scene.vehicle import SOURCE_HEIGHT_M

from .diffraction import SPEED_OF_SOUND_MPS, air_gain, ground_gain, screen_attenuation_db
from .paths import LEFT, RIGHT, Path, ReceiverImage, receiver_images, side_walls, trace_paths
from .receiver import Receiver, add_along, add_to_all, add_turning, in_own_street
from .static_field import PlacedSource, StreetSound

BLEND_M = 0.02  # Length of the detour over which a line that touches a body becomes the path round it


# Position (x, y) of a source in the open or of its mirror image in a wall, (T,) each; its amplitude after the
# wall, 0 without a reflection, (T, 1); and the bodies between it and the array.
OpenImage: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, tuple[OccludingBody, ...]]


def open_images(site: Site, x_m: FloatArray, y_m: FloatArray, ego_x_m: FloatArray) -> list[OpenImage]:
    """Return a source and its first-order images in the walls of the site's bodies."""
    images: list[OpenImage] = [(x_m, y_m, np.ones((len(y_m), 1)), site.occluders)]
    for body in site.occluders:
        for wall in walls(body):
            weight = wall.reflects(x_m, y_m, (ego_x_m, 0.0))
            if weight.any():
                # In the unfolded plan the path before the reflection passes the mirror images of the other
                # bodies.
                others = [one for one in site.occluders if one is not body]
                behind = map(wall.mirrored_body, others)
                gain = site.side_reflection * weight[:, None]
                images.append((*wall.mirrored(x_m, y_m), gain, (*others, *behind)))
    return images


# Horizontal distance from a source to a point that its sound passes, 0 for the straight line; position (x, y)
# of that point, or of the source itself, (T,) each; and the amplitude per octave, 0 if this path does not
# apply, (T, 8).
ScreenedLeg: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def screened_legs(
    occluders: Sequence[OccludingBody], x_m: FloatArray, y_m: FloatArray, ego_x_m: FloatArray, cap_db: float
) -> list[ScreenedLeg]:
    """Return the straight path and the detours round the corners of the body with the largest detour."""
    if not occluders:
        return [(np.zeros_like(y_m), x_m, y_m, np.ones((len(y_m), len(OCTAVES_HZ))))]
    # At each time one body is used; the bodies behind it change little.
    found = [detours(one, x_m, y_m, (ego_x_m, 0.0)) for one in occluders]
    worst = np.argmax([detour for detour, _ in found], axis=0)
    detour = np.max([one for one, _ in found], axis=0)
    gain = 10.0 ** (-screen_attenuation_db(detour[:, None], OCTAVES_HZ, cap_db) / 20.0)
    blocked = smooth_step(detour / BLEND_M)
    legs = [(np.zeros_like(y_m), x_m, y_m, gain * (1.0 - blocked)[:, None])]
    for body, (occluder, (_, chosen)) in enumerate(zip(occluders, found, strict=True)):
        for index, (x, y) in enumerate(occluder.corners_m):
            here = blocked * ((worst == body) & (chosen == index))
            if here.any():
                corner = np.full_like(y_m, x), np.full_like(y_m, y)
                legs.append((np.hypot(x_m - x, y_m - y), *corner, gain * here[:, None]))
    return legs


TYPICAL_LEG_M = 8.0  # Source to corner; affects only the tilt of the last leg
ANY_ORDER = range(99)
FAINTEST = 3e-3  # Paths below this share of the total amplitude are left out (features change by 4e-4 rms)


def add_sources(street: StreetSound, sources: Sequence[PlacedSource], reflections: range = ANY_ORDER) -> None:
    """Add moving sources to all microphones by all paths up to a number of reflections."""
    if street.site.is_open:
        for source in sources if 0 in reflections else ():
            _add_open(street, source)
        return
    images = receiver_images(street.site)
    bent = np.zeros((len(images), 2, street.receiver.samples), np.float32)
    for source in sources:
        for path in _audible(_paths(source, street)):
            if path.source.order + path.receiver.order not in reflections:
                continue
            for edge in (LEFT, RIGHT):
                _add_bent(bent[images.index(path.receiver), edge], source, path, edge, street)
            _add_lit(street, source, path)
    _add_corners(street, bent, images)


def _paths(source: PlacedSource, street: StreetSound) -> list[Path]:
    receiver, site = street.receiver, street.site
    above = receiver.above(source.height_m)
    flat = source.y_m**2 + above**2
    _, heard_x = receiver.arrivals(source.emission.knots_s, partial(_slant, source.x_m, flat))
    mirrored = np.sqrt(1.0 - street.scattered(True)), np.sqrt(1.0 - street.scattered(False))
    place, cap_db = (source.x_m, source.y_m, above), street.preset.screen_cap_db
    paths = trace_paths(site, *place, cap_db, receiver_x_m=heard_x, specular=mirrored)
    beside = in_own_street(site, source.x_m, source.y_m)
    if beside.any():
        paths = [_beside(path, source, beside, mirrored[1], heard_x, street) for path in paths]
    return [replace(path, gain=path.gain * media_gain(path.bent_m, source, receiver)) for path in paths]


def _beside(
    path: Path,
    source: PlacedSource,
    share: FloatArray,
    specular: FloatArray,
    heard_x_m: FloatArray,
    street: StreetSound,
) -> Path:
    """Return the path of a source whose `share` is in the ego's own street.

    Shapes: share, heard_x_m (T,), specular (8,).
    """
    image, order = path.receiver, path.source.order
    if order % 2:
        return path  # Sound by the wall opposite arrives through the mouth, as from the crossing street
    if order:
        # This path meets the near facade first, and a source in the ego's street is behind that facade.
        return replace(path, gain=path.gain * (1.0 - share)[:, None])
    across = source.y_m - image.offset_m
    above = street.receiver.above(source.height_m)
    straight = np.sqrt((source.x_m - heard_x_m) ** 2 + across**2 + above**2)
    walls = side_walls(street.site, image, heard_x_m, (source.x_m, source.y_m))
    whole = image.gain * walls[:, None] * specular**image.order
    return replace(
        path,
        lit=np.maximum(path.lit, share),
        bent_m=path.bent_m + share * (straight - path.bent_m),
        gain=path.gain + share[:, None] * (whole - path.gain),
    )


def media_gain(length_m: FloatArray, source: PlacedSource, receiver: Receiver) -> FloatArray:
    """Return the amplitude after air and road per octave, shape (T, 8)."""
    return air_gain(length_m) * ground_gain(length_m, source.height_m, float(receiver.centre_m[2]))


def _audible(paths: list[Path]) -> list[Path]:
    """Return the paths that at some time exceed `FAINTEST` of the total amplitude."""
    strength = np.array([path.gain.max(axis=1) / path.bent_m for path in paths])
    share = strength / np.maximum(strength.sum(axis=0), 1e-30)
    return [path for path, peak in zip(paths, share.max(axis=1), strict=True) if peak > FAINTEST]


def _add_bent(out: Float32Array, source: PlacedSource, path: Path, edge: int, street: StreetSound) -> None:
    """Add the sound that reaches the array's centre round one corner."""
    made = source.emission.table(path.gain * ((1.0 - path.lit) * (path.edge == edge))[:, None])
    if made is None:
        return
    table, span = made
    receiver, mouth = street.receiver, street.site.corner_ahead_m
    before, above = path.before_m[span], receiver.above(source.height_m)
    knots, across = source.emission.knots_s[span], path.edge_y_m[span] - path.receiver.offset_m
    travel, _ = receiver.arrivals(knots, partial(_round, before, mouth, across, above))
    add_along(out, table, knots, travel, receiver.knots_s)


def _add_lit(street: StreetSound, source: PlacedSource, path: Path) -> None:
    """Add the sound that reaches every microphone along the straight line."""
    receiver = street.receiver

    def travel(position: FloatArray) -> FloatArray:
        across = source.y_m - path.receiver.mirror(position[1:2])
        flat = across**2 + (position[2] - source.height_m) ** 2
        ahead = path.source.x_m - position[0]
        return receiver.arrivals(source.emission.knots_s, partial(_slant, ahead, flat))[0]

    add_to_all(street.static.out, source.emission, path.gain * path.lit[:, None], travel, receiver)


def _slant(along: float | FloatArray, flat_squared: FloatArray, x_m: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt((along - x_m) ** 2 + flat_squared))


def _add_open(street: StreetSound, source: PlacedSource) -> None:
    """Add the sound that reaches every microphone in the open: straight, by a wall, or round a body."""
    receiver, cap_db = street.receiver, street.preset.screen_cap_db
    flat = source.y_m**2 + receiver.above(source.height_m) ** 2
    _, heard_x = receiver.arrivals(source.emission.knots_s, partial(_slant, source.x_m, flat))
    for x, y, reflected, occluders in open_images(street.site, source.x_m, source.y_m, heard_x):
        straight = np.sqrt((x - heard_x) ** 2 + y**2 + receiver.above(source.height_m) ** 2)
        gain = reflected * media_gain(straight, source, receiver)
        for before, via_x, via_y, screened in screened_legs(occluders, x, y, heard_x, cap_db):
            leg = before, via_x, via_y, screened * gain
            _add_leg(street.static.out, source, leg, receiver)


def _add_leg(out: Float32Array, source: PlacedSource, leg: ScreenedLeg, receiver: Receiver) -> None:
    """Add the sound that reaches every microphone past one point, or straight."""
    before, via_x, via_y, gain = leg

    def travel(position: FloatArray) -> FloatArray:
        along, across = via_x - position[0], via_y - position[1]
        length = partial(_round, before, along, across, position[2] - source.height_m)
        return receiver.arrivals(source.emission.knots_s, length)[0]

    add_to_all(out, source.emission, gain, travel, receiver)


def _round(
    before: FloatArray, along: float | FloatArray, across: FloatArray, rise: float, x_m: FloatArray
) -> FloatArray:
    return np.asarray(np.hypot(before + np.hypot(along - x_m, across), rise))


def _add_corners(street: StreetSound, bent: Float32Array, images: list[ReceiverImage]) -> None:
    """Add the sound of every corner, in every side image, to all microphones."""
    site, receiver, static = street.site, street.receiver, street.static
    places = [(image, y) for image in images for y in (site.corner_left_m, -site.corner_right_m)]
    signals = bent.reshape(-1, bent.shape[2])
    used = np.flatnonzero(np.abs(signals).max(axis=1) > 0.0)
    if len(used) and receiver.ego.stands:
        delays = np.stack([_corner_delays(*place, site.corner_ahead_m, receiver) for place in places])
        static.add(signals[used], delays[used])
    elif len(used):
        for i in used:
            image, y = places[i]
            place = np.array([site.corner_ahead_m, image.sign * (y - image.offset_m), receiver.centre_m[2]])
            add_turning(static.out, signals[i], place, np.ones(len(receiver.knots_s)), receiver)


def _corner_delays(image: ReceiverImage, corner_y: float, mouth: float, receiver: Receiver) -> FloatArray:
    """Return the delay of every microphone relative to the centre for sound from a corner, shape (M,)."""
    x, y, z = receiver.positions_m.T
    last_leg = np.hypot(mouth - x, image.mirror(y) - corner_y)
    to_centre = np.hypot(mouth, image.offset_m - corner_y)
    tilted = np.hypot(TYPICAL_LEG_M + last_leg, z - SOURCE_HEIGHT_M)
    centre = np.hypot(TYPICAL_LEG_M + to_centre, receiver.above(SOURCE_HEIGHT_M))
    return np.asarray((tilted - centre) / SPEED_OF_SOUND_MPS + receiver.skew_s)
