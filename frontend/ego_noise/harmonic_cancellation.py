r"""Cancel the engine: its harmonics are fitted to the spectra of all microphones and subtracted.

A harmonic h f of amplitude c contributes to frame t, bin k and microphone m

.. math:: X_{t,k,m} = c_{h,m}\, g_{t,k,h}, \qquad
          g_{t,k,h} = (-1)^k\, D\!\big(h f_t N / f_s - k\big)\, e^{j h \varphi_t},

with the phase phi_t and frequency f_t of the fundamental in the middle of the frame and the Hann window's
kernel D(u) = N [sinc(u) / 2 + sinc(u - 1) / 4 + sinc(u + 1) / 4] (F. J. Harris, Proc. IEEE 66, 1978). The
amplitudes come from recursive least squares with an exponential memory, bins weighted by their inverse power
(B. Widrow et al., "Adaptive noise cancelling", Proc. IEEE 63, 1975; several orders at once as in H. Vold and
J. Leuridan, SAE 931288, 1993). The phase h delta by which a hop's amplitudes differ from the remembered ones
corrects phase, frequency and rate of the fundamental: a phase-locked loop over all harmonics, which stays
locked where the given speed is a little wrong.

A line is subtracted by its excess over the noise: without an engine almost nothing is removed.
"""

import cmath
from dataclasses import dataclass, replace

import numpy as np

from worldstate.ground.checks import in_range
from worldstate.ground.typing import Complex64Array, ComplexArray, Float32Array, FloatArray, IntArray

# Distance, bins, at which a line outside the band no longer leaks into it through the window.
_REACH_BINS = 1.5
# Gains of the loop for the phase error of a hop: frequency and its rate (the phase is corrected in full). The
# first error is all frequency; the rate is held until the frequency has settled.
_FREQUENCY_GAIN, _RATE_GAIN, _SETTLING_HOPS = 0.5, 0.1, 6
# Differences of order that are compared, coarse to fine, so that no angle wraps before it is resolved.
_ORDER_STEPS = (1, 2, 4, 8)
# Evidence of a line against noise at which nothing of it is subtracted; noise alone has 1 on average.
_NO_LINE = 2.0
# Memory of the amplitudes: the engine's speed changes within a second.
_MEMORY_S = 0.4
_HARMONICS = 40
# Ridge relative to the diagonal: close harmonics of a slow engine are nearly collinear in a hop.
_RIDGE = 1e-3
_TINY = 1e-30


@dataclass(frozen=True, slots=True)
class EngineState:
    """Phase, frequency and rate of the fundamental at the middle of the last frame."""

    phase_rad: float  # Phase, its derivative over 2 pi, and the derivative of that
    frequency_hz: float
    rate_hz_per_s: float = 0.0
    hops: int = 0  # Hops since the fundamental was given

    def phases(self, time_s: FloatArray) -> FloatArray:
        r"""Return :math:`\varphi(t) = \varphi + 2\pi (f t + \tfrac12 \dot f t^2)`, radians."""
        cycles = self.frequency_hz * time_s + 0.5 * self.rate_hz_per_s * time_s**2
        return np.asarray(self.phase_rad + 2.0 * np.pi * cycles)

    def frequencies(self, time_s: FloatArray) -> FloatArray:
        r"""Return :math:`f(t) = f + \dot f t`, Hz."""
        return np.asarray(self.frequency_hz + self.rate_hz_per_s * time_s)

    def after(self, time_s: float, phase_error_rad: float) -> "EngineState":
        r"""Advance by a hop of this length, with the phase error measured in its middle.

        .. math:: \varphi' = \varphi(T) + \epsilon, \qquad f' = f(T) + g\, \frac{\epsilon}{2\pi T}, \qquad
                  \dot f' = \dot f + 0.1\, \frac{\epsilon}{2\pi T^2}

        with g falling from 1 to 1/2.
        """
        frequency_error = phase_error_rad / (2.0 * np.pi * time_s)
        gain = max(_FREQUENCY_GAIN, 1.0 / max(self.hops, 1))
        rate_gain = _RATE_GAIN if self.hops >= _SETTLING_HOPS else 0.0
        end = np.asarray(time_s)
        return EngineState(
            phase_rad=float(np.mod(self.phases(end) + phase_error_rad, 2.0 * np.pi)),
            frequency_hz=float(self.frequencies(end)) + gain * frequency_error,
            rate_hz_per_s=self.rate_hz_per_s + rate_gain * frequency_error / time_s,
            hops=self.hops + 1,
        )

    def within(self, low_hz: float, high_hz: float) -> "EngineState":
        """Limit the frequency to a range; the rate is reset where that changes it."""
        if low_hz <= self.frequency_hz <= high_hz:
            return self
        return replace(self, frequency_hz=min(max(self.frequency_hz, low_hz), high_hz), rate_hz_per_s=0.0)


class HarmonicCanceller:
    """Subtract the harmonics of an engine from the spectra of a stream."""

    def __init__(self, bins: range, sample_rate_hz: float, nfft: int) -> None:
        self._frame_s = 0.5 * nfft / sample_rate_hz
        self._bin_hz = sample_rate_hz / nfft
        self._bins = np.arange(bins.start, bins.stop)
        self._all_orders = np.arange(1, _HARMONICS + 1)
        self._fit: _Fit | None = None
        self._evident: ComplexArray = np.empty((0, 0), np.complex64)
        self._engine: EngineState | None = None
        self._limits_hz = (0.0, np.inf)

    @property
    def fundamental_hz(self) -> float | None:
        """Tracked frequency of the fundamental, None while there is none."""
        return None if self._engine is None else self._engine.frequency_hz

    def follow(self, fundamental_hz: float | None, tolerance: float = 0.02) -> None:
        """Set the fundamental, from the engine's speed or from `track_fundamental`; None stops."""
        if fundamental_hz is None:
            self._engine = self._fit = None
            return
        given = in_range("fundamental_hz", fundamental_hz, 10.0, 1000.0)
        share = in_range("tolerance", tolerance, 0.0, 0.5)
        if self._engine is None:
            self._engine = EngineState(0.0, given)
        self._limits_hz = given * (1.0 - share), given * (1.0 + share)
        self._engine = self._engine.within(*self._limits_hz)

    def cancel(self, spectra: Complex64Array) -> Complex64Array:
        r"""Return the frames of a hop, (frames, bins, M), without the lines of the engine.

        .. math:: X'_{t,k,m} = X_{t,k,m} - \sum_h \kappa_h \hat c_{h,m}\, g_{t,k,h}, \qquad
                  \hat c = (G^H W G)^{-1} G^H W X, \qquad \kappa_h = \max(1 - 2 / e_h,\, 0)

        with sums over the memory, W the inverse power of the bins, and e_h the power of a line over that of
        noise.
        """
        if self._engine is None or not len(spectra):
            return spectra
        orders = self._orders(self._engine.frequency_hz)
        if not len(orders):
            return spectra
        time: FloatArray = self._frame_s * np.arange(1.0, len(spectra) + 1)
        shapes = _LineShapes.of(self._engine, time, orders, self._bins, self._bin_hz)
        frames = np.ascontiguousarray(spectra)
        now = _Fit.of(shapes, frames)
        error = 0.0
        if self._fit is not None:
            error = now.phase_ahead(self._fit, self._evident)
            now = now.turned(error).joined(self._fit, float(np.exp(-time[-1] / _MEMORY_S)))
        self._fit, self._evident = now, now.evident_amplitudes()
        self._engine = self._engine.after(float(time[-1]), error).within(*self._limits_hz)
        turn = np.exp(1j * orders * error).astype(np.complex64)
        lines = shapes.over_bins(shapes.turn) @ (turn[:, None] * self._evident)
        rest = lines.reshape(frames.shape)
        return np.asarray(np.subtract(frames, rest, out=rest))

    def _orders(self, frequency_hz: float) -> IntArray:
        """Return the orders that reach the bins."""
        place = self._all_orders * frequency_hz / self._bin_hz
        near = (place > self._bins[0] - _REACH_BINS) & (place < self._bins[-1] + _REACH_BINS)
        return np.asarray(self._all_orders[near])


@dataclass(frozen=True, slots=True, eq=False)
class _LineShapes:
    """The factor g of the equation above for unit N, as a product over bins and frames."""

    orders: IntArray  # Successive
    kernel: Float32Array  # Over a hop that of its middle: the frequency moves by a small part of a bin
    turn: Complex64Array

    @classmethod
    def of(
        cls,
        engine: EngineState,
        time_s: FloatArray,
        orders: IntArray,
        bins: IntArray,
        bin_hz: float,
    ) -> "_LineShapes":
        kernel = _signed_kernel(engine.frequencies(time_s.mean()) * orders / bin_hz, bins)
        angle = np.mod(engine.phases(time_s), 2.0 * np.pi)[:, None] * orders
        turn = np.exp(1j * angle).astype(np.complex64)
        return cls(orders, kernel, turn)

    def over_bins(self, turn: Complex64Array, weights: Float32Array | None = None) -> ComplexArray:
        """Spread turns (frames, H) over the bins, with a weight each (bins,): (frames * bins, H)."""
        kernel = self.kernel if weights is None else weights[:, None] * self.kernel
        return np.asarray((turn[:, None, :] * kernel).reshape(-1, len(self.orders)))

    def weighted_gram(self, weights: Float32Array) -> ComplexArray:
        """Return G^H W G with a weight per bin (bins,), without the product over all frames and bins."""
        over_bins = self.kernel.T @ (weights[:, None] * self.kernel)
        return np.asarray((self.turn.conj().T @ self.turn) * over_bins)

    def weighted_moment(self, weights: Float32Array, spectra: Complex64Array) -> ComplexArray:
        """Return G^H W X, (H, M)."""
        adjoint = self.over_bins(self.turn.conj(), weights).T
        return np.asarray(adjoint @ spectra.reshape(-1, spectra.shape[2]))


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Normal equations of the amplitudes."""

    orders: IntArray
    gram: ComplexArray
    moment: ComplexArray
    energy: float  # Weighted sum of |X|^2 per microphone, and the number of values in it
    count: float

    @classmethod
    def of(cls, shapes: _LineShapes, spectra: Complex64Array) -> "_Fit":
        n_frames, n_bins, _ = spectra.shape
        weights = _inverse_power(spectra)
        gram, moment = shapes.weighted_gram(weights), shapes.weighted_moment(weights, spectra)
        # In every bin that is not silent the mean power is one.
        energy = float(n_frames * np.count_nonzero(weights))
        return cls(shapes.orders, gram, moment, energy, float(n_frames * n_bins))

    def _shared(self, other: "_Fit") -> tuple[slice, slice]:
        """Return where both have the same orders; orders are successive."""
        first = max(self.orders[0], other.orders[0])
        count = max(min(self.orders[-1], other.orders[-1]) - first + 1, 0)
        mine, theirs = int(first - self.orders[0]), int(first - other.orders[0])
        return slice(mine, mine + count), slice(theirs, theirs + count)

    def phase_ahead(self, remembered: "_Fit", evident: ComplexArray) -> float:
        """Angle of the fundamental by which this hop is ahead of what is remembered, radians."""
        mine, theirs = self._shared(remembered)
        # Against the moments that the remembered amplitudes would give: nothing has to be solved.
        expected = self.gram[mine, mine] @ evident[theirs]
        turned = np.einsum("hm,hm->h", self.moment[mine], expected.conj()).astype(np.complex128)
        # Pairs of lines of similar strength carry the phase; one loud line without a neighbour does not.
        turned /= np.sqrt(np.abs(turned) + _TINY) * np.einsum("hh->h", self.gram[mine, mine]).real + _TINY
        angle = 0.0
        for step in _ORDER_STEPS:
            if len(turned) > step:
                pairs = np.vdot(turned[:-step], turned[step:])
                angle += cmath.phase(pairs * cmath.exp(-1j * step * angle)) / step
        orders = self.orders[mine]
        rest = turned * np.exp(-1j * orders * angle)
        weight = np.abs(rest) * orders
        correction = float(weight @ np.angle(rest)) / max(float(weight @ orders), _TINY)
        agreement = abs((rest * np.exp(-1j * orders * correction)).sum()) / max(np.abs(rest).sum(), _TINY)
        # Orders that disagree are noise: the loop coasts.
        return (angle + correction) * float(agreement) ** 2

    def turned(self, angle: float) -> "_Fit":
        """Refer to a fundamental whose phase is ahead by an angle."""
        turn = np.exp(-1j * self.orders * angle).astype(self.gram.dtype)
        gram = turn[:, None] * self.gram * turn.conj()
        return _Fit(self.orders, gram, turn[:, None] * self.moment, self.energy, self.count)

    def joined(self, remembered: "_Fit", kept: float) -> "_Fit":
        """Add what is remembered, forgotten by a factor; orders that have left are dropped."""
        mine, theirs = self._shared(remembered)
        gram, moment = self.gram.copy(), self.moment.copy()
        gram[mine, mine] += np.float32(kept) * remembered.gram[theirs, theirs]
        moment[mine] += np.float32(kept) * remembered.moment[theirs]
        energy = self.energy + kept * remembered.energy
        return _Fit(self.orders, gram, moment, energy, self.count + kept * remembered.count)

    def evident_amplitudes(self) -> ComplexArray:
        """Amplitudes (H, M), each shrunk by what noise alone would have left of it."""
        diagonal = np.einsum("hh->h", self.gram).real
        loaded = self.gram + np.diag(_RIDGE * diagonal + _TINY).astype(self.gram.dtype)
        amplitudes = np.linalg.solve(loaded, self.moment)
        explained = float(np.vdot(amplitudes, self.moment).real) / self.moment.shape[1]
        noise = max(self.energy - explained, 1e-6 * self.energy) / self.count
        power = np.square(np.abs(amplitudes)).mean(axis=1) * diagonal
        kept = np.maximum(1.0 - _NO_LINE * noise / np.maximum(power, _TINY), 0.0)
        return np.asarray(amplitudes * kept[:, None].astype(np.float32))


def _signed_kernel(place: FloatArray, bins: IntArray) -> Float32Array:
    r"""Spectrum of the Hann window per sample for lines at `place`, bins, times (-1)^k: (bins, H).

    Examples
    --------
    >>> _signed_kernel(np.array([4.0]), np.array([3, 4, 5, 9])).round(3).ravel() + 0.0
    array([-0.25,  0.5 , -0.25,  0.  ], dtype=float32)
    """
    # sinc(u) / (2 (1 - u^2)) with u = place - k, cut beyond four bins. As sin(pi u) = (-1)^k sin(pi place),
    # the sign goes into one sine a line. Numerator and denominator both vanish at whole distances: stand a
    # hair beside them.
    place = np.where(np.abs(place - np.round(place)) < 1e-6, place + 1e-6, place)
    u = place - bins[:, None]
    kernel = (np.sin(np.pi * place) / (2.0 * np.pi)) / (u * (1.0 - u * u))
    kernel[np.abs(u) >= 4.0] = 0.0
    return kernel.astype(np.float32)


def _inverse_power(spectra: Complex64Array) -> Float32Array:
    """Return the weights that give every bin unit power, (bins,); zero for silent bins."""
    parts = spectra.view(np.float32)
    power = np.einsum("tbm,tbm->b", parts, parts) / np.float32(spectra.shape[0] * spectra.shape[2])
    return np.where(power > _TINY, 1.0 / np.maximum(power, _TINY), 0.0).astype(np.float32)
