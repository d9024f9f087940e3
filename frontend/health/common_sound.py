r"""Share of the sound that microphones have in common, against that of a diffuse field, hop by hop.

Wind, the noise of converters and samples read in a wrong format are independent between microphones; the
sound of a street is not. Over pairs and bins where a diffuse field has a coherence above 0.1,

.. math:: v = \frac{\sum_{ijk} \big( |S_{kij}|^2 - n_2 \big) - 3 n_2 \sqrt{2 N}}
          {n_1^2 \sum_{ijk} \Gamma_{kij}^2}, \qquad
          S \leftarrow 0.8\, S + \sum_t Z Z^H,

with the frames n_1 in S, the power n_2 that independent noise has in a pair, and N pairs and bins.
"""

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import BoolArray, Complex64Array, FloatArray

from .geometry_check import diffuse_coherence

NOTHING_IN_COMMON = "no sound common to the microphones"
"""Why a hop of independent noise is not heard."""
# Pairs and bins of less coherence in a diffuse field add noise and little that is common.
_LEAST_COHERENCE = 0.1
# Microphones, evenly picked: 14 of 56 separate sound from noise as all of them do, in a tenth of the time.
_MOST_CHANNELS = 16
# Of the last half second: noise is found within it, and one hop of four microphones scatters too much.
_KEPT = np.float32(0.8)
# Power of a sum of T independent frames over T: neighbours share half a Hann window and correlate by 1/6.
_OVERLAP = 1.0 + 2.0 / 36.0
# Standard deviations of noise that are taken off v: in the first hops it scatters most. Three of them,
# at nine frames a hop, may be no more than the least v of clean streets less the most that is unheard.
_SIGMAS, _FRAMES, _MOST_STD = 3.0, 9.0, 0.03


class CommonSound:
    """Compare the coherence of the microphones with that of a diffuse field; memory does not grow."""

    def __init__(self, array: MicrophoneArray, frequencies_hz: FloatArray) -> None:
        n = array.n_microphones
        self._picked = slice(None, None, -(-n // _MOST_CHANNELS))
        places = array.positions_m[self._picked]
        field = diffuse_coherence(places, frequencies_hz)
        used = (np.abs(field) > _LEAST_COHERENCE) & ~np.eye(len(places), dtype=bool)
        self._used = used.astype(np.float32)
        self._count, self._diffuse = used.sum(axis=0), np.square(field * used).sum(axis=0)
        self._sum = np.zeros(field.shape, np.complex64)
        self._n_frames, self._noise = 0.0, 0.0
        self._common: float | None = None

    def push(self, matrices: Complex64Array, n_frames: int, keep: BoolArray) -> float | None:
        """Take the cross-spectra (K, M, M) of a hop, microphones kept (M,); return v, None if undecided.

        Where too few pairs are kept it is that of the hop before: independent noise looks like faults, too.
        """
        self._sum *= _KEPT
        self._sum += matrices[:, self._picked, self._picked]
        self._n_frames = float(_KEPT) * self._n_frames + n_frames
        self._noise = float(_KEPT) ** 2 * self._noise + _OVERLAP * n_frames
        kept = keep[self._picked]
        pairs = kept[:, None] & kept
        count, diffuse = float(self._count[pairs].sum()), float(self._diffuse[pairs].sum())
        if not self.decides(count, diffuse) or not self._n_frames:
            return self._common
        power = np.square(self._sum.real) + np.square(self._sum.imag)
        noise = self._noise * (count + _SIGMAS * np.sqrt(2.0 * count))
        common = float((power * self._used).sum(axis=0)[pairs].sum()) - noise
        self._common = float(common / (self._n_frames**2 * diffuse))
        return self._common

    @staticmethod
    def decides(count: float, diffuse: float) -> bool:
        """Return whether so many pairs and bins, both orders counted, tell sound from noise."""
        shrink = float((1.0 - _KEPT) / (1.0 + _KEPT)) / _FRAMES
        return diffuse > 0.0 and np.sqrt(2.0 * count) * shrink < _MOST_STD * diffuse
