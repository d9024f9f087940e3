"""Markov chains in continuous time: from rates to the transitions of a step."""

import numpy as np

from worldstate.ground.typing import FloatArray
from worldstate.ground.values import NANOSECONDS_PER_SECOND

# At any rate above .01/s a chain is in equilibrium by then; a larger exponent of expm only costs digits.
LONGEST_STEP_S = 1000.0


def transitions(rates_hz: FloatArray, step_ns: int) -> FloatArray:
    r"""Return exp(Q dt), read-only, rows sum to one; shapes (states, states).

    Examples
    --------
    >>> transitions(np.array([[-0.1, 0.1], [0.0, 0.0]]), 10**10).round(3)
    array([[0.368, 0.632],
           [0.   , 1.   ]])
    """
    # Imported where it is needed: scipy.linalg takes as long to import as numpy.
    from scipy.linalg import expm

    step_s = min(step_ns / NANOSECONDS_PER_SECOND, LONGEST_STEP_S)
    matrix: FloatArray = np.maximum(expm(rates_hz * step_s), 0.0)
    matrix /= matrix.sum(axis=1, keepdims=True)
    matrix.flags.writeable = False
    return matrix
