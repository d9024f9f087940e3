r"""Maximum-likelihood frequency of a single tone.

Rife and Boorstyn: in white noise the likelihood of a complex tone is greatest where the periodogram is. A
coarse search on a zero-padded FFT finds the lobe, Gauss-Newton steps on (in-phase, quadrature, frequency)
climb it. A real tone is fitted as what it is, a cosine and a sine, so that its own negative frequency does
not bias it.

Source: D. C. Rife and R. R. Boorstyn, "Single-tone parameter estimation from discrete-time observations",
IEEE Trans. IT 20, 1974.
"""

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray

from worldstate.checks import finite_array, in_range
from worldstate.errors import InvalidArgumentError
from worldstate.values import wrap_angle

from .bounds import tone_crb_hz2
from .spectra import ComplexArray, finite_complex

FEWEST_SAMPLES = 8
# A grid of a quarter of the resolution puts the coarse peak within an eighth of it: well inside the main
# lobe.
ZERO_PADDING = 4
STEPS = 8


@dataclass(frozen=True, slots=True)
class Tone:
    """One tone and what is left of the signal without it.

    Parameters
    ----------
    frequency_hz : float
        Negative only for a complex signal.
    amplitude : float
        Peak amplitude A.
    phase_rad : float
        At the first sample: A cos(2 pi f t + phase), or A exp(j(2 pi f t + phase)).
    snr : float
        eta: A^2 / (2 sigma^2) for a real signal; A^2 / sigma^2 for a complex one, sigma^2 per quadrature.
    frequency_std_hz : float
        From the bound at this SNR, Hz.
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
    samples : (n,) real or complex
        At least 8; white noise around the tone.
    sample_rate_hz : float
        > 0.
    low_hz, high_hz : float, optional
        Band searched. By default all of it; for real samples one resolution, rate / n, is left out at 0 and
        at rate / 2, where a real tone cannot be told from an offset.

    Returns
    -------
    Tone
        Its SNR says whether to believe it: below a threshold (about 15 dB for :math:`\eta N`) the highest
        peak is noise.

    Raises
    ------
    InvalidArgumentError
        On a wrong shape, non-finite samples, an empty band or a signal that is zero.

    Notes
    -----
    Bound: `worldstate.frontend.bounds.tone_crb_hz2`.

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
    # The frequencies of complex samples form a circle: a search of all of it has no ends to stop at.
    endless = not real and low_hz is None and high_hz is None
    bounds = (-np.inf, np.inf) if endless else (2 * np.pi * low / rate, 2 * np.pi * high / rate)
    return _refined(y.real if real else y, omega, bounds, rate)


def _coarse_peak(y: ComplexArray, rate: float, low: float, high: float) -> float:
    size = scipy.fft.next_fast_len(ZERO_PADDING * len(y))
    power = np.abs(scipy.fft.fft(y, size)) ** 2
    frequency = scipy.fft.fftfreq(size, 1.0 / rate)
    inside = (frequency >= low) & (frequency <= high)
    if not inside.any():
        narrow = f"expected a band wider than {rate / size:.3g} Hz, got {low} .. {high} Hz"
        raise InvalidArgumentError(f"low_hz, high_hz: {narrow}")
    return float(frequency[inside][np.argmax(power[inside])])


def _refined(
    y: NDArray[np.float64] | ComplexArray, omega: float, bounds: tuple[float, float], rate: float
) -> Tone:
    """Gauss-Newton from the coarse peak, steps held within the main lobe."""
    n: NDArray[np.float64] = np.arange(len(y), dtype=np.float64) - 0.5 * (len(y) - 1)
    reach = np.pi / len(y)
    for _ in range(STEPS):
        amplitudes, model, slope = _linear_fit(y, omega, n)
        step = _frequency_step(y - model, slope, omega, n, complex_signal=np.iscomplexobj(y))
        omega = float(np.clip(omega + np.clip(step, -reach, reach), *bounds))
        if abs(step) < 1e-9 * reach:
            break
    amplitudes, model, _ = _linear_fit(y, omega, n)
    return _tone(y - model, amplitudes, omega, rate)


def _basis(omega: float, n: NDArray[np.float64], complex_signal: bool) -> NDArray[np.float64] | ComplexArray:
    wave = np.exp(1j * omega * n)
    return wave[:, None] if complex_signal else np.stack([wave.real, -wave.imag], axis=1)


def _linear_fit(
    y: NDArray[np.float64] | ComplexArray, omega: float, n: NDArray[np.float64]
) -> tuple[ComplexArray, NDArray[np.float64] | ComplexArray, NDArray[np.float64] | ComplexArray]:
    """Complex amplitude at the centre, the fitted tone, and its derivative by the frequency."""
    H = _basis(omega, n, np.iscomplexobj(y))
    fit = np.linalg.lstsq(H, y, rcond=None)[0]
    amplitude = fit if np.iscomplexobj(y) else fit[:1] + 1j * fit[1:]
    wave = amplitude * np.exp(1j * omega * n)
    slope = 1j * n * wave
    return (amplitude, wave, slope) if np.iscomplexobj(y) else (amplitude, wave.real, slope.real)


def _frequency_step(
    residual: NDArray[np.float64] | ComplexArray,
    slope: NDArray[np.float64] | ComplexArray,
    omega: float,
    n: NDArray[np.float64],
    *,
    complex_signal: bool,
) -> float:
    """Least-squares step in frequency, the amplitude being refitted along with it (variable projection)."""
    H = _basis(omega, n, complex_signal)
    free = slope - H @ np.linalg.lstsq(H, slope, rcond=None)[0]
    size = float(np.vdot(free, free).real)
    return float(np.vdot(free, residual).real) / size if size > 0 else 0.0


def _tone(
    residual: NDArray[np.float64] | ComplexArray, amplitude: ComplexArray, omega: float, rate: float
) -> Tone:
    size = float(np.abs(amplitude[0]))
    complex_signal = np.iscomplexobj(residual)
    count = len(residual)
    # Three real parameters are fitted; a complex sample is worth two real ones.
    power = float(np.vdot(residual, residual).real) / (2 * count - 3 if complex_signal else count - 3)
    snr = size**2 / max(power if complex_signal else 2.0 * power, np.finfo(float).tiny)
    snr = min(max(snr, np.finfo(float).tiny), 1e300)
    std = float(np.sqrt(tone_crb_hz2(snr, count, rate)))
    phase = float(np.angle(amplitude[0]) - omega * 0.5 * (count - 1))
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
