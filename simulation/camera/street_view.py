"""The street as the camera sees it without a vehicle: ground, side walls, corners, what stands opposite."""

from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from worldstate.ground.typing import BoolArray, Float32Array, ImageArray
from worldstate.simulation.scene.junction import Site, site_generator
from worldstate.simulation.scene.route import ARRAY_HEIGHT_M

from .rays import OVERSAMPLING, Panel, Patch, View, cast_panels, reduced
from .textures import Facade, asphalt, flags, grass, leaves, paving, smooth_noise, tinted

ROAD_Z_M = -ARRAY_HEIGHT_M
FAR_M = 150.0
# The corner of a building stands out from its side wall on the last metre.
PIER_M = 1.0
PAVEMENT_M = 0.9
# Sites without a wall opposite open on a verge with a hedge; houses stand behind.
HEDGE_AHEAD_M, HEDGE_HEIGHT_M, HOUSES_AHEAD_M = 16.0, 1.7, 34.0
STRIP_ROWS = 64
BRICKS = ((134.0, 92.0, 76.0), (150.0, 120.0, 96.0), (116.0, 88.0, 80.0), (160.0, 146.0, 124.0))


@dataclass(frozen=True, slots=True, eq=False)
class StreetView:
    """What does not move, painted once."""

    view: View  # The camera
    image: ImageArray  # shape (rows, columns, 3): One colour a ray
    depth: Float32Array  # shape (rows, columns): Metres along the optical axis

    def pixels(self) -> Float32Array:
        """Return the image itself, shape (height, width, 3)."""
        rows = range(0, self.image.shape[0], STRIP_ROWS * OVERSAMPLING)
        step = STRIP_ROWS * OVERSAMPLING
        return np.concatenate([reduced(self.image[row : row + step].astype(np.float32)) for row in rows])


# Painting takes 4 s, a third of a recording's video. Five sites of 66 MB each: those of OVAD.
@lru_cache(maxsize=5)
def paint_street(site: Site, view: View) -> StreetView:
    """Paint a site; it has the same face in every recording."""
    panels = street_panels(site)
    rows, columns = view.shape
    image, depth = np.empty((rows, columns, 3), np.uint8), np.empty((rows, columns), np.float32)
    for top in range(0, rows, STRIP_ROWS):
        strip = Patch(top, min(top + STRIP_ROWS, rows), 0, columns)
        colours, depth[strip.slices] = cast_panels(view, strip, panels, _sky)
        image[strip.slices] = np.clip(colours, 0.0, 255.0).round()
    return StreetView(view, image, depth)


def street_panels(site: Site) -> list[Panel]:
    """Return every surface of a site."""
    rng = site_generator(site.name, "look")
    seeds = rng.integers(0, 1 << 16, 8).tolist()
    colours = rng.permutation(len(BRICKS)).tolist()
    left = Facade(BRICKS[colours[0]], rng.uniform(2.6, 3.4), ROAD_Z_M, 0.85, seeds[0])
    right = Facade(BRICKS[colours[1]], rng.uniform(2.6, 3.4), ROAD_Z_M, 0.8, seeds[1])
    heights = rng.uniform(6.0, 8.5, 3)
    front = Facade(BRICKS[colours[2]], rng.uniform(2.8, 3.6), ROAD_Z_M, 0.95, seeds[3])
    return [
        Panel(2, ROAD_Z_M, ((-5.0, FAR_M), (-FAR_M, FAR_M)), _Ground(site, seeds[2]).paint),
        *_building(site, 1.0, left, heights[0]),
        *_building(site, -1.0, right, heights[1]),
        *_opposite(site, front, heights[2]),
    ]


def _building(site: Site, side: float, front: Facade, height_m: float) -> list[Panel]:
    """Side wall, the return of the corner pier, and the pier itself; side is +1 left, -1 right."""
    wall = site.side_wall_left_m if side > 0 else site.side_wall_right_m
    corner = site.corner_left_m if side > 0 else site.corner_right_m
    start, end = site.corner_ahead_m - PIER_M, site.corner_ahead_m
    up = (ROAD_Z_M, ROAD_Z_M + height_m)
    plain = Facade(front.colour, 1e6, ROAD_Z_M, front.brightness, front.seed)
    depth = (min(side * corner, side * wall), max(side * corner, side * wall))
    return [
        Panel(1, side * wall, ((-20.0, start), up), front.paint),
        Panel(0, start, (depth, up), plain.paint),
        Panel(1, side * corner, ((start, end), up), plain.paint),
    ]


def _opposite(site: Site, front: Facade, height_m: float) -> list[Panel]:
    across = (-FAR_M, FAR_M)
    if site.opposite_wall_m is not None:
        return [Panel(0, site.opposite_wall_m, (across, (ROAD_Z_M, ROAD_Z_M + height_m)), front.paint)]
    hedge = site.far_kerb_m + HEDGE_AHEAD_M - 9.0
    green = partial(leaves, seed=front.seed)
    return [
        Panel(0, hedge, (across, (ROAD_Z_M, ROAD_Z_M + HEDGE_HEIGHT_M)), green),
        Panel(0, HOUSES_AHEAD_M, (across, (ROAD_Z_M, ROAD_Z_M + height_m + 1.0)), front.paint),
    ]


@dataclass(frozen=True, slots=True)
class _Ground:
    """Paved lane between the buildings, asphalt across, kerbs, a broken centre line, give-way teeth."""

    site: Site
    seed: int

    def paint(self, ahead: Float32Array, left: Float32Array) -> Float32Array:
        near, far = self.site.corner_ahead_m + self.site.verge_m, self.site.far_kerb_m
        image = paving(left, ahead, self.seed)
        _put(image, asphalt(ahead, left, self.seed), (ahead > near) & (ahead < far))
        beyond = flags(left, ahead, self.seed) if self.site.opposite_wall_m else grass(ahead, left, self.seed)
        _put(image, beyond, ahead > far)
        pavement = flags(left, ahead, self.seed)
        _put(image, pavement, (ahead > far) & (ahead < far + PAVEMENT_M))
        kerb = (np.abs(ahead - far) < 0.07) | (np.abs(ahead - near - 0.05) < 0.07)
        image[kerb] = (166.0, 164.0, 158.0)
        worn = tinted((206.0, 206.0, 200.0), 0.8 + 0.2 * smooth_noise(ahead, left, 0.1, self.seed))
        _put(image, worn, self._marked(ahead, left))
        image *= self._light(ahead, left)[..., None]
        return image

    def _marked(self, ahead: Float32Array, left: Float32Array) -> BoolArray:
        middle = self.site.far_kerb_m - 0.5 * self.site.street_width_m
        line = (np.abs(ahead - middle) < 0.05) & (np.mod(left, 3.0) < 1.2)
        depth = ahead - (self.site.corner_ahead_m - 0.75)
        centre = 0.75 * (np.floor(left / 0.75) + 0.5)
        tooth = np.abs(left - centre) < 0.25 * np.clip(depth / 0.6, 0.0, 1.0)
        between = (centre < self.site.corner_left_m - 0.6) & (centre > -self.site.corner_right_m + 0.6)
        return np.asarray(line | (tooth & (depth > 0.0) & (depth < 0.6) & between))

    def _light(self, ahead: Float32Array, left: Float32Array) -> Float32Array:
        """Less light at the foot of the walls of the ego's street."""
        gap = np.minimum(self.site.side_wall_left_m - left, left + self.site.side_wall_right_m)
        inside = 0.65 + 0.35 * np.clip(gap / 1.2, 0.0, 1.0)
        return np.where(ahead < self.site.corner_ahead_m, inside, 1.0).astype(np.float32)


def _put(image: Float32Array, other: Float32Array, where: BoolArray) -> None:
    image[where] = other[where]


def _sky(left: Float32Array, up: Float32Array) -> Float32Array:
    """Overcast, brighter towards the horizon."""
    clouds = 0.97 + 0.06 * smooth_noise(left, up * 2.0, 0.3, 1)
    return tinted((206.0, 211.0, 217.0), clouds * (1.04 - 0.12 * np.clip(up, 0.0, 1.0)))
