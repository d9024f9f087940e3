"""The one place where factors with a Python error function are made, and their shapes checked."""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np

from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray

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
