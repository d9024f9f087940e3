r"""Leaving microphones out, exactly and without new steering vectors.

A whitened channel that is set to zero adds nothing to a sum over microphones, so that the beams of the whole
array steer any part of it. What changes is the scale: with n of M microphones left, beam power is smaller by
(n / M)^2 and the sum over pairs by n (n - 1) / (M (M - 1)). Sums are scaled back when they are made, so that
windows may hold hops of different masks.
"""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import BoolArray, Complex64Array


@dataclass(frozen=True, slots=True, eq=False)
class ChannelMask:
    """Which microphones count.

    Examples
    --------
    >>> mask = ChannelMask(np.array([True, False, True, True]))
    >>> mask.n_kept, round(mask.power_scale, 3), mask.pair_scale
    (3, 1.778, 2.0)
    """

    keep: BoolArray  # shape (M,): False for those left out

    @classmethod
    def all_of(cls, n_channels: int) -> "ChannelMask":
        """Leave none out."""
        return cls(np.ones(n_channels, bool))

    @property
    def n_kept(self) -> int:
        """Number of microphones left."""
        return int(np.count_nonzero(self.keep))

    @property
    def is_whole(self) -> bool:
        """Whether all are left."""
        return bool(self.keep.all())

    @property
    def power_scale(self) -> float:
        """(M / n)^2: from the beam power of n microphones to that of M; finite for none."""
        return float((len(self.keep) / max(self.n_kept, 1)) ** 2)

    @property
    def pair_scale(self) -> float:
        """Ratio of the numbers of pairs; finite for fewer than two microphones."""
        whole, kept = len(self.keep), max(self.n_kept, 2)
        return whole * (whole - 1) / (kept * (kept - 1))

    def silence(self, spectra: Complex64Array) -> None:
        """Set the channels left out to zero in place, (..., M).

        Shapes: spectra (..., M).
        """
        # ``X_m = 0`` where microphone m does not count.
        if not self.is_whole:
            spectra[..., ~self.keep] = 0.0

    def cross(self, matrices: Complex64Array) -> Complex64Array:
        """Return cross-spectra (..., M, M) without the channels left out; the same array if there are none.

        Shapes: matrices (..., M, M).

        Examples
        --------
        >>> ChannelMask(np.array([True, False])).cross(np.ones((1, 2, 2), np.complex64))[0].real
        array([[1., 0.],
               [0., 0.]], dtype=float32)
        """
        # ``R'_ij = k_i k_j R_ij`` with k one for the channels kept and else zero.
        if self.is_whole:
            return matrices
        return np.asarray(matrices * (self.keep[:, None] & self.keep))
