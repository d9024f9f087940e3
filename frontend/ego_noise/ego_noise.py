r"""Ego-noise: a noise covariance learned while no source is likely, and the spectra it whitens.

.. math:: \hat R_k \leftarrow \frac{\lambda^{w} W \hat R_k + w \sum_t \tilde x_{t,k} \tilde x_{t,k}^H}
          {\lambda^{w} W + w T}, \qquad \tilde x = \sqrt{M}\, x / \|x\|

over the T frames of a hop that is learned with weight w; W is the weight so far. Frames count by their
direction in microphone space, not by their level, so that one loud moment does not decide and the level may
follow the speed. Only what is learned makes forget: a closed gate keeps what is known.

The gate is the caller's: `EgoNoise.weight`, the probability that no source is there. A hop is learned only
after the next `guard_hops` hops have passed, with the least weight of all these, so that a source is not
learned in the moments before anybody believes in it.

What is heard is learned, and what was learned used, as far as it comes from below, where the own vehicle is
and no street: see `elevation_split`. A gate that opens by mistake, or because the vehicle stands, changes
nothing.

Whitened noise that has changed since it was learned, with the speed say, leaves a level c above that of white
noise. Its mean over all directions is learned by the same gate, and the steered power is divided by it: as in
any detector of constant false-alarm rate, noise reads 1/M in a slow drive and in a fast one.

Sources: the references of `prewhitening` and `elevation_split`; unit-length snapshots as in D. E. Tyler,
"Statistical analysis for the angular central Gaussian distribution on the sphere", 1987; guard cells as in
any detector of constant false-alarm rate.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.frontend.array.steering import Steering, cross_spectra
from worldstate.frontend.spectra.phat import whiten
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import Complex64Array, FloatArray

from .elevation_split import ElevationSplit, share_of
from .guard_delay import GuardDelay
from .harmonic_cancellation import HarmonicCanceller
from .noise_memory import NoiseCovariance, NoiseLevel
from .prewhitening import shrunk_inverse_root, white_share
from .whitened_beams import WhitenedBeams

_TINY = np.float32(1e-30)
# Shares from below at which noise begins to be whitened, and is wholly. Simulated streets: below 0.1; drives
# at walking pace, where the street is as loud: above 0.6.
_STREET_SHARE, _EGO_SHARE = 0.3, 0.6
# Hops over which is judged whether to learn at all: a street must not linger when the vehicle sets off.
_RECENT_HOPS = 5.0
# So many bins a hop are brought up to date where the share has changed so much, and whenever so many times as
# much has been learned: the first roots are made from a handful of frames.
_URGENT_BINS, _ANOTHER_SHARE, _ANOTHER_LENGTH = 4, 0.2, 2.0


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
        Every so many hops the whitening of one bin, in turn, is brought up to date; several bins every hop
        at first, and again where the vehicle starts or stops. It costs an M x M eigendecomposition.
    harmonics : int
        Lines of the engine that are cancelled before, once `FrontEnd.follow_engine` says its speed.
    feature : bool
        Compute the published feature from prewhitened sound too. Off, because its classifier was trained
        without.
    only_below_horizon : bool
        Use what was learned as far as it comes from under the array. Off, everything that is learned is
        whitened, the street's own noise too.

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
    only_below_horizon: bool = True

    def __post_init__(self) -> None:
        in_range("forgetting_s", self.forgetting_s, 0.1, 1e5)
        in_range("min_weight", self.min_weight, 0.0, 1.0)
        in_range("min_shrinkage", self.min_shrinkage, 1e-4, 1.0)
        _whole("guard_hops", self.guard_hops, 0, 100)
        _whole("harmonics", self.harmonics, 1, 1000)
        _whole("refresh_hops", self.refresh_hops, 1, 1000)


class EgoNoise:
    """Learns the ego-noise of a stream and whitens its spectra, hop by hop.

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import MicrophoneArray
    >>> plain = Steering.towards(MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]]), [500.0], [0.0, 0.5])
    >>> ego = EgoNoise(EgoNoiseSettings(guard_hops=0), 200.0, 2, [(plain, slice(1, 2))])
    >>> hop = np.ones((20, 3, 2), np.complex64)
    >>> ego.weight = 1.0
    >>> for _ in range(3):
    ...     ((whitened, steering),) = ego.process(hop)
    >>> round(ego.learned_frames, 1), whitened.shape
    (39.6, (20, 1, 2))
    """

    # Until something from below has been learned, spectra are what they were, bit for bit. Set `weight` to
    # the probability that no source is there: it holds for all hops from then on.

    def __init__(
        self,
        settings: EgoNoiseSettings,
        frames_per_s: float,
        n_microphones: int,
        beams: Sequence[tuple[Steering, slice]],
        engine: HarmonicCanceller | None = None,
        elevation_split: ElevationSplit | None = None,
    ) -> None:
        self.weight = 0.0
        self.engine = engine
        self.elevation_split = 0.0
        self._judge = elevation_split
        self._beams = [WhitenedBeams(plain) for plain, _ in beams]
        self._bins = spanned(bins for _, bins in beams)
        first, n_bins = self._bins.start, self._bins.stop - self._bins.start
        self._slices = [slice(bins.start - first, bins.stop - first) for _, bins in beams]
        self._settings = settings
        self._covariance = NoiseCovariance(n_bins, n_microphones, 0.5 * settings.forgetting_s * frames_per_s)
        self._roots = np.tile(np.eye(n_microphones, dtype=np.complex64), (n_bins, 1, 1))
        self._guard: GuardDelay[tuple[Complex64Array | None, int]] = GuardDelay(settings.guard_hops)
        self._level = NoiseLevel(settings.guard_hops)
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
        """Number of frames that the covariance remembers; those of every second hop are learned."""
        return self._covariance.n_frames

    def process(self, spectra: Complex64Array) -> list[tuple[Complex64Array, Steering]]:
        r"""Cancel, learn and whiten the frames of a hop (frames, bins, M), phase transform included.

        .. math:: y = \hat R^{-1/2}\, (x - \ell), \qquad Z_m = y_m / |y_m|

        with the lines l of the engine and the covariance R learned so far, shrunk as far as it is the
        street's.

        Shapes: spectra (frames, bins, M).
        """
        heard = spectra[:, self._bins]
        if self.engine is not None:
            heard = self.engine.cancel(heard)
        self._learn(heard)
        self._refresh()
        whitened = self._whitened(heard)
        both = zip(self._slices, self._beams, strict=True)
        used = bool(self.elevation_split)
        return [(whitened[:, bins], beams.steering if used else beams.plain) for bins, beams in both]

    def levelled(self, power: FloatArray, n_frames: int) -> FloatArray:
        r"""Divide a hop's steered power by the level that whitened noise had while it was learned.

        .. math:: P'(\theta) = P(\theta) / c^{\,u}, \qquad
                  c = \Big\langle \frac{\langle P \rangle_\theta}{T K M} \Big\rangle_{\text{learned hops}}

        with u in [0, 1], how far what was learned is used.

        Shapes: power (directions,).

        References
        ----------
        H. M. Finn and R. S. Johnson, "Adaptive detection mode with threshold control as a function of
        spatially sampled clutter-level estimates", RCA Review 29, 1968 (constant false-alarm rate).
        """
        if not self._aim_frames or not self.elevation_split:
            return power
        n_bins = self._slices[0].stop - self._slices[0].start
        white = n_frames * n_bins * self._roots.shape[1]
        level = self._level.push(float(power.mean()) / white, self._gated())
        return np.asarray(power / max(level, 1e-6) ** self.elevation_split)

    def _gated(self) -> float:
        return self.weight if self.weight >= self._settings.min_weight else 0.0

    def _whitened(self, heard: Complex64Array) -> Complex64Array:
        if not self.elevation_split:
            return whiten(heard)
        by_bin = heard.transpose(1, 0, 2) @ self._roots.transpose(0, 2, 1)
        return whiten(by_bin).transpose(1, 0, 2)

    def _learn(self, spectra: Complex64Array) -> None:
        """Put this hop in the queue, take the one that has waited long enough."""
        weight = self._gated()
        # Ego-noise is steady: every second hop says nearly everything.
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
        """Bring the next bins up to date if it is time, until all have seen what was learned last."""
        self._hops_since_refresh += 1
        grown = self.learned_frames > _ANOTHER_LENGTH * self._aim_frames
        due = grown or self._urgent or self._hops_since_refresh >= self._settings.refresh_hops
        if not (self._stale and due):
            return
        self._judge_share()
        for _ in range(min(_URGENT_BINS, self._urgent) or 1):
            self._update(self._next_bin)
            self._next_bin = (self._next_bin + 1) % len(self._roots)
            self._stale, self._urgent = max(self._stale - 1, 0), max(self._urgent - 1, 0)
        self._hops_since_refresh = 0

    def _judge_share(self) -> None:
        """Decide how far what was learned is used; where that has changed, all bins are urgent."""
        self.elevation_split = self._share_used()
        is_another = abs(self.elevation_split - self._aim) > _ANOTHER_SHARE
        if is_another or self.learned_frames > _ANOTHER_LENGTH * self._aim_frames:
            self._aim, self._aim_frames = self.elevation_split, self.learned_frames
            self._urgent = self._stale = len(self._roots)

    def _share_used(self) -> float:
        """How far what was learned is used: 0 for a street, 1 for a vehicle's own noise."""
        return 1.0 if self._judge is None else _use_of(*self._judge.powers(self._covariance.total))

    def _recent_share(self, total: Complex64Array) -> float:
        """How far the last second that could be learned, this hop the newest, is the vehicle's own noise."""
        if self._judge is None:
            return 1.0
        kept = math.exp(-1.0 / _RECENT_HOPS)
        self._recent = kept * self._recent + self._judge.powers(total)
        return _use_of(*self._recent)

    def _update(self, index: int) -> None:
        R = self._covariance.mean(index)
        least = max(self._settings.min_shrinkage, 1.0 - self.elevation_split)
        self._roots[index] = shrunk_inverse_root(R, max(least, white_share(R, self.learned_frames)))
        for beams, bins in zip(self._beams, self._slices, strict=True):
            if bins.start <= index < bins.stop:
                beams.update(index - bins.start, self._roots[index])


def _use_of(below: float, street: float) -> float:
    """From powers to 0 for a street, 1 for a vehicle's own noise."""
    share = share_of(below, street)
    return min(max((share - _STREET_SHARE) / (_EGO_SHARE - _STREET_SHARE), 0.0), 1.0)


def spanned(slices: Iterable[slice]) -> slice:
    """Return the bins from the first to the last of several sets.

    Examples
    --------
    >>> spanned([slice(2, 5), slice(0, 3)])
    slice(0, 5, None)
    """
    parts = list(slices)
    return slice(min(part.start for part in parts), max(part.stop for part in parts))


def _direction_sum(spectra: Complex64Array) -> Complex64Array:
    """Sum x x^H of snapshots scaled to mean power one, (frames, bins, M) -> (bins, M, M)."""
    power = np.square(spectra.real).sum(axis=2) + np.square(spectra.imag).sum(axis=2)
    scale = np.sqrt(np.float32(spectra.shape[2]) / np.maximum(power, _TINY))
    return cross_spectra((spectra * scale[:, :, None]).transpose(1, 0, 2))


def _whole(name: str, value: int, low: int, high: int) -> None:
    if value != int(value) or not low <= value <= high:
        raise InvalidArgumentError(f"{name}: expected a whole number in [{low}, {high}], got {value}")
