"""The run of consecutive channels whose values differ from those of all others by one amount."""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import BoolArray, FloatArray

_FLAT = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Card:
    """Consecutive channels, such as those of one sound card, and the amount by which they differ."""

    channels: BoolArray  # shape (M,)
    amount: float
    sensitivity: float  # Length of its pattern, of which a tilt of all waves explains nothing


def untilted(positions_m: FloatArray, known: BoolArray) -> FloatArray:
    r"""Return the matrix that takes from values of channels what another direction of sound explains.

    .. math:: Q = I - X (X^T X)^+ X^T, \qquad X = [1, p]

    over the known channels, zero elsewhere. Shapes: positions_m (M, 3), known (M,), returns (M, M).
    """
    if not known.any():
        return np.zeros((len(known), len(known)))
    centred = (positions_m - positions_m[known].mean(axis=0)) * known[:, None]
    design = np.column_stack([known.astype(float), centred])
    basis, size, _ = np.linalg.svd(design, full_matrices=False)
    basis = basis[:, size > 1e-6 * max(float(size[0]), _FLAT)]
    return np.asarray(np.diag(known.astype(float)) - basis @ basis.T)


def runs(n_channels: int) -> FloatArray:
    """All runs of consecutive channels up to half of them, (R, M) of ones and zeros.

    Examples
    --------
    >>> runs(3)
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]])
    """
    index = np.arange(n_channels)
    found = [
        (index >= first) & (index < first + length)
        for length in range(1, n_channels // 2 + 1)
        # Of two halves only the later one: that the others differ from it is the same.
        for first in range(n_channels // 2 if 2 * length == n_channels else 0, n_channels - length + 1)
    ]
    return np.asarray(found, np.float64)


def best_card(values: FloatArray, projection: FloatArray, candidates: FloatArray) -> Card:
    r"""Return the run of channels that explains most of the projected values.

    .. math:: \hat c = \arg\max_c \frac{(c^T v)^2}{c^T Q c}, \qquad \hat a = \frac{c^T v}{c^T Q c}

    Shapes: values (M,), projection Q (M, M), candidates (R, M).
    """
    power = np.einsum("rm,mn,rn->r", candidates, projection, candidates, optimize=True)
    # A pattern that a tilt explains but for a twentieth would turn any noise into a large amount.
    power = np.where(power > 0.05 * candidates.sum(axis=1), power, np.inf)
    found = candidates @ values
    best = int((found**2 / power).argmax())
    return Card(candidates[best] > 0.0, float(found[best] / power[best]), float(np.sqrt(power[best])))
