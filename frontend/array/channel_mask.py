r"""Leave microphones out exactly, without new steering vectors.

A whitened channel that is set to zero adds nothing to a sum over microphones, so that the beams of the whole
array serve for any part of it. Only the scale changes: with n of M microphones, beam power is smaller by (n /
M)^2 and the sum over pairs by n (n - 1) / (M (M - 1)). Sums are scaled back per hop, so that a window may
hold hops with different masks.
"""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import BoolArray, Complex64Array


@dataclass(frozen=True, slots=True, eq=False)
class ChannelMask:
    """Microphones that are used."""

    keep: BoolArray  # shape (M,): False for those left out

    @classmethod
    def all_of(cls, n_channels: int) -> "ChannelMask":
        """Return the mask that keeps all microphones."""
        return cls(np.ones(n_channels, bool))

    @property
    def n_kept(self) -> int:
        """Number n of microphones kept."""
        return int(np.count_nonzero(self.keep))

    @property
    def is_whole(self) -> bool:
        """Whether all microphones are kept."""
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
        """Set the channels left out of spectra (..., M) to zero, in place."""
        if not self.is_whole:
            spectra[..., ~self.keep] = 0.0

    def cross(self, matrices: Complex64Array) -> Complex64Array:
        """Return cross-spectra ``R'_ij = k_i k_j R_ij``, (..., M, M); the same array if all are kept."""
        if self.is_whole:
            return matrices
        return np.asarray(matrices * (self.keep[:, None] & self.keep))
