r"""Maximum-likelihood frequency of a single tone.

In white noise the likelihood of a complex tone has its maximum where the periodogram has. A coarse search on
a zero-padded FFT finds the main lobe, Gauss-Newton steps in (in-phase, quadrature, frequency) find the
maximum. A real tone is fitted as a cosine and a sine, so that its negative frequency does not bias it.

Source: D. C. Rife and R. R. Boorstyn, "Single-tone parameter estimation from discrete-time observations",
IEEE Trans. IT 20, 1974.
"""

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike

from worldstate.frontend.bounds.cramer_rao import tone_crb_hz2
from worldstate.frontend.spectra.finite_complex import finite_complex
from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import ComplexArray, FloatArray
from worldstate.ground.values import wrap_angle

# Three parameters are fitted; with fewer samples the residual gives no estimate of the noise.
FEWEST_SAMPLES = 8
# A grid of a quarter of the resolution puts the coarse peak within an eighth of it: well inside the main
# lobe.
ZERO_PADDING = 4
# The steps converge quadratically and end by their tolerance; this many are for a low SNR.
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
        f, Hz; negative only for a complex signal.
    amplitude : float
        Peak amplitude A, unit of the samples.
    phase_rad : float
        Phase at the first sample: A cos(2 pi f t + phase), or A exp(j(2 pi f t + phase)).
    snr : float
        eta: A^2 / (2 sigma^2) for a real signal; A^2 / sigma^2 for a complex one, sigma^2 per quadrature.
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


def estimate_tone(
    samples: ArrayLike,
    sample_rate_hz: float,
    *,
    low_hz: float | None = None,
    high_hz: float | None = None,
) -> Tone:
    r"""Estimate the strongest tone in a band.

    .. math:: \hat f = \arg\max_f \; y^H H (H^H H)^{-1} H^H y

    with H the columns :math:`\cos 2\pi f t, \sin 2\pi f t` for real samples, or :math:`e^{j 2\pi f t}` for
    complex ones, where it is the maximum of the periodogram.

    Parameters
    ----------
    samples : array_like, shape (n,)
        Real or complex, n >= 8; the noise around the tone is taken for white.
    sample_rate_hz : float
        Samples per second, > 0.
    low_hz, high_hz : float, optional
        Band searched, Hz. By default all frequencies; for real samples one resolution, rate / n, is left out
        at 0 and at rate / 2, where a real tone is not distinguishable from an offset.

    Returns
    -------
    Tone
        With its SNR: below a threshold (about 15 dB for :math:`\eta N`) the highest peak is noise.

    Raises
    ------
    InvalidArgumentError
        On a wrong shape, non-finite samples, an empty band or a signal that is zero.

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
    y = finite_complex("samples", samples, (None,)).astype(np.complex128)
    rate = in_range("sample_rate_hz", sample_rate_hz, 0.0, np.inf, open_low=True)
    if len(y) < FEWEST_SAMPLES:
        raise InvalidArgumentError(f"samples: expected at least {FEWEST_SAMPLES}, got {len(y)}")
    if not np.any(y):
        raise InvalidArgumentError("samples: expected a signal, got zeros only")
    real = not np.iscomplexobj(samples)
    low, high = _checked_band(low_hz, high_hz, rate, rate / len(y) if real else -0.5 * rate)
    omega = 2 * np.pi / rate * _coarse_peak(y, rate, low, high)
    # The frequencies of complex samples form a circle: a search of the whole circle has no limits.
    endless = not real and low_hz is None and high_hz is None
    bounds = (-np.inf, np.inf) if endless else (2 * np.pi * low / rate, 2 * np.pi * high / rate)
    return _tone(y.real if real else y, *climb(y.real if real else y, omega, bounds), rate)


def _coarse_peak(y: ComplexArray, rate: float, low: float, high: float) -> float:
    size = scipy.fft.next_fast_len(ZERO_PADDING * len(y))
    power = np.abs(scipy.fft.fft(y, size)) ** 2
    frequency = scipy.fft.fftfreq(size, 1.0 / rate)
    inside = (frequency >= low) & (frequency <= high)
    if not inside.any():
        narrow = f"expected a band wider than {rate / size:.3g} Hz, got {low} .. {high} Hz"
        raise InvalidArgumentError(f"low_hz, high_hz: {narrow}")
    return float(frequency[inside][np.argmax(power[inside])])


def climb(
    y: FloatArray | ComplexArray,
    omega: float,
    bounds: tuple[float, float] = (-np.inf, np.inf),
    tolerance: float = 1e-7,
    steps: int = STEPS,
) -> tuple[float, complex]:
    r"""Fit one tone by Gauss-Newton from a coarse peak, unchecked; steps are held within the main lobe.

    .. math:: \omega \leftarrow \omega + \frac{\mathrm{Re}\, g^H r}{g^H g}, \qquad
              r = P^\perp y, \quad g = P^\perp \frac{\partial H}{\partial \omega} \hat a, \quad \hat a = H^+ y

    with P the projection off the columns of H, as in `estimate_tone` (variable projection).

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
    return omega, complex(fit[0]) if np.iscomplexobj(y) else complex(fit[0], fit[1])


def tone_wave(omega: float, count: int) -> ComplexArray:
    r"""Return a complex wave, n counted from the centre, as a product of two short ones to save exponentials.

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


def _step(
    y: FloatArray | ComplexArray, omega: float, n: FloatArray
) -> tuple[float, FloatArray | ComplexArray]:
    """Least-squares step in frequency, the amplitude being refitted along with it (variable projection)."""
    # Everything is a product of few rows: the tone's H, its derivative by omega, and y.
    rows = _rows(y, omega, n)
    gram = rows.conj() @ rows.T
    k = len(rows) // 2
    # A row of zeros, the sine of 0 Hz, gets no amplitude.
    inner = gram[:k, :k].copy()
    inner.flat[:: k + 1] += _ROUNDING * len(y)
    onto = np.linalg.solve(inner, gram[:k, k:])
    fit = onto[:, k]
    free, rest = np.zeros((2, 2 * k + 1), gram.dtype)
    free[:k], free[k : 2 * k] = -(onto[:, :k] @ fit), fit
    rest[:k], rest[-1] = -fit, 1.0
    image = free.conj() @ gram
    size = float((image @ free).real)
    return float((image @ rest).real) / size if size > 0.0 else 0.0, fit


def _rows(y: FloatArray | ComplexArray, omega: float, n: FloatArray) -> FloatArray | ComplexArray:
    """Columns of H, their derivatives by omega, and y: (3, n) complex, or (5, n) real."""
    wave = tone_wave(omega, len(y))
    if np.iscomplexobj(y):
        return np.asarray(np.stack([wave, 1j * n * wave, y]), np.complex128)
    rows = np.empty((5, len(y)))
    rows[0] = wave.real
    np.negative(wave.imag, out=rows[1])
    np.multiply(rows[1], n, out=rows[2])
    np.multiply(wave.real, -n, out=rows[3])
    rows[4] = y
    return rows


def _tone(y: FloatArray | ComplexArray, omega: float, amplitude: complex, rate: float) -> Tone:
    complex_signal, count, size = np.iscomplexobj(y), len(y), abs(amplitude)
    model = amplitude * tone_wave(omega, count)
    residual = y - (model if complex_signal else model.real)
    # Three real parameters are fitted; a complex sample is worth two real ones.
    power = float(np.vdot(residual, residual).real) / (2 * count - 3 if complex_signal else count - 3)
    snr = size**2 / max(power if complex_signal else 2.0 * power, np.finfo(float).tiny)
    snr = min(max(snr, np.finfo(float).tiny), 1e300)
    std = float(np.sqrt(tone_crb_hz2(snr, count, rate)))
    phase = float(np.angle(amplitude) - omega * 0.5 * (count - 1))
    frequency = wrap_angle(omega) * rate / (2 * np.pi)
    return Tone(frequency, size, wrap_angle(phase), snr, std)


def _checked_band(
    low_hz: float | None, high_hz: float | None, rate: float, lowest: float
) -> tuple[float, float]:
    """Return the band asked for, by default from `lowest` to its mirror image below half the sample rate."""
    highest = 0.5 * rate - max(lowest, 0.0)
    low = lowest if low_hz is None else float(finite_array("low_hz", low_hz, ()))
    high = highest if high_hz is None else float(finite_array("high_hz", high_hz, ()))
    floor = min(lowest, 0.0)
    if not floor <= low < high <= 0.5 * rate:
        raise InvalidArgumentError(
            f"low_hz, high_hz: expected a band within {floor} .. {0.5 * rate} Hz, got {low} .. {high} Hz"
        )
    return low, high
