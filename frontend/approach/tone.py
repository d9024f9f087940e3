r"""Maximum-likelihood frequency of a single tone, and the engine line of a stream.

A coarse search on a zero-padded FFT finds the main lobe. Gauss-Newton steps in (in-phase, quadrature,
frequency) then find the maximum of the likelihood in white noise. The tone is fitted as a cosine and a sine,
so that its negative frequency does not bias it.

Source: D. C. Rife and R. R. Boorstyn, "Single-tone parameter estimation from discrete-time observations",
IEEE Trans. IT 20, 1974.
"""

from dataclasses import dataclass

import numpy as np
from numpy.fft import rfft
from numpy.typing import ArrayLike

from worldstate.frontend.array.microphone_array import ChannelMask, MicrophoneArray
from worldstate.frontend.bounds.cramer_rao import tone_crb_hz2
from worldstate.frontend.spectra.resampling import Decimator
from worldstate.frontend.spectra.stft import fast_length, power
from worldstate.ground import InvalidArgumentError, NotUsable, wrap_angle
from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.typing import BoolArray, ComplexArray, Float32Array, FloatArray
from worldstate.ground.values import vertex

# Three parameters are fitted; with fewer samples the residual gives no estimate of the noise.
FEWEST_SAMPLES = 8
# A grid of a quarter of the resolution places the coarse peak within an eighth of it, well inside the main
# lobe.
ZERO_PADDING = 4
# The steps converge quadratically and end at a tolerance; this many are needed only at a low SNR.
STEPS = 8
# Ridge of the 2 x 2 normal equations, which are singular for a tone at 0 Hz.
_ROUNDING = 4.0 * float(np.finfo(np.float64).eps)


@dataclass(frozen=True, slots=True)
class Tone:
    r"""One tone in white noise.

    .. math:: x_n = A \cos(2\pi f n / f_s + \varphi) + \epsilon_n

    Parameters
    ----------
    frequency_hz : float
        f, Hz.
    amplitude : float
        Peak amplitude A, unit of the samples.
    phase_rad : float
        Phase at the first sample.
    snr : float
        eta: A^2 / (2 sigma^2).
    frequency_std_hz : float
        Cramer-Rao bound at this SNR, Hz.

    Examples
    --------
    >>> Tone(frequency_hz=123.4, amplitude=2.0, phase_rad=0.5, snr=40.0, frequency_std_hz=0.01).snr
    40.0
    """

    frequency_hz: float
    amplitude: float
    phase_rad: float
    snr: float
    frequency_std_hz: float


def estimate_tone(samples: ArrayLike, sample_rate_hz: float) -> Tone:
    r"""Estimate the strongest tone.

    .. math:: \hat f = \arg\max_f \; y^T H (H^T H)^{-1} H^T y

    where H has the columns :math:`\cos 2\pi f t, \sin 2\pi f t`. One resolution, rate / n, is excluded at 0
    and at rate / 2, where a tone cannot be distinguished from an offset.

    Parameters
    ----------
    samples : array_like, shape (n,)
        n >= 8; the noise around the tone is assumed to be white.
    sample_rate_hz : float
        Samples per second, > 0.

    Returns
    -------
    Tone
        Tone with its SNR; below a threshold (about 15 dB for :math:`\eta N`) the highest peak is noise.

    Raises
    ------
    InvalidArgumentError
        If the shape is wrong, samples are not finite or all samples are zero.

    Notes
    -----
    Bound: `worldstate.frontend.bounds.cramer_rao.tone_crb_hz2`.

    References
    ----------
    D. C. Rife and R. R. Boorstyn, "Single-tone parameter estimation from discrete-time observations", IEEE
    Trans. IT 20, 1974.

    Examples
    --------
    >>> t = np.arange(480) / 4800.0
    >>> tone = estimate_tone(2.0 * np.cos(2 * np.pi * 123.4 * t + 0.5), 4800.0)
    >>> round(tone.frequency_hz, 6), round(tone.amplitude, 6), round(tone.phase_rad, 6)
    (123.4, 2.0, 0.5)
    """
    y = finite_array("samples", samples, (None,))
    rate = in_range("sample_rate_hz", sample_rate_hz, 0.0, np.inf, open_low=True)
    if len(y) < FEWEST_SAMPLES:
        raise InvalidArgumentError(f"samples: expected at least {FEWEST_SAMPLES}, got {len(y)}")
    if not np.any(y):
        raise InvalidArgumentError("samples: expected a signal, got zeros only")
    resolution = 2 * np.pi / len(y)
    bounds = resolution, np.pi - resolution
    size = fast_length(ZERO_PADDING * len(y))
    omegas = 2 * np.pi / size * np.arange(size // 2 + 1)
    inside = (omegas >= bounds[0]) & (omegas <= bounds[1])
    coarse = omegas[inside][np.argmax(np.abs(rfft(y, size))[inside])]
    omega, amplitude, residual = climb(y, float(coarse), bounds)
    # The fit has three parameters.
    power = float(residual @ residual) / (len(y) - 3)
    snr = abs(amplitude) ** 2 / max(2.0 * power, np.finfo(float).tiny)
    snr = min(max(snr, np.finfo(float).tiny), 1e300)
    std = float(np.sqrt(tone_crb_hz2(snr, len(y), rate)))
    phase = float(np.angle(amplitude) - omega * 0.5 * (len(y) - 1))
    return Tone(omega * rate / (2 * np.pi), abs(amplitude), wrap_angle(phase), snr, std)


def climb(
    y: FloatArray, omega: float, bounds: tuple[float, float], tolerance: float = 1e-7, steps: int = STEPS
) -> tuple[float, complex, FloatArray]:
    r"""Fit one tone by Gauss-Newton from a coarse peak; return frequency, amplitude and residual of y.

    .. math:: \omega \leftarrow \omega + \frac{\mathrm{Re}\, g^H r}{g^H g}, \qquad
              r = P^\perp y, \quad g = P^\perp \frac{\partial H}{\partial \omega} \hat a, \quad \hat a = H^+ y

    with P the projection onto the complement of the columns of H, as in `estimate_tone` (variable
    projection). Steps are limited to the main lobe. The arguments are not checked.

    Shapes: y (n,).
    """
    n: FloatArray = np.arange(len(y), dtype=np.float64) - 0.5 * (len(y) - 1)
    reach = np.pi / len(y)
    for _ in range(steps):
        step, fit = _step(y, omega, n)
        target = min(max(omega + min(max(step, -reach), reach), bounds[0]), bounds[1])
        moved, omega = abs(target - omega), target
        if moved < tolerance * reach:
            break
    amplitude = complex(*fit)
    return omega, amplitude, y - (amplitude * tone_wave(omega, len(y))).real


def tone_wave(omega: float, count: int) -> ComplexArray:
    r"""Return a complex wave, n counted from the centre; a product of two short waves saves exponentials.

    .. math:: z_n = e^{j \omega (n - (N - 1) / 2)}

    Examples
    --------
    >>> np.angle(tone_wave(0.1, 2)).round(3)
    array([-0.05,  0.05])
    """
    width = int(np.sqrt(count)) + 1
    fine = np.exp(1j * omega * np.arange(width))
    coarse = np.exp(1j * omega * (width * np.arange(width) - 0.5 * (count - 1)))
    return np.asarray(np.multiply.outer(coarse, fine).ravel()[:count])


def _step(y: FloatArray, omega: float, n: FloatArray) -> tuple[float, FloatArray]:
    """Return the least-squares step in frequency with a refitted amplitude (variable projection)."""
    # All values are products of five rows: the tone's H, its derivative with respect to omega, and y.
    wave = tone_wave(omega, len(y))
    rows = np.stack([wave.real, -wave.imag, -wave.imag * n, wave.real * -n, y])
    gram = rows @ rows.T
    # The ridge gives a row of zeros, the sine at 0 Hz, no amplitude.
    inner = gram[:2, :2].copy()
    inner.flat[::3] += _ROUNDING * len(y)
    onto = np.linalg.solve(inner, gram[:2, 2:])
    fit = onto[:, 2]
    free = np.concatenate([-(onto[:, :2] @ fit), fit, [0.0]])
    rest = np.concatenate([-fit, [0.0, 0.0, 1.0]])
    image = free @ gram
    size = float(image @ free)
    return float(image @ rest) / size if size > 0.0 else 0.0, np.asarray(fit)


# Firing frequencies of road vehicles, from an idling single-cylinder motorcycle to a car at high revolutions.
ENGINE_BAND_HZ = (20.0, 400.0)
# Length of the fit, and number of averaged microphones: those near the centre of the array are within a
# fraction of a wavelength at engine frequencies.
_WINDOW_S, _MOST_CHANNELS = 1.0, 4
# Bins per resolution, fine enough to start within the main lobe; resolutions per block of the coarse floor.
_PADDING = 2
_BLOCK = 24
# Range of resolutions around the line whose median is its floor; it begins beyond the side lobes of the line.
_RING = (5, 40)
# Smallest ratio of peak to floor, A^2 N / 4 sigma^2, or 15.6 dB for eta N. White noise exceeds it in one of a
# thousand windows.
_EVIDENT = 18.0
# In white noise, the residual near a line has up to twice the power of the surroundings. More power comes
# from the line itself: for a frequency that varies by 0.2 to 1 %, the error is 2.5 times that of white noise
# with this power.
_CHANCE, _WANDER = 2.0, 6.0
# Tolerance of the refinement as a share of a resolution, the bound for an eta N of 80 dB. From the vertex of
# a parabola two steps are sufficient; if three do not converge, there is no tone.
_TOLERANCE, _STEPS = 1e-4, 3
# Lowest frequency in periods per window; below, a tone cannot be distinguished from an offset.
_FEWEST_PERIODS = 4.0
# Ratio of median and mean of an exponential variable: converts a median of powers to the noise power.
MEDIAN_OF_EXPONENTIAL = float(np.log(2.0))


@dataclass(frozen=True, slots=True)
class ToneReading:
    """A tone above the noise.

    Examples
    --------
    >>> ToneReading(61.2, 0.02, 0.5).frequency_hz
    61.2
    """

    frequency_hz: float  # Mean over the window, relative to the stream's nominal sample rate
    frequency_std_hz: float  # Standard deviation of this mean
    snr: float  # eta = A^2 / 2 sigma^2 per decimated sample; sigma^2 from the noise around and near the line


class ToneStage:
    r"""Fits a tone to the last second of one averaged channel.

    Some microphones near the centre of the array are averaged. At engine frequencies they are within a
    fraction of a wavelength, so a tone from any direction adds up. A `Decimator` reduces the band to about
    1200 samples per second. A Hann window over the last second keeps harmonics and rumble from leaking into
    the tone. The peak with the highest ratio to the surrounding noise is then refined as in `estimate_tone`.

    The noise floor is the median power around the line or the residual near it, whichever is larger: a
    varying frequency or a hump of coloured noise leaves most of its power as residual. The standard deviation
    is the bound of Rife and Boorstyn at this signal-to-noise ratio, with a larger weight for the residual of
    a varying frequency.
    """

    def __init__(
        self, array: MicrophoneArray, sample_rate_hz: float, band_hz: tuple[float, float] = ENGINE_BAND_HZ
    ) -> None:
        low, high = band_hz
        in_range("tone_band_hz: lower end", low, _FEWEST_PERIODS / _WINDOW_S, high, open_high=True)
        in_range("tone_band_hz: upper end", high, low, 0.5 * sample_rate_hz, open_high=True)
        self._array = array
        self._set_microphones(np.ones(array.n_microphones, bool))
        self._decimator = Decimator(sample_rate_hz, high)
        self._rate = self._decimator.rate_hz
        self._n_out = 0
        # The number of outputs that always fit into the samples of a window.
        n_samples, n_taps = _WINDOW_S * sample_rate_hz, self._decimator.n_taps
        count = int((n_samples - n_taps) // self._decimator.factor)
        if count < 2 * _PADDING * _RING[1]:
            expected = f"a filter well below {n_samples:.0f} samples"
            raise InvalidArgumentError(f"tone_band_hz: expected {expected}, got {n_taps}")
        self._band_samples: FloatArray = np.zeros(count)
        self._spectrum = _Spectrum(len(self._band_samples), self._rate, band_hz)

    def push(self, samples: Float32Array, mask: ChannelMask) -> None:
        r"""Process the samples of a hop (n, M); the mask selects microphones.

        .. math:: y[m] = \sum_n h[n]\, \frac1{|C|} \sum_{i \in C} x_i[m D + n]

        """
        # C are the usable microphones nearest to the centre.
        if not np.array_equal(mask.keep, self._keep):
            self._set_microphones(mask.keep)
        new = self._decimator.push(samples @ self._weights)
        self._n_out += len(new)
        self._band_samples = np.concatenate([self._band_samples, new])[len(new) :]

    def read(self) -> ToneReading | NotUsable:
        r"""Fit the line in the window that ends with the last hop.

        .. math:: \hat f = \arg\max_f \; y^H H (H^H H)^{-1} H^H y, \qquad
                  \eta = \frac{|\hat A|^2}{2 \hat\sigma^2}, \qquad
                  \sigma_f^2 = \frac{12\, f_s^2}{(2\pi)^2\, \eta\, N (N^2 - 1)}

        It is usable if :math:`\eta N / 2 > 18`.
        """
        if self._n_out < len(self._band_samples):
            return NotUsable(f"needs {len(self._band_samples) / self._rate:.2f} s of sound")
        if not self._band_samples.any():
            return NotUsable("silence")
        sound = self._band_samples - self._spectrum.offset(self._band_samples)
        power = self._spectrum.power(sound)
        begin, band = self._spectrum.peak(power), self._spectrum.omega_range
        omega, amplitude, rest = climb(sound, begin, band, _TOLERANCE, _STEPS)
        around, beside = self._spectrum.floor_near(power, omega), self._spectrum.beside(rest, omega)
        snr = 0.5 * abs(amplitude) ** 2 / max(around, beside)
        if not 0.5 * snr * len(sound) > _EVIDENT:
            return NotUsable("no tone above the noise")
        noise = around + _WANDER * max(beside - _CHANCE * around, 0.0)
        std = float(np.sqrt(tone_crb_hz2(0.5 * abs(amplitude) ** 2 / noise, len(sound), self._rate)))
        return ToneReading(omega * self._rate / (2.0 * np.pi), std, snr)

    def _set_microphones(self, keep: BoolArray) -> None:
        """Select the usable microphones nearest to the centre for the average."""
        chosen = self._array.nearest(keep)[:_MOST_CHANNELS]
        self._keep, self._weights = keep.copy(), np.zeros(len(keep), np.float32)
        self._weights[chosen] = 1.0 / len(chosen)


class _Spectrum:
    """Hann-windowed, zero-padded power around a band, in units of the mean square of white noise."""

    def __init__(self, n_samples: int, rate: float, band_hz: tuple[float, float]) -> None:
        hann = np.hanning(n_samples + 2)[1:-1]
        self._window = hann / np.sqrt(np.square(hann).sum())
        self._size = fast_length(_PADDING * n_samples)
        self._step = float(2.0 * np.pi / self._size)
        low, high = (2.0 * np.pi * f / rate for f in band_hz)
        self.omega_range = (low, high)
        self._band = slice(int(np.ceil(low / self._step)), int(high / self._step) + 1)

    def offset(self, sound: FloatArray) -> float:
        """Return the mean under the window; a tone of a few periods does not contribute to it."""
        return float(self._window @ sound) / float(self._window.sum())

    def power(self, sound: FloatArray) -> FloatArray:
        return power(rfft(sound * self._window, self._size))

    def peak(self, power: FloatArray) -> float:
        """Return the frequency (rad per sample) of the highest power over its block median."""
        inside = power[self._band]
        width = min(_PADDING * _BLOCK, len(inside))
        n_blocks = len(inside) // width
        blocks = inside[: n_blocks * width].reshape(n_blocks, width)
        floor = np.partition(blocks, width // 2, axis=1)[:, width // 2] + _least(power)
        ratio = inside / np.repeat(floor, width)[np.minimum(np.arange(len(inside)), n_blocks * width - 1)]
        index = self._band.start + int(np.argmax(ratio))
        near = np.log(power[index - 1 : index + 2] + _least(power))
        return self._step * (index + min(max(vertex(*near.tolist()), -0.5), 0.5))

    def floor_near(self, power: FloatArray, omega: float) -> float:
        """Return the mean square of white noise that would have the median power around a line."""
        centre = round(omega / self._step)
        inner, outer = (_PADDING * r for r in _RING)
        below = power[max(centre - outer, 1) : max(centre - inner, 1)]
        above = power[centre + inner : centre + outer]
        around = np.sort(np.concatenate([below, above]))
        return float(around[len(around) // 2]) / MEDIAN_OF_EXPONENTIAL + _least(power)

    def beside(self, rest: FloatArray, omega: float) -> float:
        """Return the mean power of the residual near a removed line, within the reach of its lobes."""
        centre, reach = round(omega / self._step), _PADDING * _RING[0]
        return float(self.power(rest)[max(centre - reach, 1) : centre + reach + 1].mean())


def _least(power: FloatArray) -> float:
    """Return the rounding noise of single-precision input."""
    return float(np.finfo(np.float32).eps ** 2 * power.max()) + np.finfo(np.float64).tiny
