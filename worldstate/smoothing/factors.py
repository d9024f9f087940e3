"""Factors of the graph: motion, what is measured of an entity, line of sight past an edge.

All with a Python error function are made in one place, which checks their shapes.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np

from worldstate.belief.kinematics.cartesian import constant_velocity
from worldstate.belief.site_geometry import normal_share
from worldstate.ground import FloatArray, InvalidArgumentError, wrap_angle
from worldstate.measurement import Approach, Bearing, Position

from .geometry import azimuth, cartesian, closing_rate, in_ego_axes, log_range, reflected_place
from .observations import AngularHeight, EgoStep, PastEdge, Range, ReflectedBearing, SmoothingSettings

# gtsam itself has no types that mypy could read without 25,000 lines of stubs.
Factor: TypeAlias = Any
NoiseModel: TypeAlias = Any
# Error and its derivative by each variable, at their values: vectors, and poses as (x, y, heading).
Residual: TypeAlias = Callable[..., tuple[FloatArray, Sequence[FloatArray]]]

# The kind of a variable is the first byte of its key: entity, box height, ego pose, corner, wall.
ENTITY, HEIGHT, EGO, CORNER, WALL = "xhecw"
_SIZES = {ENTITY: 4, HEIGHT: 1, EGO: 3, CORNER: 2, WALL: 2}
_KIND_SHIFT = 56


def key_of(kind: str, number: int) -> int:
    """Return the key of a variable, as gtsam's `symbol` builds it."""
    return (ord(kind) << _KIND_SHIFT) | number


def kind_of(key: int) -> str:
    """Return the kind of a key's variable."""
    return chr(key >> _KIND_SHIFT)


def vector_factor(
    keys: Sequence[int], noise: NoiseModel, residual: Residual, start: Sequence[FloatArray]
) -> Factor:
    """Return a factor with an error function in Python, tried once at `start`.

    Raises
    ------
    InvalidArgumentError
        If error or Jacobians do not have the shapes that noise model and variables ask for.

    Examples
    --------
    >>> import gtsam
    >>> def error(x):
    ...     return x[:1] - 2.0, [np.eye(1, 4)]
    >>> noise = gtsam.noiseModel.Isotropic.Sigma(1, 0.5)
    >>> vector_factor([key_of("x", 0)], noise, error, [np.zeros(4)]).dim()
    1
    >>> vector_factor([key_of("x", 0)], noise, lambda x: (x[:2], [np.eye(2, 4)]), [np.zeros(4)])
    Traceback (most recent call last):
    ...
    worldstate.ground.errors.InvalidArgumentError: error: expected shape (1,), got (2,)
    """
    import gtsam

    rows, kinds = noise.dim(), [kind_of(key) for key in keys]
    shapes = [(rows, _SIZES[kind]) for kind in kinds]
    _check(residual(*start), rows, shapes)
    readers = [_READERS[kind] for kind in kinds]
    variables = list(zip(readers, keys, strict=True))

    def error(this: object, values: Any, jacobians: Any) -> FloatArray:
        # A Jacobian of another row count than the noise model's is written past its end by gtsam: checked
        # every time, since a shape may depend on the values.
        found = residual(*[read(values, key) for read, key in variables])
        _check(found, rows, shapes)
        if jacobians is not None:
            for i, slope in enumerate(found[1]):
                jacobians[i] = slope
        return found[0]

    return gtsam.CustomFactor(noise, list(keys), error)


def _check(
    found: tuple[FloatArray, Sequence[FloatArray]], rows: int, shapes: Sequence[tuple[int, int]]
) -> None:
    error, slopes = found
    if error.shape != (rows,):
        raise InvalidArgumentError(f"error: expected shape ({rows},), got {error.shape}")
    if [slope.shape for slope in slopes] != shapes:
        got = [slope.shape for slope in slopes]
        raise InvalidArgumentError(f"jacobians: expected shapes {shapes}, got {got}")


def _pose(values: Any, key: int) -> FloatArray:
    pose = values.atPose2(key)
    return np.array([pose.x(), pose.y(), pose.theta()])


def _vector(values: Any, key: int) -> FloatArray:
    return values.atVector(key)  # type: ignore[no-any-return]


def _point(values: Any, key: int) -> FloatArray:
    return values.atPoint2(key)  # type: ignore[no-any-return]


_READERS = {ENTITY: _vector, HEIGHT: _vector, WALL: _vector, CORNER: _point, EGO: _pose}


_PLANE = 2
_STANDING = np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class Node:
    """The state of an entity that an observation is of, and what else it depends on."""

    key: int
    state: FloatArray  # shape (4,): The present estimate
    anchor_m: FloatArray  # shape (2,)
    offset_s: float = 0.0  # From the state to the observation, at constant velocity
    ego_key: int | None = None  # None of an ego that stands in the anchor and looks along x
    pose: FloatArray | None = None  # shape (3,): The present estimate of (x, y, heading)
    ego_velocity_mps: tuple[float, float] = (0.0, 0.0)  # In the ego's axes

    @property
    def is_polar(self) -> bool:
        """Whether bearing, approach and range are components of the state itself."""
        return self.ego_key is None and self.offset_s == 0.0

    def seen(
        self, state: FloatArray, pose: FloatArray = _STANDING
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return (x, y, vx, vy) relative to the ego, and its derivatives by state and pose."""
        place, slope = self.placed(state)
        local, turn, by_pose = in_ego_axes(place, pose)
        local[2] -= self.ego_velocity_mps[0]
        local[3] -= self.ego_velocity_mps[1]
        return local, turn @ slope, by_pose

    def placed(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (x, y, vx, vy) in the map at the time of the observation, and its derivative."""
        place, slope = cartesian(state, self.anchor_m)
        if self.offset_s == 0.0:
            return place, slope
        flow = _flow(self.offset_s)
        return flow @ place, flow @ slope


@lru_cache(maxsize=256)
def noise_of(std: float | tuple[float, ...], huber_k: float | None = None) -> NoiseModel:
    """Return independent deviations, with a Huber loss where one is asked for."""
    import gtsam

    plain = gtsam.noiseModel.Diagonal.Sigmas(np.atleast_1d(np.asarray(std, np.float64)))
    return plain if huber_k is None else _robust(plain, huber_k)


def _robust(plain: NoiseModel, huber_k: float) -> NoiseModel:
    import gtsam

    loss = gtsam.noiseModel.mEstimator.Huber.Create(huber_k)
    return gtsam.noiseModel.Robust.Create(loss, plain)


@lru_cache(maxsize=64)
def motion_noise(settings: SmoothingSettings, step_s: float) -> NoiseModel:
    """Return the noise of (x, y, vx, vy) after a step of white acceleration."""
    import gtsam

    _, unit = constant_velocity(max(step_s, 1e-3))
    plain = gtsam.noiseModel.Gaussian.Covariance(settings.acceleration_psd * unit)
    if settings.manoeuvre_k is None:
        return plain
    # Redescending, as a mixture of keeping the pace and of manoeuvres is: hidden places are off by 1.54 m,
    # and by 1.85 m with Huber's loss, which grows on linearly.
    loss = gtsam.noiseModel.mEstimator.Cauchy.Create(settings.manoeuvre_k)
    return gtsam.noiseModel.Robust.Create(loss, plain)


def motion_factor(before: Node, after: Node, step_s: float, noise: NoiseModel) -> Factor:
    r"""Return constant velocity with white acceleration, metric noise over polar states.

    .. math:: e = c(x_{k+1}) - F\, c(x_k), \quad e \sim N(0, q\,Q(dt))
    """
    # In polar coordinates the noise is q / r^2 with a range that is guessed: hidden positions were off by
    # 1.28 m in place of 1.10 m, and their normalised squared error was 7.3 in place of 3.7 (ideal 4).
    flow, anchor_m = _flow(step_s), before.anchor_m

    def error(x: FloatArray, y: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        here, by_x = cartesian(x, anchor_m)
        there, by_y = cartesian(y, anchor_m)
        return there - flow @ here, [-flow @ by_x, by_y]

    return vector_factor([before.key, after.key], noise, error, [before.state, after.state])


@lru_cache(maxsize=64)
def _flow(step_s: float) -> FloatArray:
    return constant_velocity(step_s)[0]


def bearing_factor(node: Node, one: Bearing, settings: SmoothingSettings) -> Factor:
    """Return a measured azimuth."""
    if node.is_polar:
        # Of the turns that mean the same, that nearest to the estimate.
        near = node.state[0] + wrap_angle(one.azimuth_rad - float(node.state[0]))
        return _component(node, 0, near, one.std_rad, settings.robust_k)
    return _scalar(node, azimuth, one.azimuth_rad, one.std_rad, settings, angle=True)


def approach_factor(node: Node, one: Approach, settings: SmoothingSettings) -> Factor:
    """Return a measured approach rate."""
    if node.is_polar:
        return _component(node, 2, -one.inverse_tta_hz, one.std_hz, settings.robust_k)
    return _scalar(node, closing_rate, one.inverse_tta_hz, one.std_hz, settings)


def range_factor(node: Node, one: Range, settings: SmoothingSettings) -> Factor:
    """Return a measured distance, as its logarithm, which is a component of the state."""
    # As exp(log r) a sharp range on a wide prior threw the visible phase off by 1.7 m in place of .35 m.
    value, std = math.log(one.range_m), one.std_m / one.range_m
    if node.is_polar:
        return _component(node, 3, value, std, settings.robust_k)
    return _scalar(node, log_range, value, std, settings)


def position_factor(node: Node, one: Position) -> Factor:
    """Return a position, and a velocity over ground where that was measured, in the ego's axes."""
    import gtsam

    covariance = np.array(one.covariance)
    rows = len(covariance)
    measured = np.array([*one.position_m, *(one.velocity_mps or ())])

    def error(*values: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        place, slope = node.placed(values[0])
        local, turn, by_pose = in_ego_axes(place, values[1] if len(values) > 1 else _STANDING)
        slopes = [(turn @ slope)[:rows], by_pose[:rows]]
        return local[:rows] - measured, slopes[: len(values)]

    keys, values = _keys(node)
    return vector_factor(keys, gtsam.noiseModel.Gaussian.Covariance(covariance), error, values)


def height_factor(node: Node, height_key: int, one: AngularHeight, settings: SmoothingSettings) -> Factor:
    r"""Return the height of a box: :math:`\log\alpha = \log h - \log r` with the entity's own height h."""
    start, value = np.array([math.log(one.true_height_m)]), math.log(one.height_rad)

    def error(*values: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        local, by_state, by_pose = node.seen(*values[:-1])
        found, slope = log_range(local)
        slopes = [-slope @ by_state, -slope @ by_pose]
        return values[-1] - found - value, [*slopes[: len(values) - 1], np.eye(1)]

    keys, values = _keys(node)
    return vector_factor(
        [*keys, height_key], noise_of(one.relative_std, settings.robust_k), error, [*values, start]
    )


def reflected_factor(
    node: Node, wall_key: int, wall: FloatArray, one: ReflectedBearing, settings: SmoothingSettings
) -> Factor:
    """Return the azimuth of an entity's image in a wall, which is a variable of the graph."""

    def error(*values: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        place, slope = node.placed(values[0])
        image, by_place, by_wall = reflected_place(place, values[-1])
        local, turn, by_pose = in_ego_axes(image, values[1] if len(values) > _PLANE else _STANDING)
        found, toward = azimuth(local)
        slopes = [toward @ turn @ by_place @ slope, toward @ by_pose][: len(values) - 1]
        return np.array([wrap_angle(found - one.azimuth_rad)]), [*slopes, toward @ turn @ by_wall]

    keys, values = _keys(node)
    return vector_factor([*keys, wall_key], noise_of(one.std_rad, settings.robust_k), error, [*values, wall])


def edge_factor(
    node: Node, corner_key: int, corner_m: FloatArray, side: int, one: PastEdge, settings: SmoothingSettings
) -> Factor:
    r"""Return what a look says of an entity beside an occluder's edge.

    With u the azimuth beyond the edge over `edge_std_rad`, the probability of a detection is
    :math:`P = p_D \Phi(-u) + p_c\,(1 - \Phi(-u))`, and the error :math:`\sqrt{-2 \log P}` or
    :math:`\sqrt{-2 \log (1 - P)}`, up to a constant.
    """
    if not 0.0 < one.clutter_rate < one.detection_probability < 1.0:
        raise InvalidArgumentError(
            f"detection_probability: expected it between the clutter rate {one.clutter_rate} and 1, "
            f"got {one.detection_probability}"
        )

    def error(*values: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        beyond, slopes = beyond_edge(node, side, *values)
        found, by_u = _sight_error(beyond / settings.edge_std_rad, one)
        return np.array([found]), [by_u / settings.edge_std_rad * slope for slope in slopes]

    keys, values = _keys(node)
    return vector_factor([*keys, corner_key], noise_of(1.0), error, [*values, corner_m])


def beyond_edge(node: Node, side: int, *values: FloatArray) -> tuple[float, list[FloatArray]]:
    """Return by how much an entity is hidden beyond a corner's azimuth, rad, and the derivatives."""
    pose = values[1] if len(values) > _PLANE else _STANDING
    local, by_state, by_pose = node.seen(values[0], pose)
    corner = np.concatenate([values[-1], [0.0, 0.0]])
    edge, turn, edge_by_pose = in_ego_axes(corner, pose)
    (theta, toward), (at, to_edge) = azimuth(local), azimuth(edge)
    by_corner = -side * (to_edge @ turn)[:, :_PLANE]
    slopes = [side * toward @ by_state, side * (toward @ by_pose - to_edge @ edge_by_pose)]
    return side * wrap_angle(theta - at), [*slopes[: len(values) - 1], by_corner]


def _sight_error(u: float, one: PastEdge) -> tuple[float, float]:
    """Return the error of a look and its derivative by u."""
    in_sight, density = normal_share(-u), math.exp(-0.5 * u * u) / math.sqrt(2.0 * math.pi)
    gain = one.detection_probability - one.clutter_rate
    found = one.clutter_rate + gain * in_sight
    # Relative to the most likely case, so that the error is 0 where the look says nothing new.
    share, best = (found, one.detection_probability) if one.seen else (1.0 - found, 1.0 - one.clutter_rate)
    slope = -gain * density if one.seen else gain * density
    error = math.sqrt(max(-2.0 * math.log(share / best), 0.0))
    # At 0 the square root has no derivative, and the likelihood is flat there.
    return error, -slope / (share * error) if error > 1e-6 else 0.0


def odometry_factor(before: int, after: int, one: EgoStep) -> Factor:
    """Return the ego's motion between two updates."""
    import gtsam

    moved = gtsam.Pose2(one.ahead_m, one.left_m, one.turn_rad)
    return gtsam.BetweenFactorPose2(before, after, moved, noise_of(one.std))


def pose_prior(key: int, pose: FloatArray, std: tuple[float, ...]) -> Factor:
    """Return where the ego stands at first."""
    import gtsam

    return gtsam.PriorFactorPose2(key, gtsam.Pose2(*pose), noise_of(std))


def _component(node: Node, row: int, value: float, std: float, huber_k: float) -> Factor:
    """Return a measurement of one component: a prior of gtsam's own, at a tenth of a Python factor's cost."""
    import gtsam

    measured, precision = np.zeros(4), np.zeros(4)
    measured[row], precision[row] = value, 1.0 / std**2
    noise = _robust(gtsam.noiseModel.Diagonal.Precisions(precision), huber_k)
    return gtsam.PriorFactorVector(node.key, measured, noise)


def _scalar(
    node: Node,
    read: Callable[[FloatArray], tuple[float, FloatArray]],
    value: float,
    std: float,
    settings: SmoothingSettings,
    *,
    angle: bool = False,
) -> Factor:
    """Return a measurement of one number of an entity's place in the ego's axes."""

    def error(*values: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        local, by_state, by_pose = node.seen(*values)
        found, slope = read(local)
        off = wrap_angle(found - value) if angle else found - value
        return np.array([off]), [slope @ by_state, slope @ by_pose][: len(values)]

    keys, values = _keys(node)
    return vector_factor(keys, noise_of(std, settings.robust_k), error, values)


def _keys(node: Node) -> tuple[list[int], list[FloatArray]]:
    if node.ego_key is None or node.pose is None:
        return [node.key], [node.state]
    return [node.key, node.ego_key], [node.state, node.pose]


def prior_factor(key: int, mean: FloatArray, covariance: FloatArray) -> Any:
    """Return a Gaussian prior of a vector or a point."""
    import gtsam

    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    return gtsam.PriorFactorVector(key, mean, noise)
