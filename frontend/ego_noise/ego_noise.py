r"""Ego-noise: a noise covariance learned while no source is likely, and the spectra it whitens.

.. math:: \hat R_k \leftarrow \frac{\lambda^{w} W \hat R_k + w \sum_t \tilde x_{t,k} \tilde x_{t,k}^H}
          {\lambda^{w} W + w T}, \qquad \tilde x = \sqrt{M}\, x / \|x\|

over the T frames of a hop that is learned with weight w; W is the weight so far. Snapshots have unit length
(D. E. Tyler, "Statistical analysis for the angular central Gaussian distribution on the sphere", 1987), so
that one loud moment does not decide and the level may follow the speed. The forgetting factor advances only
with accepted updates.

The weight is set by the caller: `EgoNoise.weight`, the probability that no source is present. A hop is
learned after the next `guard_hops` hops with the minimum weight of all these (guard cells, as in a CFAR
detector), so that a source is not learned in the moments before it is detected.

Sound is learned, and what was learned is used, as far as it comes from below the horizon, where the own
vehicle is and no street: see `elevation_split`. A wrong weight therefore changes nothing.

Whitened noise that has changed since it was learned, with the speed for example, has a level c above that of
white noise. Its mean over all directions is learned with the same weight, and the steered power is divided by
it: noise then reads 1/M at any speed.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.steering import Steering, cross_spectra
from worldstate.frontend.spectra.stft import whiten
from worldstate.ground.typing import Complex64Array, ComplexArray, Float32Array, FloatArray

_TINY = np.float32(1e-30)
# Hops of a lower weight are not learned: a likely source must not enter.
_LEAST_WEIGHT = 0.5
# Time constant of the covariance in learning time, and delay after which a hop is learned with the minimum
# weight of the interval.
_FORGETTING_S, _GUARD_HOPS = 10.0, 5
# Least shrinkage towards white noise: no direction is amplified by more than its inverse root.
_MIN_SHRINKAGE = 0.03
# Period after which the whitening of one bin, in turn, is updated, an M x M eigendecomposition; several bins
# per hop at first and when the vehicle starts or stops.
_REFRESH_HOPS = 4
# Shares of below-horizon power at which whitening begins and is complete. Simulated streets: below 0.1;
# drives at walking pace, where the street is as loud: above 0.6.
_STREET_SHARE, _EGO_SHARE = 0.3, 0.6
# Memory, hops, of the decision whether to learn: longer, the street would still count when the vehicle sets
# off.
_RECENT_HOPS = 5.0
# Bins updated per hop after a change of the share by this much, and whenever twice as many frames have been
# learned: the first inverse roots come from a few frames.
_URGENT_BINS, _ANOTHER_SHARE, _ANOTHER_LENGTH = 4, 0.2, 2.0


class EgoNoise:
    """Learn the ego-noise of a stream and whiten its spectra, hop by hop."""

    # Until noise from below the horizon has been learned, spectra are unchanged, bit for bit. `weight` is the
    # probability that no source is present, for all hops from then on.

    def __init__(
        self,
        frames_per_s: float,
        n_microphones: int,
        beams: Sequence[Steering],
        elevation_split: "ElevationSplit",
    ) -> None:
        self.weight = 0.0
        self.ego_share = 0.0
        self._split = elevation_split
        self._beams = [WhitenedBeams(plain) for plain in beams]
        n_bins = len(beams[0].weights)
        self._covariance = NoiseCovariance(n_bins, n_microphones, 0.5 * _FORGETTING_S * frames_per_s)
        self._roots = np.tile(np.eye(n_microphones, dtype=np.complex64), (n_bins, 1, 1))
        self._guard: GuardDelay[tuple[Complex64Array | None, int]] = GuardDelay(_GUARD_HOPS)
        self._level = NoiseLevel()
        self._recent = np.zeros(2)
        self._is_odd = False
        self._next_bin = 0
        self._stale = 0
        self._hops_since_refresh = 0
        # Bins to bring up to date at once, and what that is for: the share, the frames learned.
        self._urgent = n_bins
        self._aim = self._aim_frames = 0.0

    @property
    def learned_frames(self) -> float:
        """Number of frames in the covariance; every second hop is learned."""
        return self._covariance.n_frames

    def process(self, spectra: Complex64Array) -> tuple[Complex64Array, tuple[Steering, ...]]:
        r"""Learn and whiten the frames of a hop (frames, bins, M), phase transform included.

        .. math:: y = \hat R^{-1/2} x, \qquad Z_m = y_m / |y_m|

        with the covariance R learned so far, shrunk by the share of the street.
        """
        self._learn(spectra)
        self._refresh()
        used = tuple(beams.steering if self.ego_share else beams.plain for beams in self._beams)
        return self._whitened(spectra), used

    def levelled(self, power: FloatArray, n_frames: int) -> FloatArray:
        r"""Divide a hop's steered power by the level that whitened noise had while it was learned.

        .. math:: P'(\theta) = P(\theta) / c^{\,u}, \qquad
                  c = \Big\langle \frac{\langle P \rangle_\theta}{T K M} \Big\rangle_{\text{learned hops}}

        with u in [0, 1] the share of ego-noise (CFAR: H. M. Finn and R. S. Johnson, RCA Review 29, 1968).
        """
        if not self._aim_frames or not self.ego_share:
            return power
        white = n_frames * self._roots.shape[0] * self._roots.shape[1]
        level = self._level.push(float(power.mean()) / white, self._gated())
        return np.asarray(power / max(level, 1e-6) ** self.ego_share)

    def _gated(self) -> float:
        return self.weight if self.weight >= _LEAST_WEIGHT else 0.0

    def _whitened(self, spectra: Complex64Array) -> Complex64Array:
        if not self.ego_share:
            return whiten(spectra)
        by_bin = spectra.transpose(1, 0, 2) @ self._roots.transpose(0, 2, 1)
        return whiten(by_bin).transpose(1, 0, 2)

    def _learn(self, spectra: Complex64Array) -> None:
        """Delay this hop by the guard interval and learn the one that leaves it."""
        weight = self._gated()
        # Ego-noise is stationary over seconds: every second hop gives nearly the same covariance at half the
        # cost.
        self._is_odd = not self._is_odd
        total = _direction_sum(spectra) if weight > 0.0 and self._is_odd else None
        ripe = self._guard.push((total, len(spectra)), weight)
        if ripe is None:
            return
        (total, n_frames), weight = ripe
        if total is not None and weight > 0.0:
            weight *= self._recent_share(total)
            if weight > 0.0:
                self._covariance.learn(total, n_frames, weight)
                self._stale = len(self._roots)

    def _refresh(self) -> None:
        """Update the whitening of the next bins if it is due, until all use the newest covariance."""
        self._hops_since_refresh += 1
        grown = self.learned_frames > _ANOTHER_LENGTH * self._aim_frames
        due = grown or self._urgent or self._hops_since_refresh >= _REFRESH_HOPS
        if not (self._stale and due):
            return
        self._update_share()
        for _ in range(min(_URGENT_BINS, self._urgent) or 1):
            self._update(self._next_bin)
            self._next_bin = (self._next_bin + 1) % len(self._roots)
            self._stale, self._urgent = max(self._stale - 1, 0), max(self._urgent - 1, 0)
        self._hops_since_refresh = 0

    def _update_share(self) -> None:
        """Update the share of ego-noise; if it has changed much, all bins are updated at once."""
        # Of the covariance that is used: 0 for a street, 1 for ego-noise.
        self.ego_share = _use_of(*self._split.powers(self._covariance.total))
        is_another = abs(self.ego_share - self._aim) > _ANOTHER_SHARE
        if is_another or self.learned_frames > _ANOTHER_LENGTH * self._aim_frames:
            self._aim, self._aim_frames = self.ego_share, self.learned_frames
            self._urgent = self._stale = len(self._roots)

    def _recent_share(self, total: Complex64Array) -> float:
        """Share of ego-noise in the hops accepted for learning of late."""
        kept = math.exp(-1.0 / _RECENT_HOPS)
        self._recent = kept * self._recent + self._split.powers(total)
        return _use_of(*self._recent)

    def _update(self, index: int) -> None:
        R = self._covariance.mean(index)
        least = max(_MIN_SHRINKAGE, 1.0 - self.ego_share)
        self._roots[index] = shrunk_inverse_root(R, max(least, white_share(R, self.learned_frames)))
        for beams in self._beams:
            beams.update(index, self._roots[index])


def _use_of(below: float, street: float) -> float:
    """Map the powers below and above the horizon to 0 for a street, 1 for ego-noise."""
    share = share_of(below, street)
    return min(max((share - _STREET_SHARE) / (_EGO_SHARE - _STREET_SHARE), 0.0), 1.0)


def _direction_sum(spectra: Complex64Array) -> Complex64Array:
    """Sum x x^H of snapshots scaled to mean power one, (frames, bins, M) -> (bins, M, M)."""
    power = np.square(spectra.real).sum(axis=2) + np.square(spectra.imag).sum(axis=2)
    scale = np.sqrt(np.float32(spectra.shape[2]) / np.maximum(power, _TINY))
    return cross_spectra((spectra * scale[:, :, None]).transpose(1, 0, 2))


Item = TypeVar("Item")


class GuardDelay(Generic[Item]):
    r"""Queue of hops, weighted :math:`w'_n = \min(w_n, \dots, w_{n + hops})` over the guard interval."""

    # Each hop leaves after `hops` hops. Without the delay a source is learned as noise in the moments before
    # it is detected.

    def __init__(self, hops: int) -> None:
        self._waiting: deque[Item] = deque()
        self._weights: deque[float] = deque(maxlen=hops + 1)

    def push(self, item: Item, weight: float) -> tuple[Item, float] | None:
        """Take a hop with its weight; return the one that leaves the delay, None while it fills."""
        self._waiting.append(item)
        self._weights.append(weight)
        if len(self._waiting) < (self._weights.maxlen or 0):
            return None
        return self._waiting.popleft(), min(self._weights)


# Memory of the level of whitened noise, hops: one second, for the level follows the speed of the vehicle.
_LEVEL_HOPS = 10.0


class NoiseCovariance:
    """Recursive mean of unit-length snapshots' covariance, per bin."""

    def __init__(self, n_bins: int, n_microphones: int, forgetting_frames: float) -> None:
        self.n_frames = 0.0
        self.total = np.zeros((n_bins, n_microphones, n_microphones), np.complex64)  # The weighted sum S
        self._forgetting = forgetting_frames

    def learn(self, total: Complex64Array, n_frames: int, weight: float) -> None:
        r"""Add a hop's sum (bins, M, M) over `n_frames` with a weight in (0, 1]; `total` is overwritten.

        .. math:: S \leftarrow e^{-w T / F} S + w \sum_t x_t x_t^H, \qquad n \leftarrow e^{-w T / F} n + w T
        """
        kept = math.exp(-weight * n_frames / self._forgetting)
        total *= np.float32(weight)
        self.total *= np.float32(kept)
        self.total += total
        self.n_frames = kept * self.n_frames + weight * n_frames

    def mean(self, bin_index: int) -> Complex64Array:
        """Return the covariance S / n of one bin; the mean of its diagonal is one."""
        return np.asarray(self.total[bin_index] / np.float32(max(self.n_frames, 1e-30)))


class NoiseLevel:
    """Level of whitened noise relative to white noise, learned like the covariance."""

    def __init__(self) -> None:
        self._guard: GuardDelay[float] = GuardDelay(_GUARD_HOPS)
        self._sum = self._weights = 0.0

    def push(self, level: float, weight: float) -> float:
        r"""Take a hop's level with its weight; return the level learned so far, 1 before any.

        .. math:: c = \frac{\sum_i w_i l_i e^{-W_i / 10}}{\sum_i w_i e^{-W_i / 10}}
        with the weights w of the levels l and W the weight learned since.
        """
        ripe = self._guard.push(level, weight)
        if ripe is not None and ripe[1] > 0.0:
            learned, weight = ripe
            kept = math.exp(-weight / _LEVEL_HOPS)
            self._sum = kept * self._sum + weight * learned
            self._weights = kept * self._weights + weight
        return self._sum / self._weights if self._weights else 1.0


# Noise power of a microphone, relative to the mean, below which it is dead and left out: its inverse would
# dominate.
_DEAD = 1e-9


def white_share(R: ComplexArray, n_frames: float) -> float:
    r"""Return the oracle-approximating shrinkage of a sample covariance towards white noise.

    .. math:: s = \min\Big(1, \frac{(1 - 2/M) \operatorname{tr} R^2 + \operatorname{tr}^2 R}
              {(n + 1 - 2/M) (\operatorname{tr} R^2 - \operatorname{tr}^2 R / M)}\Big)

    Shapes: R (M, M).

    Examples
    --------
    >>> white_share(np.eye(4), 100), round(white_share(np.ones((4, 4)), 100), 3)
    (1.0, 0.02)
    """
    # Y. Chen et al., IEEE Trans. Signal Processing 58, 2010. One if the eigenvalues spread no more than those
    # of n frames of white noise, so that white noise is not whitened; near zero if a few directions dominate.
    size = len(R)
    squares = float(np.square(R.real).sum() + np.square(R.imag).sum())
    trace = float(np.einsum("mm->", R).real) ** 2
    spread = (n_frames + 1.0 - 2.0 / size) * (squares - trace / size)
    share = (1.0 - 2.0 / size) * squares + trace
    return share / spread if spread > share else 1.0


def shrunk_inverse_root(R: ComplexArray, s: float) -> ComplexArray:
    r"""Return the Hermitian inverse root of a noise covariance, shrunk towards white noise of equal power.

    .. math:: \big[(1 - s) R / p + s I\big]^{-1/2} =
              V \operatorname{diag}\big[(1 - s) \lambda / p + s\big]^{-1/2} V^H, \qquad p = \operatorname{tr}
              R / M

    Shapes: R (M, M).
    """
    # Shrinkage after O. Ledoit and M. Wolf (2004): no direction is amplified by more than 1 / sqrt(s), and s
    # = 1 changes nothing. The Hermitian root after A. Kessy et al. (2018). Dead microphones give zeros; where
    # all are silent the identity is returned.
    power = np.einsum("mm->m", R).real
    alive = power > _DEAD * power.mean()
    root = np.zeros_like(R) if alive.any() else np.eye(len(R), dtype=R.dtype)
    if alive.any():
        both = np.ix_(alive, alive)
        root[both] = _shrunk_root(R[both] / power[alive].mean(), s)
    return root


def _shrunk_root(R: ComplexArray, s: float) -> ComplexArray:
    if s >= 1.0:
        return np.eye(len(R), dtype=R.dtype)
    values, vectors = np.linalg.eigh(R)
    shrunk = (1.0 - s) * np.maximum(values, 0.0) + s
    gains = 1.0 / np.sqrt(np.maximum(shrunk, np.finfo(values.dtype).tiny))
    return np.asarray((vectors * gains.astype(values.dtype)) @ vectors.conj().T)


class WhitenedBeams:
    r"""Beams for whitened spectra, updated bin by bin.

    .. math:: y = R^{-1/2} x, \qquad b(\theta) = \sqrt{M}\, \frac{R^{-1/2} a(\theta)}{\|R^{-1/2} a(\theta)\|}

    with the noise covariance R per bin and its Hermitian root, the root that changes the microphones least:
    where R is a multiple of the identity, y is x and b is a. Whitening attenuates the steering vector as it
    does the sound, hence its new length.

    MUSIC in these coordinates is the generalised eigenvalue form (R. Roy and T. Kailath, IEEE Trans. ASSP 37,
    1989; for ego-noise K. Nakamura et al., IROS 2009): the eigenvectors v of :math:`R^{-1/2} R_x R^{-1/2}`
    are :math:`R^{1/2} u` with :math:`R_x u = \lambda R u`.

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


# Elevations of the two fields: the body of the vehicle is well below a roof array, sources and facades are at
# its height and above.
_BELOW_DEG, _STREET_DEG = (-60.0, -50.0, -40.0, -30.0, -20.0), (0.0, 10.0, 20.0, 30.0)
_AZIMUTHS_RAD = np.radians(np.arange(-180.0, 180.0, 5.0))
# Least 1 - cos^2 of the angle between the fields at which they can be separated: 0.95 for the roof array, 0.1
# for a horizontal line.
_LEAST_CONTRAST = 0.2
_LEAST_POWER = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class ElevationSplit:
    r"""Separate the noise of the own vehicle from that of the street by elevation.

    The own vehicle is below its microphones, the street at their height and above. The part of each bin's
    covariance between different microphones is fitted by two isotropic fields (B. F. Cron and C. H. Sherman,
    J. Acoust. Soc. Am. 34, 1962),

    .. math:: \hat p = \arg\min_p \sum_{i \ne j} |R_{ij} - p_b\, \Gamma^b_{ij} - p_s\, \Gamma^s_{ij}|^2,
              \qquad q = \frac{\sum_k \Delta_k\, p_{b,k}}{\sum_k \Delta_k\, (p_{b,k} + p_{s,k})},

    plane waves from all azimuths and from elevations well under the horizon (b) or from the horizon upwards
    (s). Bins are weighted by the determinant of their normal equations: where the array is small against the
    wavelength the two fields are alike. Wind and sensor noise are on the diagonal only and have no effect.
    """

    # shape (bins, 2 M^2): Combinations of the model fields, real and imaginary parts in turn, that give the
    # power of one field times the determinant.
    below: Float32Array
    street: Float32Array
    is_separable: bool  # Whether the array has the vertical extent for it

    @classmethod
    def of(cls, array: MicrophoneArray, frequencies_hz: ArrayLike) -> "ElevationSplit":
        r"""Build the model fields of an array at the frequencies of its bins.

        .. math:: \Gamma = \langle a a^H \rangle \text{ off the diagonal}, \qquad
                  w_b = G_{ss} \Gamma^b - G_{bs} \Gamma^s, \quad w_s = G_{bb} \Gamma^s - G_{bs} \Gamma^b
        """
        # Means over the directions of each field, with G their inner products: the inner product of w with R
        # is the power times the determinant.
        b, s = (_field(array, frequencies_hz, el) for el in (_BELOW_DEG, _STREET_DEG))
        bb, ss, bs = (np.einsum("kn,kn->k", x, y)[:, None] for x, y in ((b, b), (s, s), (b, s)))
        contrast = float((bb * ss - bs**2).sum() / max(float((bb * ss).sum()), _LEAST_POWER))
        below, street = ss * b - bs * s, bb * s - bs * b
        scale = 1.0 / max(float(np.abs(below).max()), _LEAST_POWER)
        below, street = (np.ascontiguousarray(scale * x, np.float32) for x in (below, street))
        return cls(below, street, is_separable=contrast >= _LEAST_CONTRAST)

    def powers(self, covariance: Complex64Array) -> FloatArray:
        r"""Return the powers below and above the horizon; below only, if the array cannot separate them.

        .. math:: P_b = \sum_k \Delta_k\, \hat p_{b,k}, \qquad P_s = \sum_k \Delta_k\, \hat p_{s,k}
        """
        if not self.is_separable:
            return np.array([1.0, 0.0])
        parts = covariance.reshape(len(covariance), -1).view(np.float32)
        return np.array([np.vdot(parts, self.below), np.vdot(parts, self.street)], np.float64)


def share_of(below: float, street: float) -> float:
    r"""Return the share of the first power; negative estimates count as zero.

    .. math:: q = \frac{\max(P_b, 0)}{\max(P_b, 0) + \max(P_s, 0)}

    Examples
    --------
    >>> share_of(3.0, 1.0), share_of(-1.0, 2.0), share_of(1.0, -0.1), share_of(0.0, 0.0)
    (0.75, 0.0, 1.0, 0.0)
    """
    return float(below / (below + max(street, 0.0))) if below > 0.0 else 0.0


def _field(
    array: MicrophoneArray, frequencies_hz: ArrayLike, elevations_deg: tuple[float, ...]
) -> FloatArray:
    """Covariance between different microphones of plane waves at some elevations, (bins, 2 M^2)."""
    azimuths, elevations = np.meshgrid(_AZIMUTHS_RAD, np.radians(elevations_deg))
    A = array.steering(frequencies_hz, azimuths.ravel(), elevations.ravel())
    field = A @ A.conj().transpose(0, 2, 1) / A.shape[2]
    field[:, np.arange(array.n_microphones), np.arange(array.n_microphones)] = 0.0
    return np.asarray(np.ascontiguousarray(field.reshape(len(field), -1)).view(np.float64))
