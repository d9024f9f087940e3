"""Mean and scale of training inputs."""

import numpy as np

from worldstate.ground.typing import FloatArray


def standardisation(inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
    r"""Return mean and standard deviation of each column; 1 where a column never changes.

    .. math:: \mu = \frac1n \sum_i x_i, \qquad \sigma^2 = \frac1n \sum_i (x_i - \mu)^2

    Shapes: inputs (n, columns), returns (columns,).

    Examples
    --------
    >>> standardisation(np.array([[1.0, 5.0], [3.0, 5.0]]))
    (array([2., 5.]), array([1., 1.]))
    """
    deviation = inputs.std(axis=0)
    # A column that never changes carries nothing; leave it as it is.
    return inputs.mean(axis=0), np.where(deviation > 10 * np.finfo(float).eps, deviation, 1.0)
