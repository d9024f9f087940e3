r"""Test for sound that is common to the microphones and agrees with their positions and far sources.

Wind, converter noise and samples in a wrong format are independent between microphones, but the sound of a
street is not. Over pairs and bins with a coherence above 0.1 in a diffuse field,

.. math:: v = \frac{\sum_{ijk} \big( |S_{kij}|^2 - n_2 \big) - 3 n_2 \sqrt{2 N}}
          {n_1^2 \sum_{ijk} \Gamma_{kij}^2}, \qquad
          S \leftarrow 0.8\, S + \sum_t Z Z^H,

with the number of frames n_1 in S, the power n_2 of independent noise in a pair, and N pairs and bins. The
same statistic per bin gives the share of the band that such noise covers. Channels that are permuted, late or
inverted have as much in common, so `FarField` compares their sound with the positions.
"""

from collections import deque

import numpy as np

from worldstate.frontend.array.microphone_array import SPEED_OF_SOUND_M_S, MicrophoneArray
from worldstate.ground import LEAST_HEARD, falling
from worldstate.ground.typing import BoolArray, Complex64Array, FloatArray, IntArray

from .geometry_check import diffuse_coherence

NOTHING_IN_COMMON = "no sound common to the microphones"
"""Reason for an unusable hop with independent noise."""
OUT_OF_PLACE = "sound that contradicts the positions of the microphones"
"""Reason for an unusable hop with permuted, late or inverted channels."""
ARRAY_FAULTS = NOTHING_IN_COMMON, OUT_OF_PLACE
"""Reasons for which the whole array is unusable, even if each microphone works."""
# Pairs and bins with less coherence in a diffuse field add mainly noise.
_LEAST_COHERENCE = 0.1
# Number of microphones, evenly spaced: 12 of 56 separate sound from noise as well as all, ten times faster.
_MOST_CHANNELS = 12
# Weight of earlier hops, about half a second, because a single hop of four microphones varies too much.
_KEPT = np.float32(0.8)
# Power of a sum of T independent frames divided by T: neighbours share half a Hann window (correlation 1/6).
_OVERLAP = 1.0 + 2.0 / 36.0
# Fewest frames for a comparison: after a loss of sound, the sums of earlier frames never reach zero.
_LEAST_FRAMES = 1.0
# Three standard deviations of noise are subtracted from v, which varies most in the first hops. At nine
# frames per hop, they may be at most the minimum v of clean streets minus the maximum v of unusable ones.
_SIGMAS, _FRAMES, _MOST_STD = 3.0, 9.0, 0.03
# Coherence relative to a diffuse field. Clean simulated streets of both renderers with 4 to 56 microphones
# have at least 0.09 in 99 % of the hops (lowest for four microphones 0.3 to 0.9 m apart), 4,202 hops of real
# streets at least 0.28, and a quiet street under independent noise 10 dB louder at most 0.03.
_IN_COMMON = (0.04, 0.1)
# The same for a bin, limits for the share of bins above it, and the fewest bins. In clean streets, 0.5 or
# more of the six lowest bins are above it with 56 microphones, whose two lowest are covered by wind; with
# other arrays 0.64 or more.
_IN_BIN, _BINS, _FEWEST_BINS = 0.04, (0.3, 0.5), 6
# Three hops: a shorter change is random variation.
_COVERED_HOPS = 3
# Misfit of a second: at most 0.32 in clean streets of both renderers with 11 arrays of 4 to 56 microphones;
# mostly 0.7 to 1.3 for channels in random orders; 0.7 to 1 during seven seconds of a siren with equally long
# echoes.
_MISFIT = 0.4
# Change of the agreement per second, and its range. In the right order, a siren makes the agreement negative
# only if it lasts twice as long as the sound that fitted before; three fitting seconds make it positive
# again.
_VOTES, _AGREEMENT = (-0.5, 1.0), (-3.0, 20.0)
_EVERY_HOPS = 10


class CommonSound:
    """Compares the coherence of the microphones with that of far sources; memory is bounded."""

    def __init__(self, array: MicrophoneArray, frequencies_hz: FloatArray) -> None:
        self._picked = slice(None, None, -(-array.n_microphones // _MOST_CHANNELS))
        self._places, self._frequencies_hz = array.positions_m[self._picked], frequencies_hz
        self._field = diffuse_coherence(self._places, frequencies_hz)
        self._used = (np.abs(self._field) > _LEAST_COHERENCE) & ~np.eye(len(self._places), dtype=bool)
        self._sum = np.zeros(self._field.shape, np.complex64)
        self._n_frames, self._noise, self._hops = 0.0, 0.0, 0
        self._far_field: FarField | None = None
        self._common: deque[float] = deque([1.0], maxlen=_COVERED_HOPS)
        self._agreement = 0.0
        self._placed = np.ones(len(self._places), bool)
        self._choose(self._placed)

    def _choose(self, kept: BoolArray) -> None:
        """Use the pairs of these channels, (M,), from now on."""
        chosen = self._used & kept[:, None] & kept
        self._kept, self._chosen = kept, chosen.astype(np.float32)
        self._count = count = chosen.sum(axis=(1, 2))
        self._diffuse = np.square(self._field * chosen).sum(axis=(1, 2))
        self._scatter = _SIGMAS * np.sqrt(2.0 * count), _SIGMAS * float(np.sqrt(2.0 * count.sum()))
        self._decides = bool(self.decides(count.sum(), self._diffuse.sum()))
        bins = self.decides(count, self._diffuse)
        self._bins = np.flatnonzero(bins) if np.count_nonzero(bins) >= _FEWEST_BINS else None

    def push(self, matrices: Complex64Array, n_frames: int, keep: BoolArray) -> tuple[float, str | None]:
        """Process the cross-spectra (K, M, M) of a hop; `keep` are the usable microphones, (M,).

        Return the share of usable sound and the reason if it is below 1. With too few microphones the share
        of the last hop is returned, because independent noise also looks like faults.
        """
        self._sum *= _KEPT
        self._sum += matrices[:, self._picked, self._picked]
        self._n_frames = float(_KEPT) * self._n_frames + n_frames
        self._noise = float(_KEPT) ** 2 * self._noise + _OVERLAP * n_frames
        self._hops += 1
        kept = keep[self._picked]
        if not np.array_equal(kept, self._kept):
            self._choose(kept)
        if self._n_frames > _LEAST_FRAMES:
            if self._decides:
                self._compare_noise()
            if self._hops % _EVERY_HOPS == 0 and np.count_nonzero(kept) > 2:
                self._compare_places()
        share = min(self._common)
        if self._agreement < 0.0 and share >= LEAST_HEARD:
            return 0.0, OUT_OF_PLACE
        return share, NOTHING_IN_COMMON if share < 1.0 else None

    def _compare_noise(self) -> None:
        """Store the share of sound without independent noise, from the whole band and from its bins."""
        noise, (scatter, scatter_of_all) = self._noise / self._n_frames**2, self._scatter
        power = np.square(self._sum.real) + np.square(self._sum.imag)
        power *= self._chosen
        excess = power.sum(axis=(1, 2)) / self._n_frames**2 - noise * self._count
        whole = float(excess.sum() - noise * scatter_of_all) / float(self._diffuse.sum())
        covered = falling(whole, _IN_COMMON)
        if self._bins is not None:
            in_common = (excess - noise * scatter > _IN_BIN * self._diffuse)[self._bins]
            covered = max(covered, falling(np.count_nonzero(in_common) / len(in_common), _BINS))
        self._common.append(1.0 - covered)

    def _compare_places(self) -> None:
        """Compare the coherence of the last half second with the positions of the kept channels."""
        kept = self._kept
        if self._far_field is None or not np.array_equal(kept, self._placed):
            self._placed, self._far_field = kept, FarField(self._places[kept], self._frequencies_hz)
        coherence = self._sum[:, kept][:, :, kept] / np.float32(self._n_frames)
        misfit = self._far_field.misfit(coherence, self._noise / self._n_frames**2)
        if misfit is not None:
            vote = float(np.clip(1.0 - misfit / _MISFIT, *_VOTES))
            self._agreement = float(np.clip(self._agreement + vote, *_AGREEMENT))

    @staticmethod
    def decides(count: IntArray, diffuse: FloatArray) -> BoolArray:
        """Return whether this number of ordered pairs is enough to separate sound from noise."""
        shrink = float((1.0 - _KEPT) / (1.0 + _KEPT)) / _FRAMES
        return np.asarray(np.sqrt(2.0 * count) * shrink < _MOST_STD * diffuse)


# Variance of a coherence of independent noise over half a second, 19 frames per hop.
_CHANCE = 0.003
# Share of the energy from sources in one bin only; the other sources cover all bins.
_ALONE = 0.1
# Standard deviations of noise that a random order must leave unexplained. With less, for example at the long
# waves of a small board, the order cannot be determined.
_SURE = 8.0
# Pairs times bins; four bins of twelve microphones are as sensitive as all bins.
_MOST_VALUES = 300


class FarField:
    r"""Comparison of coherences with those of far sources at the positions of the microphones, (M, 3).

    Far from all sources, the coherence r of a pair depends only on its displacement d and the wave number k.
    Over all directions of a wave, the real parts of two pairs have covariance C+, the imaginary parts C-,

    .. math:: C^\pm_{ab} = \tfrac12 \big( \mathrm{sinc} |k_a d_a - k_b d_b|
              \pm \mathrm{sinc} |k_a d_a + k_b d_b| \big), \qquad
              u(r) = \lambda\, r^T (C + \lambda I)^{-1} r - \frac{\lambda}{1/2 + \lambda}\, r^T r,

    where u is the unexplained part minus that of unrelated pairs. The misfit is u divided by its mean over
    all orders of the channels: about 1 in a random order, and 0 or less in the right one.

    References
    ----------
    C. Rasmussen and C. Williams, Gaussian Processes for Machine Learning, 2006, section 2.2; R. Cook et al.,
    J. Acoust. Soc. Am. 27, 1955.
    """

    def __init__(self, positions_m: FloatArray, frequencies_hz: FloatArray) -> None:
        self._pair = i, j = np.triu_indices(len(positions_m), 1)
        first, second = np.eye(len(positions_m))[i], np.eye(len(positions_m))[j]
        n, most = len(i), len(frequencies_hz)
        self._bins = np.arange(most)[:: -max(-(-most * n // _MOST_VALUES), 1)]
        waves = 2.0 * frequencies_hz[self._bins] / SPEED_OF_SOUND_M_S
        places = np.kron(waves[:, None], (first - second) @ positions_m)
        same_bin = np.kron(np.eye(len(waves)), np.ones((n, n)))
        one, unrelated = np.eye(len(places)), _CHANCE / (0.5 + _CHANCE)
        less, more = (np.sinc(np.linalg.norm(places[:, None] - s * places, axis=-1)) for s in (1, -1))
        both = []
        for sign in (1.0, -1.0):
            covariance = 0.5 * (less + sign * more) * (1.0 - _ALONE + _ALONE * same_bin)
            weights = _CHANCE * np.linalg.inv(covariance + _CHANCE * one)
            both.append([weights, _in_any_order(weights, first + sign * second)])
        self._both = np.array(both) - unrelated * one
        self._of_noise = 0.5 * np.einsum("poaa->o", self._both)
        self._std = float(np.sqrt(0.5 * np.square(self._both[:, 0]).sum()))
        self._both = self._both.astype(np.float32)

    def misfit(self, coherence: Complex64Array, noise: float) -> float | None:
        """Return the misfit of a coherence (K, M, M) with a power of independent noise; None if unknown."""
        pairs = coherence[self._bins][:, *self._pair].ravel()
        parts = np.stack([pairs.real, pairs.imag])[:, None, :, None]
        left = (parts * (self._both @ parts)).sum(axis=(0, 2, 3)) - noise * self._of_noise
        own, in_any_order = left.tolist()
        return own / in_any_order if in_any_order > _SURE * noise * self._std else None


def _in_any_order(weights: FloatArray, ends: FloatArray) -> FloatArray:
    """Return the mean of weights (KP, KP) over all microphone orders; `ends` are those of pairs, (P, M)."""
    # The mean depends only on the number of microphones that two pairs share, and on the sign.
    shared, one = ends @ ends.T, np.eye(len(ends))
    groups = [one, shared - 2.0 * one] + ([(shared == 0.0).astype(float)] if (ends >= 0.0).all() else [])
    by_bins = weights.reshape(-1, len(ends), len(weights) // len(ends), len(ends))
    means = [np.einsum("kalb,ab->kl", by_bins, group) / max(np.square(group).sum(), 1.0) for group in groups]
    return np.asarray(sum(np.kron(mean, group) for mean, group in zip(means, groups, strict=True)))
