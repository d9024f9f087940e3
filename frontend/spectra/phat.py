"""The phase transform: spectra of unit magnitude (C. Knapp and G. C. Carter, IEEE Trans. ASSP 24, 1976)."""

import numpy as np

from worldstate.ground.typing import Complex64Array, Float32Array

# Smallest power of a bin that is not silence: far below 24-bit quantisation, far above float32 underflow.
_POWER_FLOOR = np.float32(1e-30)


def power(spectra: Complex64Array) -> Float32Array:
    """Squared magnitude ``|X|^2 = (Re X)^2 + (Im X)^2``, without a square root, same shape.

    Examples
    --------
    >>> power(np.array([3 + 4j], np.complex64))
    array([25.], dtype=float32)
    """
    squared = np.square(spectra.real)
    squared += np.square(spectra.imag)
    return squared


def whiten(spectra: Complex64Array, powers: Float32Array | None = None) -> Complex64Array:
    r"""Phase transform :math:`Z = X / |X|`; bins without sound stay zero."""
    squared = power(spectra) if powers is None else powers
    weights = np.maximum(squared, _POWER_FLOOR)
    np.sqrt(weights, out=weights)
    np.reciprocal(weights, out=weights)
    return np.asarray(spectra * weights)
