"""Mean and scale of training inputs."""

import numpy as np

from worldstate.ground.typing import FloatArray


def standardisation(inputs: FloatArray, weights: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
    r"""Return weighted mean and standard deviation of each column; 1 where a column never changes.

    .. math:: \mu = \sum_i w_i x_i, \qquad \sigma^2 = \sum_i w_i (x_i - \mu)^2, \qquad \sum_i w_i = 1

    Shapes: inputs (n, columns), weights (n,), returns (columns,).

    Examples
    --------
    >>> standardisation(np.array([[1.0, 5.0], [3.0, 5.0]]))
    (array([2., 5.]), array([1., 1.]))
    """
    if weights is None:
        mean, deviation = inputs.mean(axis=0), inputs.std(axis=0)
    else:
        mean = np.average(inputs, axis=0, weights=weights)
        deviation = np.sqrt(np.average((inputs - mean) ** 2, axis=0, weights=weights))
    # A column that never changes carries nothing; leave it as it is.
    return mean, np.where(deviation > 10 * np.finfo(float).eps, deviation, 1.0)
