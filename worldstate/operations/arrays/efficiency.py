r"""Efficiency of the front-end's estimators: Monte-Carlo variance beside the Cramer-Rao bound.

The waves are of the kind that each bound assumes: a tone in white noise, Gaussian noise heard by two
microphones, a plane wave of constant modulus and random phase at an array. Whatever is estimated is estimated
by the functions that the front-end is made of.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.special import gammaincinv

from worldstate.frontend.approach.tone import estimate_tone
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.steering import Steering
from worldstate.frontend.bounds.cramer_rao import (
    bearing_crb_rad2,
    broadside_rad,
    delay_crb_s2,
    endfire_information,
    tone_crb_hz2,
)
from worldstate.frontend.direction.bearing import find_peaks
from worldstate.frontend.direction.gcc import gcc_delays
from worldstate.frontend.direction.srp import srp_phat
from worldstate.ground.blas_threads import one_blas_thread
from worldstate.ground.checks import in_range
from worldstate.ground.typing import ComplexArray, FloatArray
from worldstate.operations.figure_style import GREEN, figure_file, legend_beside

Generator = np.random.Generator

TONE_SAMPLES, TONE_RATE_HZ, TONE_BAND_HZ = 256, 1000.0, (40.0, 460.0)
PAIR_FRAMES, PAIR_BIN_HZ, PAIR_LIMIT_S = 60, 50.0, 3e-3
PAIR_FREQUENCIES_HZ = np.arange(300.0, 1800.0, PAIR_BIN_HZ)
PAIR_DELAY_S = 1.37e-4
# About the array's own broadside.
GRID_RAD = np.radians(np.arange(-90.0, 91.0))
# Truths are spread over one step of the grid, so that its interpolation is tried where it is worst, too.
SPREAD_RAD = float(GRID_RAD[1] - GRID_RAD[0])

# What the library promises of its estimators at high SNR.
PROMISED_DB = 1.5
_INSIDE = 0.9973  # Share of the ratios inside `Efficiency.sampling_db`
# Below its threshold SNR an estimator fails by tens of decibels; the figure is about what lies above.
_MOST_DB = 15.0


@dataclass(frozen=True, slots=True)
class NoisyEstimate:
    """One estimation problem that can be tried at any SNR."""

    name: str  # For the legend
    bound: Callable[[float], float]  # Cramer-Rao bound at an SNR (power ratio), squared units of the error
    error: Callable[[float, Generator], float]  # One estimate less its truth, at an SNR, from a generator


@dataclass(frozen=True, slots=True, eq=False)
class Efficiency:
    r"""Mean squared error beside the bound, one point an abscissa.

    Parameters
    ----------
    name : str
        Of the estimator.
    at : ndarray, shape (n,)
        SNR in dB, or azimuth in radians.
    bound, mean_square : ndarray, shape (n,)
        Cramer-Rao bound and mean squared error, the same squared units.
    trials : int
        Estimates behind each mean.

    Examples
    --------
    >>> two = Efficiency("tone", np.array([0.0, 10.0]), np.ones(2), np.array([2.0, 1.0]), trials=200)
    >>> two.ratio_db.round(2), two.sampling_db()
    (array([3.01, 0.  ]), (-1.38..., 1.22...))
    """

    name: str
    at: FloatArray
    bound: FloatArray
    mean_square: FloatArray
    trials: int

    @property
    def ratio_db(self) -> FloatArray:
        """Mean squared error over the bound, dB, shape (n,)."""
        return np.asarray(10.0 * np.log10(self.mean_square / self.bound))

    def sampling_db(self) -> tuple[float, float]:
        """Return the interval that holds .9973 of the ratios of an efficient Gaussian estimator, dB.

        Three standard deviations, by the chi-square distribution with `trials` degrees of freedom.
        """
        # A chi-square with n degrees of freedom is twice a Gamma(n / 2), whose inverse needs no scipy.stats.
        tails = np.array([1.0 - _INSIDE, 1.0 + _INSIDE]) / 2.0
        low, high = 2.0 * gammaincinv(self.trials / 2.0, tails) / self.trials
        return float(10.0 * np.log10(low)), float(10.0 * np.log10(high))


def measure_over_snr(
    trial: NoisyEstimate,
    snr_db: Sequence[float],
    trials: int,
    rng: Generator,
    on_point: Callable[[], None] = lambda: None,
) -> Efficiency:
    """Try an estimator at several SNRs.

    Parameters
    ----------
    trial : NoisyEstimate
        From `tone_trial`, `delay_trial` or `bearing_trial`.
    snr_db : sequence of float
        SNRs, dB.
    trials : int
        Estimates at each, >= 2.
    rng : numpy.random.Generator
        Draws noise and truths.
    on_point : callable
        Called after each SNR, for progress.

    Returns
    -------
    Efficiency
        Over the SNR in dB.

    Raises
    ------
    InvalidArgumentError
        With fewer than two trials, or an SNR that is no finite number.

    Examples
    --------
    >>> found = measure_over_snr(tone_trial(complex_signal=True), [20.0], 100, np.random.default_rng(0))
    >>> bool(abs(found.ratio_db[0]) < 1.5)
    True
    """
    count = int(in_range("trials", trials, 2, np.inf))
    ratios = [10.0 ** (in_range("snr_db", level, -200.0, 200.0) / 10.0) for level in snr_db]
    squares = []
    with one_blas_thread():
        for ratio in ratios:
            squares.append(_mean_square(trial, ratio, count, rng))
            on_point()
    bounds = np.array([trial.bound(ratio) for ratio in ratios])
    return Efficiency(trial.name, np.array(snr_db, dtype=np.float64), bounds, np.array(squares), count)


def measure_toward_endfire(
    array: MicrophoneArray,
    azimuths_rad: Sequence[float],
    snr_db: float,
    trials: int,
    rng: Generator,
    *,
    frequency_hz: float = 1000.0,
    snapshots: int = 20,
    on_point: Callable[[], None] = lambda: None,
) -> Efficiency:
    """Try the bearing at several azimuths: the lateral corollary, achieved."""
    each = [
        measure_over_snr(
            bearing_trial(array, azimuth_rad=azimuth, frequency_hz=frequency_hz, snapshots=snapshots),
            [snr_db], trials, rng, on_point,
        )
        for azimuth in azimuths_rad
    ]  # fmt: skip
    name = f"SRP-PHAT, {array.n_microphones} microphones"
    bounds, squares = ([getattr(one, key)[0] for one in each] for key in ("bound", "mean_square"))
    return Efficiency(name, np.array(azimuths_rad), np.array(bounds), np.array(squares), trials)


def tone_trial(*, complex_signal: bool) -> NoisyEstimate:
    r"""Frequency of a single tone by `estimate_tone`, against the bound of Rife and Boorstyn, Hz."""
    time_s = np.arange(TONE_SAMPLES) / TONE_RATE_HZ

    def error(eta: float, rng: Generator) -> float:
        frequency_hz, phase_rad = rng.uniform(*TONE_BAND_HZ), rng.uniform(-np.pi, np.pi)
        wave = np.exp(1j * (2.0 * np.pi * frequency_hz * time_s + phase_rad))
        if complex_signal:
            samples = wave + np.sqrt(2.0 / eta) * _circular(rng, TONE_SAMPLES)
        else:
            samples = wave.real + np.sqrt(0.5 / eta) * rng.standard_normal(TONE_SAMPLES)
        return estimate_tone(samples, TONE_RATE_HZ).frequency_hz - float(frequency_hz)

    name = "tone, complex, eta = A^2 / s^2" if complex_signal else "tone, real, eta = A^2 / 2 s^2"
    return NoisyEstimate(name, lambda eta: tone_crb_hz2(eta, TONE_SAMPLES, TONE_RATE_HZ), error)


def delay_trial() -> NoisyEstimate:
    """Delay between two microphones by GCC-PHAT, against eq. (3), seconds."""
    shift = np.exp(-2j * np.pi * PAIR_FREQUENCIES_HZ * PAIR_DELAY_S)
    arrivals = np.stack([shift, np.ones_like(shift)], axis=-1)
    shape = (PAIR_FRAMES, len(PAIR_FREQUENCIES_HZ))
    # The sum over bins as an integral: half a bin added at either end.
    fine = np.linspace(-0.5, len(PAIR_FREQUENCIES_HZ) - 0.5, 2000) * PAIR_BIN_HZ + PAIR_FREQUENCIES_HZ[0]

    def bound(snr: float) -> float:
        coherence = np.full(fine.size, (snr / (1.0 + snr)) ** 2)
        return delay_crb_s2(fine, coherence, PAIR_FRAMES / PAIR_BIN_HZ)

    def error(snr: float, rng: Generator) -> float:
        spectra = _circular(rng, *shape, 1) * arrivals + _circular(rng, *shape, 2) / np.sqrt(snr)
        return float(gcc_delays(spectra, PAIR_FREQUENCIES_HZ, PAIR_LIMIT_S).delay_s[0]) - PAIR_DELAY_S

    return NoisyEstimate("delay, GCC-PHAT", bound, error)


def bearing_trial(
    array: MicrophoneArray, *, azimuth_rad: float = 0.0, frequency_hz: float = 1000.0, snapshots: int = 20
) -> NoisyEstimate:
    """Azimuth by SRP-PHAT on the front-end's grid of one degree, against eq. (4), radians."""
    broadside = broadside_rad(array.positions_m)
    grid, middle = broadside + GRID_RAD, broadside + azimuth_rad
    steering = Steering.towards(array, [frequency_hz], grid)

    def bound(snr: float) -> float:
        return bearing_crb_rad2(array.positions_m, middle, frequency_hz, snr, snapshots)

    def error(snr: float, rng: Generator) -> float:
        truth = middle + SPREAD_RAD * rng.uniform(-0.5, 0.5)
        wave = np.exp(2j * np.pi * rng.uniform(size=(snapshots, 1, 1)))
        heard = wave * array.steering(frequency_hz, truth)[:, :, 0]
        noise = _circular(rng, snapshots, 1, array.n_microphones) / np.sqrt(snr)
        spectrum = srp_phat((heard + noise).astype(np.complex64), steering)
        return find_peaks(spectrum, grid, max_peaks=1)[0].azimuth_rad - truth

    bound(1.0)  # refuses what cannot be tried, before hours of it
    return NoisyEstimate(f"broadside bearing, SRP-PHAT, {array.n_microphones} microphones", bound, error)


def _mean_square(trial: NoisyEstimate, snr: float, trials: int, rng: Generator) -> float:
    return float(np.mean([trial.error(snr, rng) ** 2 for _ in range(trials)]))


def _circular(rng: Generator, *shape: int) -> ComplexArray:
    """Circular complex noise of unit power."""
    return np.asarray(np.sqrt(0.5) * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)))


def write_efficiency_figure(measured: Sequence[Efficiency], path: Path) -> None:
    """Draw mean squared error over bound, dB against dB, and write it by the ending of `path`."""
    with figure_file(path, 9.5, 4.4) as figure:
        axes = figure.subplots()
        low, high = measured[0].sampling_db()
        sampling = f"99.7 % of an efficient estimator,\n{measured[0].trials} trials"
        axes.axhspan(low, high, color="grey", alpha=0.2, lw=0, label=sampling)
        axes.axhline(0.0, color="black", linewidth=0.8, label="Cramer-Rao bound")
        promised = f"promised at high SNR, {PROMISED_DB:g} dB"
        axes.axhline(PROMISED_DB, color="black", linewidth=0.8, linestyle=":", label=promised)
        for one in measured:
            axes.plot(one.at, one.ratio_db, marker="o", markersize=4, label=one.name)
        least = min(low, *(float(np.min(one.ratio_db)) for one in measured))
        axes.set(xlabel="SNR (dB)", ylabel="mean squared error over bound (dB)", ylim=(least - 0.5, _MOST_DB))
        axes.set_title("efficiency of the estimators")
        legend_beside(axes)


def write_endfire_figure(measured: Efficiency, array: MicrophoneArray, title: str, path: Path) -> None:
    """Draw the loss of bearing information toward endfire beside what does not depend on the bearing."""
    fine = np.radians(np.linspace(0.0, 90.0, 181))
    shape = endfire_information(array.positions_m, broadside_rad(array.positions_m) + fine)
    azimuth_deg = np.degrees(measured.at)
    with figure_file(path, 9.0, 5.6) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True)
        upper.plot(azimuth_deg, np.degrees(np.sqrt(measured.bound)), color="black", label="Cramer-Rao bound")
        upper.plot(azimuth_deg, np.degrees(np.sqrt(measured.mean_square)), "o", label=measured.name)
        upper.set(ylabel="bearing error,\nrms (deg)", yscale="log", title=title)
        # A decade is seldom filled: without labels between the powers of ten there would be one or none.
        for axis in ("major", "minor"):
            getattr(upper.yaxis, f"set_{axis}_formatter")("{x:.2g}")
        lower.plot(np.degrees(fine), shape, color="black", label="bearing, bound")
        lower.plot(azimuth_deg, measured.bound.min() / measured.mean_square, "o", label="bearing, achieved")
        lower.axhline(1.0, color=GREEN, linestyle="--", label="radial speed, presence")
        lower.set(ylabel="information,\nshare of the best bearing", ylim=(0.0, None))
        lower.set_xlabel("azimuth from broadside (deg)")
        for axes in (upper, lower):
            legend_beside(axes)
