r"""Sigmoid of a decision value, fitted as in Lin, Lin and Weng's note on Platt's method.

.. math:: p(f) = 1 / (1 + \exp(A f + B))

Source: Lin, Lin, Weng, "A note on Platt's probabilistic outputs for support vector machines", 2007.
"""

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray

# As in the note's pseudocode; the tolerance is finer, for values are scaled to one first.
_ITERATIONS = 100
_SMALLEST_STEP = 1e-10
_GRADIENT_TOLERANCE = 1e-6
_RIDGE = 1e-12


def sigmoid(value: FloatArray, slope: ArrayLike, offset: ArrayLike) -> FloatArray:
    r"""Return a falling or rising sigmoid without overflow, broadcast.

    .. math:: p(f) = 1 / (1 + \exp(A f + B))

    Examples
    --------
    >>> sigmoid(np.array([0.0, 1e6]), -1.0, 0.0)
    array([0.5, 1. ])
    """
    exponent: FloatArray = np.asarray(slope) * value + np.asarray(offset)
    return np.asarray(np.exp(-np.logaddexp(0.0, exponent)))


def fit_sigmoid(values: ArrayLike, positive: ArrayLike) -> tuple[float, float]:
    r"""Return (A, B) of greatest likelihood, with the targets drawn in by Platt's prior.

    .. math:: \hat A, \hat B = \arg\min_{A, B} -\sum_i \big[ t_i \ln p(f_i) + (1 - t_i) \ln(1 - p(f_i)) \big],
              \qquad t_+ = \frac{n_+ + 1}{n_+ + 2}, \quad t_- = \frac{1}{n_- + 2}

    Shapes: values (n,), positive (n,).
    """
    decision = finite_array("values", values, (None,))
    label = finite_array("positive", positive, decision.shape) > 0.5
    if not decision.size:
        raise InvalidArgumentError("values: expected at least one decision value")
    n_positive, n_negative = int(label.sum()), int((~label).sum())
    target = np.where(label, (n_positive + 1) / (n_positive + 2), 1 / (n_negative + 2))
    # In units of the largest value, so that the tolerance means the same at every scale.
    unit = float(np.abs(decision).max()) or 1.0
    slope, offset = _newton(decision / unit, target, np.log((n_negative + 1) / (n_positive + 1)))
    return slope / unit, offset


def _newton(decision: FloatArray, target: FloatArray, offset: float) -> tuple[float, float]:
    point = np.array([0.0, offset])
    loss = _loss(decision, target, point)
    for _ in range(_ITERATIONS):
        gradient, curvature = _derivatives(decision, target, point)
        if np.abs(gradient).max() < _GRADIENT_TOLERANCE:
            break
        step = -np.linalg.solve(curvature, gradient)
        while np.abs(step).max() >= _SMALLEST_STEP:
            if _loss(decision, target, point + step) < loss + 1e-4 * float(gradient @ step):
                break
            step = step / 2.0
        else:
            break
        point = point + step
        loss = _loss(decision, target, point)
    return float(point[0]), float(point[1])


def _loss(decision: FloatArray, target: FloatArray, point: FloatArray) -> float:
    exponent = point[0] * decision + point[1]
    return float(np.sum(np.logaddexp(0.0, exponent) - (1.0 - target) * exponent))


def _derivatives(
    decision: FloatArray, target: FloatArray, point: FloatArray
) -> tuple[FloatArray, FloatArray]:
    probability = sigmoid(decision, point[0], point[1])
    design = np.stack([decision, np.ones_like(decision)])
    gradient = design @ (target - probability)
    curvature = (design * (probability * (1.0 - probability))) @ design.T
    return gradient, curvature + _RIDGE * np.eye(2)
