r"""Maximum-likelihood frequency of a single tone.

A coarse search on a zero-padded FFT finds the main lobe, Gauss-Newton steps in (in-phase, quadrature,
frequency) find the maximum of the likelihood in white noise. The tone is fitted as a cosine and a sine, so
that its negative frequency does not bias it.

Source: D. C. Rife and R. R. Boorstyn, "Single-tone parameter estimation from discrete-time observations",
IEEE Trans. IT 20, 1974.
"""

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike

from worldstate.frontend.bounds.cramer_rao import tone_crb_hz2
from worldstate.ground import InvalidArgumentError, wrap_angle
from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.typing import ComplexArray, FloatArray

# Three parameters are fitted; with fewer samples the residual gives no estimate of the noise.
FEWEST_SAMPLES = 8
# A grid of a quarter of the resolution puts the coarse peak within an eighth of it: well inside the main
# lobe.
ZERO_PADDING = 4
# The steps converge quadratically and end by their tolerance, a share of half a resolution; this many are for
# a low SNR.
STEPS, _TOLERANCE = 8, 1e-7
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

    with H the columns :math:`\cos 2\pi f t, \sin 2\pi f t`. One resolution, rate / n, is left out at 0 and at
    rate / 2, where a tone is not distinguishable from an offset.

    Parameters
    ----------
    samples : array_like, shape (n,)
        n >= 8; the noise around the tone is taken for white.
    sample_rate_hz : float
        Samples per second, > 0.

    Returns
    -------
    Tone
        With its SNR: below a threshold (about 15 dB for :math:`\eta N`) the highest peak is noise.

    Raises
    ------
    InvalidArgumentError
        On a wrong shape, non-finite samples or a signal that is zero.

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
    size = scipy.fft.next_fast_len(ZERO_PADDING * len(y), real=True)
    omegas = 2 * np.pi / size * np.arange(size // 2 + 1)
    inside = (omegas >= bounds[0]) & (omegas <= bounds[1])
    coarse = omegas[inside][np.argmax(np.abs(scipy.fft.rfft(y, size))[inside])]
    return _tone(y, *climb(y, float(coarse), bounds), rate)


def climb(y: FloatArray, omega: float, bounds: tuple[float, float]) -> tuple[float, complex]:
    r"""Fit one tone by Gauss-Newton from a coarse peak, unchecked; steps are held within the main lobe.

    .. math:: \omega \leftarrow \omega + \frac{\mathrm{Re}\, g^H r}{g^H g}, \qquad
              r = P^\perp y, \quad g = P^\perp \frac{\partial H}{\partial \omega} \hat a, \quad \hat a = H^+ y

    with P the projection off the columns of H, as in `estimate_tone` (variable projection).

    Shapes: y (n,).
    """
    n: FloatArray = np.arange(len(y), dtype=np.float64) - 0.5 * (len(y) - 1)
    reach = np.pi / len(y)
    for _ in range(STEPS):
        step, fit = _step(y, omega, n)
        target = min(max(omega + min(max(step, -reach), reach), bounds[0]), bounds[1])
        moved, omega = abs(target - omega), target
        if moved < _TOLERANCE * reach:
            break
    return omega, complex(*fit)


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


def _step(y: FloatArray, omega: float, n: FloatArray) -> tuple[float, FloatArray]:
    """Least-squares step in frequency, the amplitude being refitted along with it (variable projection)."""
    # Everything is a product of few rows: the tone's H, its derivative by omega, and y.
    rows = _rows(y, omega, n)
    gram = rows @ rows.T
    # A row of zeros, the sine of 0 Hz, gets no amplitude.
    inner = gram[:2, :2].copy()
    inner.flat[::3] += _ROUNDING * len(y)
    onto = np.linalg.solve(inner, gram[:2, 2:])
    fit = onto[:, 2]
    free = np.concatenate([-(onto[:, :2] @ fit), fit, [0.0]])
    rest = np.concatenate([-fit, [0.0, 0.0, 1.0]])
    image = free @ gram
    size = float(image @ free)
    return float(image @ rest) / size if size > 0.0 else 0.0, np.asarray(fit)


def _rows(y: FloatArray, omega: float, n: FloatArray) -> FloatArray:
    """Columns of H, their derivatives by omega, and y, (5, n)."""
    wave = tone_wave(omega, len(y))
    rows = np.empty((5, len(y)))
    rows[0] = wave.real
    np.negative(wave.imag, out=rows[1])
    np.multiply(rows[1], n, out=rows[2])
    np.multiply(wave.real, -n, out=rows[3])
    rows[4] = y
    return rows


def _tone(y: FloatArray, omega: float, amplitude: complex, rate: float) -> Tone:
    count, size = len(y), abs(amplitude)
    residual = y - (amplitude * tone_wave(omega, count)).real
    # Three parameters are fitted.
    power = float(residual @ residual) / (count - 3)
    snr = size**2 / max(2.0 * power, np.finfo(float).tiny)
    snr = min(max(snr, np.finfo(float).tiny), 1e300)
    std = float(np.sqrt(tone_crb_hz2(snr, count, rate)))
    phase = float(np.angle(amplitude) - omega * 0.5 * (count - 1))
    return Tone(omega * rate / (2 * np.pi), size, wrap_angle(phase), snr, std)
