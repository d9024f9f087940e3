"""A check of complex samples and spectra, called once at the front-end's boundary."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import check_shape
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import ComplexArray


def finite_complex(name: str, value: ArrayLike, shape: Sequence[int | None]) -> ComplexArray:
    """Return `value` as finite complex numbers of the given shape, keeping single precision as it is.

    Examples
    --------
    >>> finite_complex("spectra", [[1, 1j]], (None, 2)).shape
    (1, 2)
    """
    array = np.asarray(value)
    if array.dtype.kind not in "biufc":
        raise InvalidArgumentError(f"{name}: expected numbers, got {array.dtype}")
    check_shape(name, array.shape, shape)
    if not np.isfinite(array).all():
        raise InvalidArgumentError(f"{name}: expected finite numbers, got NaN or infinity")
    single = array.dtype in (np.complex64, np.float32)
    return array.astype(np.complex64 if single else np.complex128, copy=False)
