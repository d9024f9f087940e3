"""Factors of the graph: motion, and measurements of an entity.

All factors with a Python error function are built in one place, which checks their shapes.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np

from worldstate.belief.kinematics.cartesian import constant_velocity
from worldstate.ground import FloatArray, InvalidArgumentError, wrap_angle
from worldstate.measurement import Approach, Bearing, Position

from .observations import AngularHeight, Range, SmoothingSettings, azimuth, cartesian, closing_rate, log_range

# Type stubs of gtsam for mypy would take 25,000 lines.
Factor: TypeAlias = Any
NoiseModel: TypeAlias = Any
# Error and its derivative with respect to each variable, at given values.
Residual: TypeAlias = Callable[..., tuple[FloatArray, Sequence[FloatArray]]]


def vector_factor(
    keys: Sequence[int], noise: NoiseModel, residual: Residual, start: Sequence[FloatArray]
) -> Factor:
    """Return a factor with a Python error function, which is tried once at `start`.

    Raises
    ------
    InvalidArgumentError
        If error or Jacobians do not have the shapes that the noise model and the variables require.

    Examples
    --------
    >>> import gtsam
    >>> def error(x):
    ...     return x[:1] - 2.0, [np.eye(1, 4)]
    >>> noise = gtsam.noiseModel.Isotropic.Sigma(1, 0.5)
    >>> vector_factor([0], noise, error, [np.zeros(4)]).dim()
    1
    >>> vector_factor([0], noise, lambda x: (x[:2], [np.eye(2, 4)]), [np.zeros(4)])
    Traceback (most recent call last):
    ...
    worldstate.ground.errors.InvalidArgumentError: error: expected shape (1,), got (2,)
    """
    import gtsam

    rows = noise.dim()
    shapes = [(rows, value.size) for value in start]
    _check(residual(*start), rows, shapes)

    def error(this: object, values: Any, jacobians: Any) -> FloatArray:
        # gtsam writes a Jacobian with a wrong number of rows past its end. The shape may depend on the
        # values, so it is checked every time.
        found = residual(*map(values.atVector, keys))
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


@dataclass(frozen=True, slots=True, eq=False)
class Node:
    """A state of an entity, with the time from the state to an observation."""

    key: int
    state: FloatArray  # shape (4,): The present estimate
    offset_s: float = 0.0  # Time from the state to the observation

    def placed(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (x, y, vx, vy) at the time of the observation, and its derivative."""
        place, slope = cartesian(state)
        if self.offset_s == 0.0:
            return place, slope
        flow = _flow(self.offset_s)
        return flow @ place, flow @ slope


@lru_cache(maxsize=256)
def noise_of(std: float, huber_k: float) -> NoiseModel:
    """Return a noise model with a standard deviation and a Huber loss."""
    import gtsam

    return _robust(gtsam.noiseModel.Diagonal.Sigmas(np.array([std])), huber_k)


def _robust(plain: NoiseModel, huber_k: float) -> NoiseModel:
    import gtsam

    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(huber_k), plain)


@lru_cache(maxsize=64)
def motion_noise(settings: SmoothingSettings, step_s: float) -> NoiseModel:
    """Return the noise of (x, y, vx, vy) for a step of white acceleration."""
    import gtsam

    _, unit = constant_velocity(max(step_s, 1e-3))
    plain = gtsam.noiseModel.Gaussian.Covariance(settings.acceleration_psd * unit)
    if settings.manoeuvre_k is None:
        return plain
    # A redescending loss fits a mixture of constant pace and manoeuvres: the error of hidden positions is
    # 1.54 m. With Huber's loss, which grows linearly, it is 1.85 m.
    loss = gtsam.noiseModel.mEstimator.Cauchy.Create(settings.manoeuvre_k)
    return gtsam.noiseModel.Robust.Create(loss, plain)


def motion_factor(before: Node, after: Node, step_s: float, noise: NoiseModel) -> Factor:
    r"""Return the factor of constant velocity with white acceleration, as metric noise on polar states.

    .. math:: e = c(x_{k+1}) - F\, c(x_k), \quad e \sim N(0, q\,Q(dt))
    """
    # In polar coordinates the noise would be q / r^2 with a guessed range: the error of hidden positions was
    # 1.28 m (now 1.10 m), and their normalised squared error was 7.3 (now 3.7, ideal 4).
    flow = _flow(step_s)

    def error(x: FloatArray, y: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        here, by_x = cartesian(x)
        there, by_y = cartesian(y)
        return there - flow @ here, [-flow @ by_x, by_y]

    return vector_factor([before.key, after.key], noise, error, [before.state, after.state])


@lru_cache(maxsize=64)
def _flow(step_s: float) -> FloatArray:
    return constant_velocity(step_s)[0]


def bearing_factor(node: Node, one: Bearing, settings: SmoothingSettings) -> Factor:
    """Return the factor of a measured azimuth."""
    # The equivalent angle nearest to the estimate is used.
    near = node.state[0] + wrap_angle(one.azimuth_rad - float(node.state[0]))
    return _scalar(node, (0, near), azimuth, one.azimuth_rad, one.std_rad, settings, angle=True)


def approach_factor(node: Node, one: Approach, settings: SmoothingSettings) -> Factor:
    """Return the factor of a measured approach rate."""
    return _scalar(node, (2, -one.inverse_tta_hz), closing_rate, one.inverse_tta_hz, one.std_hz, settings)


def range_factor(node: Node, one: Range, settings: SmoothingSettings) -> Factor:
    """Return the factor of a measured distance, as its logarithm, which is a component of the state."""
    # As a factor of exp(log r), a precise range with a wide prior moved positions in view by 1.7 m (now 0.35
    # m).
    value = math.log(one.range_m)
    return _scalar(node, (3, value), log_range, value, one.std_m / one.range_m, settings)


def position_factor(node: Node, one: Position) -> Factor:
    """Return the factor of a position, and of a velocity over ground if it was measured."""
    import gtsam

    covariance = np.array(one.covariance)
    rows = len(covariance)
    measured = np.array([*one.position_m, *(one.velocity_mps or ())])

    def error(state: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        place, slope = node.placed(state)
        return place[:rows] - measured, [slope[:rows]]

    return vector_factor([node.key], gtsam.noiseModel.Gaussian.Covariance(covariance), error, [node.state])


def height_factor(node: Node, height_key: int, one: AngularHeight, settings: SmoothingSettings) -> Factor:
    r"""Return the factor of a box height, :math:`\log\alpha = \log h - \log r` with the entity's height h."""
    start, value = np.array([math.log(one.true_height_m)]), math.log(one.height_rad)

    def error(state: FloatArray, log_m: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        place, by_state = node.placed(state)
        found, slope = log_range(place)
        return log_m - found - value, [-slope @ by_state, np.eye(1)]

    noise = noise_of(one.relative_std, settings.robust_k)
    return vector_factor([node.key, height_key], noise, error, [node.state, start])


def _scalar(
    node: Node,
    component: tuple[int, float],
    read: Callable[[FloatArray], tuple[float, FloatArray]],
    value: float,
    std: float,
    settings: SmoothingSettings,
    *,
    angle: bool = False,
) -> Factor:
    """Return the factor of one measured number; without an offset it is a component of the state."""
    if node.offset_s == 0.0:
        import gtsam

        # A gtsam prior takes a tenth of the time of a Python factor.
        measured, precision = np.zeros(4), np.zeros(4)
        measured[component[0]], precision[component[0]] = component[1], 1.0 / std**2
        noise = _robust(gtsam.noiseModel.Diagonal.Precisions(precision), settings.robust_k)
        return gtsam.PriorFactorVector(node.key, measured, noise)

    def error(state: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        place, by_state = node.placed(state)
        found, slope = read(place)
        off = wrap_angle(found - value) if angle else found - value
        return np.array([off]), [slope @ by_state]

    return vector_factor([node.key], noise_of(std, settings.robust_k), error, [node.state])


def prior_factor(key: int, mean: FloatArray, covariance: FloatArray) -> Factor:
    """Return a Gaussian prior factor of a variable."""
    import gtsam

    return gtsam.PriorFactorVector(key, mean, gtsam.noiseModel.Gaussian.Covariance(covariance))
