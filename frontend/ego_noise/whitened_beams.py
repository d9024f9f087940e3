"""Beams for spectra that are whitened per bin."""

import numpy as np

from worldstate.frontend.array.steering import Steering
from worldstate.ground.typing import Complex64Array

_TINY = np.float32(1e-30)


class WhitenedBeams:
    r"""Beams for whitened spectra, updated bin by bin.

    With :math:`W = B C` of `Steering`, the weights for :math:`y = R^{-1/2} x` are
    :math:`\overline{R^{-1/2}} B C`, scaled to length :math:`\sqrt M` in every direction (M counts the
    microphones that are not dead).
    """

    def __init__(self, plain: Steering) -> None:
        self.plain = plain
        basis = None if plain.basis is None else plain.basis.copy()
        self.steering = Steering(basis, plain.weights.copy(), plain.conjugate.copy())

    def update(self, bin_index: int, root: Complex64Array) -> None:
        r"""Set the inverse root (M, M) of one bin.

        .. math:: w(\theta) = \sqrt M\, \frac{\overline{R^{-1/2}}\, \overline{a(\theta)}}
                  {\|R^{-1/2}\, a(\theta)\|}
        """
        plain, ours = self.plain, self.steering
        weights = plain.weights[bin_index]
        if plain.basis is None or ours.basis is None:
            weights = root.conj() @ weights
            gram = np.square(np.abs(weights)).sum(axis=0)
        else:
            basis = root.conj() @ plain.basis[bin_index]
            ours.basis[bin_index] = basis
            gram = (weights.conj() * ((basis.conj().T @ basis) @ weights)).real.sum(axis=0)
        alive = np.float32(np.count_nonzero(np.einsum("mm->m", root)))
        scaled = weights * np.sqrt(alive / np.maximum(gram, _TINY))
        ours.weights[bin_index], ours.conjugate[bin_index] = scaled, scaled.conj()
