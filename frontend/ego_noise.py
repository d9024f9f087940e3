r"""Ego-noise: a noise covariance learned while no source is likely, and the spectra it whitens.

.. math:: \hat R_k \leftarrow \frac{\lambda^{w} W \hat R_k + w \sum_t \tilde x_{t,k} \tilde x_{t,k}^H}
          {\lambda^{w} W + w T}, \qquad \tilde x = \sqrt{M}\, x / \|x\|

over the T frames of a hop that is learned with weight w; W is the weight so far. Frames count by their
direction in microphone space, not by their level, so that one loud moment does not decide and the level may
follow the speed. Only what is learned makes forget: a closed gate keeps what is known.

The gate is the caller's: `EgoNoise.weight`, the probability that no source is there. A hop is learned only
after the next `guard_hops` hops have passed, with the least weight of all these, so that a source is not
learned in the moments before anybody believes in it.

Sources: the references of `prewhitening`; unit-length snapshots as in D. E. Tyler, "Statistical analysis for
the angular central Gaussian distribution on the sphere", 1987; guard cells as in any detector of constant
false-alarm rate.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldstate.checks import in_range
from worldstate.errors import InvalidArgumentError

from .harmonic_cancellation import HarmonicCanceller
from .phat import whiten
from .prewhitening import shrunk_inverse_root, white_share
from .steering import Steering, cross_spectra

_TINY = np.float32(1e-30)


@dataclass(frozen=True, slots=True)
class EgoNoiseSettings:
    """How ego-noise is learned and how far it is suppressed.

    Parameters
    ----------
    forgetting_s : float
        Time constant of what is learned, seconds of learning time.
    guard_hops : int
        A hop is learned so many hops late, with the least weight since.
    min_weight : float
        Hops of a lower weight are not learned at all: a source of some likelihood must not leak in.
    min_shrinkage : float
        Least shrinkage towards white noise, in (0, 1]: no direction is amplified by more than its inverse
        root.
    refresh_hops : int
        Every so many hops the whitening of one bin, in turn, is brought up to date; every hop until all
        bins have been. It costs an M x M eigendecomposition.
    harmonics : int
        Lines of the engine that are cancelled before, once `FrontEnd.follow_engine` says its speed.
    feature : bool
        Compute the published feature from prewhitened sound too. Off, because its classifier was trained
        without.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> EgoNoiseSettings(forgetting_s=5.0).guard_hops
    5
    """

    forgetting_s: float = 10.0
    guard_hops: int = 5
    min_weight: float = 0.5
    min_shrinkage: float = 0.03
    refresh_hops: int = 4
    harmonics: int = 40
    feature: bool = False

    def __post_init__(self) -> None:
        in_range("forgetting_s", self.forgetting_s, 0.1, 1e5)
        in_range("min_weight", self.min_weight, 0.0, 1.0)
        in_range("min_shrinkage", self.min_shrinkage, 1e-4, 1.0)
        _whole("guard_hops", self.guard_hops, 0, 100)
        _whole("harmonics", self.harmonics, 1, 1000)
        _whole("refresh_hops", self.refresh_hops, 1, 1000)


class NoiseCovariance:
    """Recursive mean of unit-length snapshots' covariance, per bin.

    Parameters
    ----------
    n_bins, n_microphones : int
        Shape.
    forgetting_frames : float
        Time constant, learned frames.

    Examples
    --------
    >>> noise = NoiseCovariance(n_bins=1, n_microphones=2, forgetting_frames=1e6)
    >>> noise.learn(np.array([[[[2.0, 2.0], [2.0, 2.0]]]], np.complex64)[0], n_frames=2, weight=1.0)
    >>> noise.mean(0).real.tolist(), noise.n_frames
    ([[1.0, 1.0], [1.0, 1.0]], 2.0)
    """

    def __init__(self, n_bins: int, n_microphones: int, forgetting_frames: float) -> None:
        self.n_frames = 0.0
        self._sum = np.zeros((n_bins, n_microphones, n_microphones), np.complex64)
        self._forgetting = forgetting_frames

    def learn(self, total: NDArray[np.complex64], n_frames: int, weight: float) -> None:
        """Take a hop's sum (bins, M, M) over so many frames, with a weight in (0, 1]; `total` is consumed.

        Parameters
        ----------
        total : ndarray of complex64, shape (bins, M, M)
            Sum of cross-spectra; consumed.
        n_frames : int
            How many frames it sums.
        weight : float
            In (0, 1].
        """
        kept = math.exp(-weight * n_frames / self._forgetting)
        total *= np.float32(weight)
        self._sum *= np.float32(kept)
        self._sum += total
        self.n_frames = kept * self.n_frames + weight * n_frames

    def mean(self, bin_index: int) -> NDArray[np.complex64]:
        """Covariance of one bin; the mean of its diagonal is one.

        Parameters
        ----------
        bin_index : int
            From 0.

        Returns
        -------
        ndarray of complex64, shape (M, M)
            Hermitian.
        """
        return np.asarray(self._sum[bin_index] / np.float32(max(self.n_frames, 1e-30)))


class WhitenedBeams:
    r"""Beams for whitened spectra, brought up to date bin by bin.

    With :math:`W = B C` of `Steering`, the weights for :math:`y = R^{-1/2} x` are
    :math:`\overline{R^{-1/2}} B C`, scaled to length :math:`\sqrt M` in every direction (M counts the living
    microphones: those with any noise).

    Parameters
    ----------
    plain : Steering
        Beams for spectra as they are.

    Examples
    --------
    >>> from worldstate.frontend.array import MicrophoneArray
    >>> plain = Steering.towards(MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]]), [500.0], [0.0, 0.5])
    >>> beams = WhitenedBeams(plain)
    >>> beams.update(0, 3.0 * np.eye(2, dtype=np.complex64))
    >>> bool(np.allclose(beams.steering.weights, plain.weights))
    True
    """

    def __init__(self, plain: Steering) -> None:
        self._plain = plain
        basis = None if plain.basis is None else plain.basis.copy()
        self.steering = Steering(basis, plain.weights.copy(), plain.conjugate.copy())

    def update(self, bin_index: int, root: NDArray[np.complex64]) -> None:
        """Use another inverse root (M, M) in one bin.

        Parameters
        ----------
        bin_index : int
            From 0.
        root : ndarray of complex64, shape (M, M)
            Inverse root of the noise covariance.
        """
        plain, ours = self._plain, self.steering
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


class EgoNoise:
    """Learns the ego-noise of a stream and whitens its spectra, hop by hop.

    Until something has been learned, spectra and beams are what they were, bit for bit. Set `weight` to the
    probability that no source is there: it holds for all hops from then on.

    Parameters
    ----------
    settings : EgoNoiseSettings
        Speed, guard and strength.
    frames_per_s : float
        Frames of the transform a second.
    n_microphones : int
        M.
    beams : sequence of (Steering, slice)
        Beams to keep whitened, each with its bins among those of the spectra.
    engine : HarmonicCanceller, optional
        For the same spectra.

    Examples
    --------
    >>> from worldstate.frontend.array import MicrophoneArray
    >>> plain = Steering.towards(MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]]), [500.0], [0.0, 0.5])
    >>> ego = EgoNoise(EgoNoiseSettings(guard_hops=0), 200.0, 2, [(plain, slice(1, 2))])
    >>> hop = np.ones((20, 3, 2), np.complex64)
    >>> ego.weight = 1.0
    >>> for _ in range(3):
    ...     ((whitened, steering),) = ego.process(hop)
    >>> round(ego.learned_frames, 1), whitened.shape
    (39.6, (20, 1, 2))
    """

    def __init__(
        self,
        settings: EgoNoiseSettings,
        frames_per_s: float,
        n_microphones: int,
        beams: Sequence[tuple[Steering, slice]],
        engine: HarmonicCanceller | None = None,
    ) -> None:
        self.weight = 0.0
        self.engine = engine
        self._beams = [WhitenedBeams(plain) for plain, _ in beams]
        first, last = min(bins.start for _, bins in beams), max(bins.stop for _, bins in beams)
        self._bins = slice(first, last)
        self._slices = [slice(bins.start - first, bins.stop - first) for _, bins in beams]
        n_bins = last - first
        self._settings = settings
        self._covariance = NoiseCovariance(n_bins, n_microphones, 0.5 * settings.forgetting_s * frames_per_s)
        self._roots = np.tile(np.eye(n_microphones, dtype=np.complex64), (n_bins, 1, 1))
        self._waiting: deque[tuple[NDArray[np.complex64] | None, int]] = deque()
        self._weights: deque[float] = deque(maxlen=settings.guard_hops + 1)
        self._is_odd = False
        self._next_bin = 0
        self._stale = 0
        self._hops_since_refresh = 0
        self._all_bins_seen = False

    @property
    def learned_frames(self) -> float:
        """Number of frames that the covariance remembers; those of every second hop are learned."""
        return self._covariance.n_frames

    def process(self, spectra: NDArray[np.complex64]) -> list[tuple[NDArray[np.complex64], Steering]]:
        """Cancel, learn and whiten the frames of a hop (frames, bins, M), phase transform included.

        Parameters
        ----------
        spectra : ndarray of complex64, shape (frames, bins, M)
            One hop.

        Returns
        -------
        list of (ndarray of complex64, shape (frames, its bins, M), Steering)
            For each set of beams.
        """
        rest = spectra if self.engine is None else self.engine.cancel(spectra)
        heard = rest[:, self._bins]
        self._learn(heard)
        self._refresh()
        whitened = self._whitened(heard)
        both = zip(self._slices, self._beams, strict=True)
        return [(whitened[:, bins], beams.steering) for bins, beams in both]

    def _whitened(self, heard: NDArray[np.complex64]) -> NDArray[np.complex64]:
        if not self.learned_frames:
            return whiten(heard)
        by_bin = heard.transpose(1, 0, 2) @ self._roots.transpose(0, 2, 1)
        return whiten(by_bin).transpose(1, 0, 2)

    def _learn(self, spectra: NDArray[np.complex64]) -> None:
        """Put this hop in the queue, take the one that has waited long enough."""
        used = self.weight if self.weight >= self._settings.min_weight else 0.0
        self._weights.append(used)
        # Ego-noise is steady: every second hop says nearly everything.
        self._is_odd = not self._is_odd
        total = _direction_sum(spectra) if used > 0.0 and self._is_odd else None
        self._waiting.append((total, len(spectra)))
        if len(self._waiting) <= self._settings.guard_hops:
            return
        total, n_frames = self._waiting.popleft()
        weight = min(self._weights)
        if total is not None and weight > 0.0:
            self._covariance.learn(total, n_frames, weight)
            self._stale = len(self._roots)

    def _refresh(self) -> None:
        """Bring the next bin up to date if it is time, until all have seen what was learned last."""
        self._hops_since_refresh += 1
        due = not self._all_bins_seen or self._hops_since_refresh >= self._settings.refresh_hops
        if not (self._stale and due):
            return
        self._update(self._next_bin)
        self._next_bin = (self._next_bin + 1) % len(self._roots)
        self._all_bins_seen |= self._next_bin == 0
        self._stale -= 1
        self._hops_since_refresh = 0

    def _update(self, index: int) -> None:
        R = self._covariance.mean(index)
        shrinkage = max(self._settings.min_shrinkage, white_share(R, self.learned_frames))
        self._roots[index] = shrunk_inverse_root(R, shrinkage)
        for beams, bins in zip(self._beams, self._slices, strict=True):
            if bins.start <= index < bins.stop:
                beams.update(index - bins.start, self._roots[index])


def _direction_sum(spectra: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """Sum x x^H of snapshots scaled to mean power one, (frames, bins, M) -> (bins, M, M)."""
    power = np.square(spectra.real).sum(axis=2) + np.square(spectra.imag).sum(axis=2)
    scale = np.sqrt(np.float32(spectra.shape[2]) / np.maximum(power, _TINY))
    return cross_spectra((spectra * scale[:, :, None]).transpose(1, 0, 2))


def _whole(name: str, value: int, low: int, high: int) -> None:
    if value != int(value) or not low <= value <= high:
        raise InvalidArgumentError(f"{name}: expected a whole number in [{low}, {high}], got {value}")
