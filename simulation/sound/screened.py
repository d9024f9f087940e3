"""The ways past bodies in the open: straight, by a wall, or round a body, each by one corner at a time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import FloatArray
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.occluders import OccludingBody, detours, walls
from worldstate.simulation.scene.octave_bands import OCTAVES_HZ, smooth_step

from .diffraction import screen_attenuation_db

BLEND_M = 0.02  # detour over which a line that touches a body turns into the way round it


@dataclass(frozen=True, slots=True, eq=False)
class OpenImage:
    """A source in the open, or its mirror image in a wall, and the bodies between it and the array."""

    x_m: FloatArray  # shape (T,): Where it stands
    y_m: FloatArray
    gain: (
        FloatArray  # shape (T, 8): Amplitude that the wall leaves, per octave; 0 where there is no reflection
    )
    occluders: tuple[OccludingBody, ...]


def open_images(site: Site, x_m: FloatArray, y_m: FloatArray, ego_x_m: FloatArray) -> list[OpenImage]:
    """Return a source and its first-order images in the walls of the site's bodies."""
    images = [OpenImage(x_m, y_m, np.ones((len(y_m), 1)), site.occluders)]
    for body in site.occluders:
        for wall in walls(body):
            weight = wall.reflects(x_m, y_m, (ego_x_m, 0.0))
            if weight.any():
                # Unfolded, the way before the reflection passes the mirror images of the other bodies.
                others = [one for one in site.occluders if one is not body]
                behind = map(wall.mirrored_body, others)
                gain = site.side_reflection * weight[:, None]
                images.append(OpenImage(*wall.mirrored(x_m, y_m), gain, (*others, *behind)))
    return images


@dataclass(frozen=True, slots=True, eq=False)
class ScreenedLeg:
    """Sound that goes by one point, or straight, at a series of emission times."""

    # shape (T,): Way from the source to that point, seen from above; 0 for the straight line.
    before_m: FloatArray
    via_x_m: FloatArray  # shape (T,): That point, or the source itself
    via_y_m: FloatArray
    gain: FloatArray  # shape (T, 8): Amplitude per octave; 0 where this is not the way


def screened_legs(
    occluders: Sequence[OccludingBody], x_m: FloatArray, y_m: FloatArray, ego_x_m: FloatArray, cap_db: float
) -> list[ScreenedLeg]:
    """Return the straight way and the way round every corner of the body that is most in the way."""
    if not occluders:
        return [ScreenedLeg(np.zeros_like(y_m), x_m, y_m, np.ones((len(y_m), len(OCTAVES_HZ))))]
    # Only that body counts at any time; behind it the others change little.
    found = [detours(one, x_m, y_m, (ego_x_m, 0.0)) for one in occluders]
    worst = np.argmax([detour for detour, _ in found], axis=0)
    detour = np.max([one for one, _ in found], axis=0)
    gain = 10.0 ** (-screen_attenuation_db(detour[:, None], OCTAVES_HZ, cap_db) / 20.0)
    blocked = smooth_step(detour / BLEND_M)
    legs = [ScreenedLeg(np.zeros_like(y_m), x_m, y_m, gain * (1.0 - blocked)[:, None])]
    for body, (occluder, (_, chosen)) in enumerate(zip(occluders, found, strict=True)):
        for index, (x, y) in enumerate(occluder.corners_m):
            here = blocked * ((worst == body) & (chosen == index))
            if here.any():
                before = np.hypot(x_m - x, y_m - y)
                legs.append(
                    ScreenedLeg(before, np.full_like(y_m, x), np.full_like(y_m, y), gain * here[:, None])
                )
    return legs
