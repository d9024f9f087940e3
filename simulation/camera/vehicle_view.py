"""Camera view of a car: body and cabin as convex solids, wheels, glass, lights, and its shadow.

The car's own coordinates are metres across (x of `base_link` from the lane's middle), behind the front, and
above the road.
"""

from dataclasses import dataclass, replace

import numpy as np

from worldstate.ground.typing import BoolArray, Float32Array, FloatArray, TextArray
from worldstate.simulation.scene.vehicle import AXLES_BEHIND_FRONT_M, HEIGHT_M, LENGTH_M, WIDTH_M

from .street_view import GLASS, ROAD_Z_M, Colour, Patch, StreetView, cast_solid, reduced, tinted

PAINTS: tuple[Colour, ...] = (
    (206.0, 208.0, 208.0), (148.0, 152.0, 156.0), (46.0, 48.0, 52.0), (78.0, 84.0, 92.0),
    (52.0, 72.0, 112.0), (132.0, 36.0, 36.0), (176.0, 172.0, 160.0),
)  # fmt: skip
TYRE: Colour = (34.0, 34.0, 35.0)
RIM: Colour = (158.0, 160.0, 163.0)
DARK: Colour = (24.0, 24.0, 26.0)
UNDER: Colour = (46.0, 46.0, 47.0)  # Shaded road below the car
LAMP: Colour = (226.0, 228.0, 224.0)
TAIL: Colour = (146.0, 26.0, 26.0)
HALF_M = 0.5 * WIDTH_M
WAIST_M, NOSE_M, SILL_M, CLEARANCE_M = 0.88, 0.68, 0.26, 0.15
WHEEL_M, RIM_M, ARCH_M = 0.31, 0.2, 0.37
BUMPER_M = 0.16  # Inclination of the ends up to the waist
# Distances behind the front: foot and top of the windscreen, top and foot of the rear window.
SCREEN_M, REAR_WINDOW_M = (1.15, 1.95), (3.75, 4.15)
SEAMS_M = (1.3, 2.42, 3.4)
TUMBLE = 0.22  # Inclination of the cabin's sides per metre of height
SHADOW, SHADOW_REACH_M = 0.55, 0.45

# Faces as normals n and offsets o of n . p <= o, in the car's own coordinates.
_BODY = {
    "side": ((-1.0, 0.0, 0.0), HALF_M),
    "far side": ((1.0, 0.0, 0.0), HALF_M),
    "front": ((0.0, -1.0, BUMPER_M / WAIST_M), 0.0),
    "rear": ((0.0, 1.0, BUMPER_M / WAIST_M), LENGTH_M),
    "top": ((0.0, 0.0, 1.0), WAIST_M),
    "hood": ((0.0, -(WAIST_M - NOSE_M) / SCREEN_M[0], 1.0), NOSE_M),
    "floor": ((0.0, 0.0, -1.0), 0.0),
}
_CABIN_HEIGHT_M = HEIGHT_M - WAIST_M
_SCREEN_SLOPE = (SCREEN_M[1] - SCREEN_M[0]) / _CABIN_HEIGHT_M
_REAR_SLOPE = (REAR_WINDOW_M[1] - REAR_WINDOW_M[0]) / _CABIN_HEIGHT_M
_CABIN_HALF_M = HALF_M - 0.06 + TUMBLE * WAIST_M
_CABIN = {
    "window": ((-1.0, 0.0, TUMBLE), _CABIN_HALF_M),
    "far window": ((1.0, 0.0, TUMBLE), _CABIN_HALF_M),
    "screen": ((0.0, -1.0, _SCREEN_SLOPE), _SCREEN_SLOPE * WAIST_M - SCREEN_M[0]),
    "rear window": ((0.0, 1.0, _REAR_SLOPE), _REAR_SLOPE * WAIST_M + REAR_WINDOW_M[1]),
    "roof": ((0.0, 0.0, 1.0), HEIGHT_M),
    "waist": ((0.0, 0.0, -1.0), -WAIST_M),
}


@dataclass(frozen=True, slots=True)
class Car:
    """A car across the street."""

    lane_x_m: float  # Middle of its lane and its front bumper, in `base_link`
    front_y_m: float
    heading: int  # +1 towards +y, -1 towards -y
    colour: Colour  # Colour of the paint

    def corners_m(self) -> FloatArray:
        """Return the corners of the cuboid around the car and its shadow, in `base_link`, shape (8, 3)."""
        x = self.lane_x_m + (HALF_M + SHADOW_REACH_M) * np.array([-1.0, 1.0])
        rear = self.front_y_m - self.heading * LENGTH_M
        y = np.sort([self.front_y_m, rear]) + SHADOW_REACH_M * np.array([-1.0, 1.0])
        return np.array(np.meshgrid(x, y, ROAD_Z_M + np.array([0.0, HEIGHT_M]))).reshape(3, -1).T


def add_car(street: StreetView, car: Car, image: Float32Array) -> None:
    """Draw a car into an image (height, width, 3), except where the street hides it."""
    patch = street.view.around(car.corners_m())
    if patch is not None:
        image[patch.pixels] = reduced(_painted(street, car, patch))


def with_parked_car(street: StreetView, car: Car) -> StreetView:
    """Return the street with a parked car."""
    # A parked car hides no moving vehicle here, because in narrow streets parked cars extend into the lanes.
    patch = street.view.around(car.corners_m())
    if patch is None:
        return street
    image = street.image.copy()
    image[patch.slices] = np.clip(_painted(street, car, patch), 0.0, 255.0).round()
    return replace(street, image=image)


def _painted(street: StreetView, car: Car, patch: Patch) -> Float32Array:
    """Return the colours of the rays of a patch, shape (rows, columns, 3)."""
    colours = street.image[patch.slices].astype(np.float32)
    depth = street.depth[patch.slices].copy()
    # From `base_link` to the car's own coordinates: the viewpoint, shape (3,), and its rays.
    x, y, z = street.view.camera.position_m
    eye = np.array([x - car.lane_x_m, (car.front_y_m - y) * car.heading, z - ROAD_Z_M])
    rays = street.view.rays(patch) * np.array([1.0, -car.heading, 1.0], np.float32)
    _cast_shadow(colours, depth, rays, eye)
    for faces, paint in ((_BODY, _paint_body), (_CABIN, _paint_cabin)):
        normals = np.array([normal for normal, _ in faces.values()])
        reach, face = cast_solid(rays, eye, normals, np.array([offset for _, offset in faces.values()]))
        nearer = reach < depth
        places = eye.astype(np.float32) + reach[nearer][:, None] * rays[nearer]
        colours[nearer] = paint(car, places, np.array(list(faces))[face[nearer]])
        depth[nearer] = reach[nearer]
    return colours


def _cast_shadow(colours: Float32Array, depth: Float32Array, rays: Float32Array, eye: FloatArray) -> None:
    with np.errstate(divide="ignore"):
        road = np.float32(-eye[2]) / rays[..., 2]
    across = eye[0] + road * rays[..., 0]
    behind = eye[1] + road * rays[..., 1]
    past_an_end = np.maximum(np.maximum(-behind, behind - LENGTH_M), 0.0)
    beyond = np.hypot(np.maximum(np.abs(across) - HALF_M, 0.0), past_an_end)
    strength = SHADOW * np.clip(1.0 - beyond / SHADOW_REACH_M, 0.0, 1.0)
    on_road = (road > 0.0) & (np.abs(road - depth) < 1e-3 * depth)
    colours[on_road] *= (1.0 - strength[on_road])[:, None].astype(np.float32)


def _paint_body(car: Car, places: Float32Array, face: TextArray) -> Float32Array:
    across, behind, up = places.T
    end = np.isin(face, ("front", "rear"))
    light = np.select([face == "top", face == "hood", end], [1.12, 1.12, 0.9], 0.0)
    # A side mirrors the bright sky above and the dark road below.
    light = np.where(light > 0.0, light, 0.74 + 0.3 * np.clip(up / WAIST_M, 0.0, 1.0))
    colours = tinted(car.colour, light)
    lamps = end & (np.abs(across) > 0.5) & (up > 0.5) & (up < 0.66)
    colours[lamps & (face == "front")] = LAMP
    colours[lamps & (face == "rear")] = TAIL
    colours[end & (np.abs(across) < 0.4) & (up > 0.3) & (up < 0.45)] = DARK
    side = np.isin(face, ("side", "far side"))
    _detail_side(colours, side, behind, up)
    _put_wheels(colours, side, behind, up, roll_rad=car.front_y_m * car.heading / WHEEL_M)
    colours[end & (up < SILL_M)] = DARK
    colours[end & (up < CLEARANCE_M)] = UNDER
    return colours


def _detail_side(colours: Float32Array, side: BoolArray, behind: Float32Array, up: Float32Array) -> None:
    seam = np.min([np.abs(behind - place) for place in SEAMS_M], axis=0) < 0.012
    colours[side & seam & (up > SILL_M)] *= 0.55
    handle = np.min([np.abs(behind - place + 0.2) for place in SEAMS_M[1:]], axis=0) < 0.09
    colours[side & handle & (np.abs(up - 0.74) < 0.018)] = DARK
    colours[side & (behind < 0.42) & (np.abs(up - 0.6) < 0.07)] = LAMP
    colours[side & (behind > LENGTH_M - 0.4) & (np.abs(up - 0.68) < 0.1)] = TAIL
    colours[side & (up < SILL_M)] = DARK
    colours[side & (up < CLEARANCE_M)] = UNDER


def _put_wheels(
    colours: Float32Array, side: BoolArray, behind: Float32Array, up: Float32Array, roll_rad: float
) -> None:
    for axle in AXLES_BEHIND_FRONT_M:
        radius = np.hypot(behind - axle, up - WHEEL_M)
        spoke = np.cos(5.0 * (np.arctan2(up - WHEEL_M, behind - axle) + roll_rad)) > 0.1
        colours[side & (radius < ARCH_M)] = DARK
        colours[side & (radius < WHEEL_M)] = TYRE
        colours[side & (radius < RIM_M) & (spoke | (radius < 0.06))] = RIM


def _paint_cabin(car: Car, places: Float32Array, face: TextArray) -> Float32Array:
    across, behind, up = places.T
    height = up - np.float32(WAIST_M)
    colours = tinted(car.colour, np.where(face == "roof", 1.12, 1.0))
    ahead = behind - SCREEN_M[0] - _SCREEN_SLOPE * height
    left_over = REAR_WINDOW_M[1] - _REAR_SLOPE * height - behind
    inside = (height > 0.04) & (height < _CABIN_HEIGHT_M - 0.09)
    sides = np.isin(face, ("window", "far window")) & (ahead > 0.12) & (left_over > 0.18)
    panes = sides & (np.abs(behind - SEAMS_M[1]) > 0.06)
    ends = np.isin(face, ("screen", "rear window")) & (np.abs(across) < 0.68 - 0.2 * height)
    glass = inside & (panes | ends)
    colours[glass] = tinted(GLASS, 0.7 + 0.8 * height / _CABIN_HEIGHT_M)[glass]
    return colours
