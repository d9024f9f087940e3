r"""Sound that microphones have in common, and whether it can be that of far sources at their positions.

Wind, the noise of converters and samples read in a wrong format are independent between microphones; the
sound of a street is not. Over pairs and bins where a diffuse field has a coherence above 0.1,

.. math:: v = \frac{\sum_{ijk} \big( |S_{kij}|^2 - n_2 \big) - 3 n_2 \sqrt{2 N}}
          {n_1^2 \sum_{ijk} \Gamma_{kij}^2}, \qquad
          S \leftarrow 0.8\, S + \sum_t Z Z^H,

with the frames n_1 in S, the power n_2 that independent noise has in a pair, and N pairs and bins. The same
of every bin shows how much of the band such noise covers. Channels that are in another order, late or
inverted have as much in common; `FarField` compares that with the positions.
"""

from collections import deque

import numpy as np

from worldstate.frontend.array.microphone_array import SPEED_OF_SOUND_M_S, MicrophoneArray
from worldstate.ground import LEAST_HEARD, falling
from worldstate.ground.typing import BoolArray, Complex64Array, FloatArray, IntArray

from .geometry_check import diffuse_coherence

NOTHING_IN_COMMON = "no sound common to the microphones"
"""Why a hop of independent noise is not heard."""
OUT_OF_PLACE = "sound that contradicts the positions of the microphones"
"""Why a hop is not heard of channels in another order, late or inverted."""
ARRAY_FAULTS = NOTHING_IN_COMMON, OUT_OF_PLACE
"""Why nothing of an array is heard, whatever its single microphones are."""
# Pairs and bins of less coherence in a diffuse field add noise and little that is common.
_LEAST_COHERENCE = 0.1
# Microphones, evenly picked: 12 of 56 separate sound from noise as all of them do, in a tenth of the time.
_MOST_CHANNELS = 12
# Of the last half second: noise is found within it, and one hop of four microphones scatters too much.
_KEPT = np.float32(0.8)
# Power of a sum of T independent frames over T: neighbours share half a Hann window and correlate by 1/6.
_OVERLAP = 1.0 + 2.0 / 36.0
# Frames without which nothing is compared: after a loss the sums of what was before it fade for ever.
_LEAST_FRAMES = 1.0
# Standard deviations of noise that are taken off v: in the first hops it scatters most. Three of them,
# at nine frames a hop, may be no more than the least v of clean streets less the most that is unheard.
_SIGMAS, _FRAMES, _MOST_STD = 3.0, 9.0, 0.03
# Coherence over that of a diffuse field: of clean simulated streets of both renderers, 4 to 56 microphones,
# 0.09 and more in 99 of 100 hops (the emptiest, four microphones 0.3 to 0.9 m apart), of 4,202 hops of real
# ones 0.28 and more, of a quiet street under independent noise 10 dB louder 0.03 and less.
_IN_COMMON = (0.04, 0.1)
# The same of a bin, and share of the bins that have more, if as many decide: in clean streets 0.5 and more of
# the six lowest of 56 microphones, whose two lowest wind covers; in others 0.64 and more.
_IN_BIN, _BINS, _FEWEST_BINS = 0.04, (0.3, 0.5), 6
# Three hops: sound that is in common for less is the scatter of these shares.
_COVERED_HOPS = 3
# Misfit of a second: clean streets of both renderers, 11 arrays of 4 to 56, at most 0.32; channels in random
# orders mostly 0.7 to 1.3; a siren and its echoes, which last as long, 0.7 to 1 for seven seconds.
_MISFIT = 0.4
# What a second adds to the agreement, and its range: a right order fits again and again, and a siren makes a
# wrong one of none that has fitted for half as long; three seconds that fit make a wrong one right.
_VOTES, _AGREEMENT = (-0.5, 1.0), (-3.0, 20.0)
_EVERY_HOPS = 10


class CommonSound:
    """Compare the coherence of the microphones with that of far sources; memory does not grow."""

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
        """Go on with the pairs of some channels, (M,)."""
        chosen = self._used & kept[:, None] & kept
        self._kept, self._chosen = kept, chosen.astype(np.float32)
        self._count = count = chosen.sum(axis=(1, 2))
        self._diffuse = np.square(self._field * chosen).sum(axis=(1, 2))
        self._scatter = _SIGMAS * np.sqrt(2.0 * count), _SIGMAS * float(np.sqrt(2.0 * count.sum()))
        self._decides = bool(self.decides(count.sum(), self._diffuse.sum()))
        bins = self.decides(count, self._diffuse)
        self._bins = np.flatnonzero(bins) if np.count_nonzero(bins) >= _FEWEST_BINS else None

    def push(self, matrices: Complex64Array, n_frames: int, keep: BoolArray) -> tuple[float, str | None]:
        """Take the cross-spectra (K, M, M) of a hop and the microphones kept (M,); return what can be heard.

        That is a share, and why not more. Of too few microphones it is that of the hop before: independent
        noise looks like faults, too.
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
            self._compare_noise()
            if self._hops % _EVERY_HOPS == 0 and np.count_nonzero(kept) > 2:
                self._compare_places()
        share = min(self._common)
        if self._agreement < 0.0 and share >= LEAST_HEARD:
            return 0.0, OUT_OF_PLACE
        return share, NOTHING_IN_COMMON if share < 1.0 else None

    def _compare_noise(self) -> None:
        """Take the share that independent noise leaves, of the whole band and of its bins."""
        if not self._decides:
            return
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
        """Compare the coherence of the last half second with the positions of the channels that are kept."""
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
        """Return whether so many pairs, both orders counted, tell sound from noise, together or a bin."""
        shrink = float((1.0 - _KEPT) / (1.0 + _KEPT)) / _FRAMES
        return np.asarray(np.sqrt(2.0 * count) * shrink < _MOST_STD * diffuse)


# Variance of a coherence of independent noise over half a second, 19 frames a hop.
_CHANCE = 0.003
# Sources that sound in one bin alone: the others sound in all.
_ALONE = 0.1
# Standard deviations of noise that a random order leaves unexplained: with less, as in the long waves of a
# small board, nothing is known of the order.
_SURE = 8.0
# Pairs times bins; four bins of twelve microphones find as much as all of them.
_MOST_VALUES = 300


class FarField:
    r"""Compare coherences with what far sources can give at the positions of the microphones, (M, 3).

    Far from all sources the coherence r of a pair depends on its displacement d and the wave number k alone.
    Over all directions of a wave the real parts of two of them have the covariance C+, the imaginary ones C-,

    .. math:: C^\pm_{ab} = \tfrac12 \big( \mathrm{sinc} |k_a d_a - k_b d_b|
              \pm \mathrm{sinc} |k_a d_a + k_b d_b| \big), \qquad
              u(r) = \lambda\, r^T (C + \lambda I)^{-1} r - \frac{\lambda}{1/2 + \lambda}\, r^T r,

    and u is what that leaves unexplained, beyond what it would of pairs without any relation. The misfit is u
    over its mean over all orders of the channels: about 1 in a random order, 0 and less in the right one.

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
        """Take a coherence (K, M, M) and the power of independent noise in it; return the misfit if known."""
        pairs = coherence[self._bins][:, *self._pair].ravel()
        parts = np.stack([pairs.real, pairs.imag])[:, None, :, None]
        left = (parts * (self._both @ parts)).sum(axis=(0, 2, 3)) - noise * self._of_noise
        own, in_any_order = left.tolist()
        return own / in_any_order if in_any_order > _SURE * noise * self._std else None


def _in_any_order(weights: FloatArray, ends: FloatArray) -> FloatArray:
    """Mean of weights (KP, KP) over all orders of the microphones that are the ends of pairs, (P, M)."""
    # Two pairs are alike to all others that share as many microphones, and these with the same sign.
    shared, one = ends @ ends.T, np.eye(len(ends))
    groups = [one, shared - 2.0 * one] + ([(shared == 0.0).astype(float)] if (ends >= 0.0).all() else [])
    by_bins = weights.reshape(-1, len(ends), len(weights) // len(ends), len(ends))
    means = [np.einsum("kalb,ab->kl", by_bins, group) / max(np.square(group).sum(), 1.0) for group in groups]
    return np.asarray(sum(np.kron(mean, group) for mean, group in zip(means, groups, strict=True)))
