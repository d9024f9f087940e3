r"""Signatures of band energies: shape without level, and which bands tell vehicles from background.

Source of the profile: R. A. Fisher, "The use of multiple measurements in taxonomic problems", 1936, one band
at a time.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from worldstate.frontend.hop_spectra import LevelMeter
from worldstate.frontend.settings import FrontEndSettings
from worldstate.ground.checks import finite_array
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, Float32Array, FloatArray
from worldstate.operations.figure_style import GREEN, RED, legend_beside

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, slots=True, eq=False)
class BandProfile:
    """Fisher ratio of every band between windows with a vehicle and without one."""

    edges_hz: FloatArray  # shape (B + 1,)
    by_level: FloatArray  # shape (B,): Of the log-energies themselves
    by_shape: FloatArray  # shape (B,): Of their shape, which gain and range do not change
    range_hz: tuple[float, float]  # Around the best band of the shape: see `discriminative_range_hz`


def band_profile(windows: Iterable[tuple[Float32Array, float]], vehicle: BoolArray) -> BandProfile:
    """Compare the band levels of windows, samples (n, M) at a rate, with a vehicle and without one."""
    # All windows need the bands of one rate: the first one's.
    rows, edges_hz = [], None
    for samples, rate_hz in windows:
        meter = LevelMeter(samples.shape[1], rate_hz, FrontEndSettings())
        edges_hz = meter.edges_hz if edges_hz is None else edges_hz
        if not np.array_equal(meter.edges_hz, edges_hz):
            raise InvalidArgumentError(f"windows: expected one sample rate, got {rate_hz:g} Hz too")
        rows.append(meter.push(samples))
    if edges_hz is None:
        raise InvalidArgumentError("windows: expected at least two with a vehicle and two without")
    return profile_of(np.array(rows), vehicle, edges_hz)


def draw_band_profile(axes: "Axes", profile: BandProfile, shaded_hz: tuple[float, float]) -> None:
    """Draw the ratios of a profile over its bands, a range shaded: that of the shape, or the paper's."""
    axes.axvspan(
        *shaded_hz, color=RED, alpha=0.12, linewidth=0, label=f"{shaded_hz[0]:.0f}-{shaded_hz[1]:.0f} Hz"
    )
    axes.stairs(profile.by_level, profile.edges_hz, label="level", baseline=None)
    axes.stairs(profile.by_shape, profile.edges_hz, label="shape", baseline=None, color=GREEN)
    axes.set(xscale="log", xlabel="frequency (Hz)", ylabel="Fisher ratio,\nvehicle against none")
    # Decades alone would leave a span of two of them with three labels.
    axes.set_xlim(profile.edges_hz[0], profile.edges_hz[-1])
    axes.set_xticks([50, 100, 300, 1000, 1800, 4000, 8000], ["50", "100", "300", "1k", "1.8k", "4k", "8k"])
    axes.minorticks_off()
    axes.set_ylim(bottom=0.0)
    legend_beside(axes)


def profile_of(energy: FloatArray, vehicle: BoolArray, edges_hz: FloatArray) -> BandProfile:
    """Compare log-energies (n, B) with a vehicle and without one."""
    shape = level_invariant_shape(energy)
    by_level, by_shape = (fisher_profile(one[vehicle], one[~vehicle]) for one in (energy, shape))
    return BandProfile(edges_hz, by_level, by_shape, discriminative_range_hz(by_shape, edges_hz))


def level_invariant_shape(band_log_energy: ArrayLike) -> FloatArray:
    r"""Remove the level from log band energies: what remains does not change with gain or range.

    .. math:: s_b = \ln E_b - \frac1B \sum_{b'} \ln E_{b'}

    References
    ----------
    J. Aitchison, "The statistical analysis of compositional data", J. Roy. Statist. Soc. B 44, 1982 (centred
    log-ratio).
    """
    energy = finite_array("band_log_energy", band_log_energy, (None,) * np.ndim(band_log_energy))
    if energy.ndim == 0 or energy.shape[-1] < 2:
        raise InvalidArgumentError(f"band_log_energy: expected at least 2 bands, got shape {energy.shape}")
    return np.asarray(energy - energy.mean(axis=-1, keepdims=True))


def fisher_profile(vehicle: ArrayLike, background: ArrayLike) -> FloatArray:
    r"""Fisher ratio of every band between two classes.

    .. math:: F_b = \frac{(\mu_{1b} - \mu_{0b})^2}{\sigma_{1b}^2 + \sigma_{0b}^2}

    Parameters
    ----------
    vehicle, background : (n, B), (m, B) float
        One signature a row, for example of `level_invariant_shape`; at least two rows each.

    Returns
    -------
    (B,) float
        >= 0, with unbiased variances; 0 where both classes are the same constant, infinite where two
        constants differ.

    Raises
    ------
    InvalidArgumentError
        On a wrong shape, too few rows or non-finite values.

    Notes
    -----
    Sampling lifts it: without any difference its mean is about 1/(2n) + 1/(2m).

    Examples
    --------
    >>> fisher_profile([[3.0, 0.0], [5.0, 2.0]], [[0.0, 0.0], [2.0, 2.0]])
    array([2.25, 0.  ])
    """
    one = finite_array("vehicle", vehicle, (None, None))
    zero = finite_array("background", background, (None, one.shape[1]))
    if min(len(one), len(zero)) < 2:
        raise InvalidArgumentError(f"expected at least 2 rows of each class, got {len(one)} and {len(zero)}")
    distance = (one.mean(axis=0) - zero.mean(axis=0)) ** 2
    spread = one.var(axis=0, ddof=1) + zero.var(axis=0, ddof=1)
    constant = np.where(distance > 0, np.inf, 0.0)
    return np.asarray(np.divide(distance, spread, out=constant, where=spread > 0))


def discriminative_range_hz(
    profile: ArrayLike, edges_hz: ArrayLike, share: float = 0.5
) -> tuple[float, float]:
    r"""Find the contiguous range of bands around the best one whose ratio is at least a share of it.

    .. math:: F_b \ge s\, \max_{b'} F_{b'} \quad \text{for all bands } b \text{ of the range}

    Shapes: profile (B,), edges_hz (B + 1,).
    """
    ratio = finite_array("profile", profile, (None,))
    edges = finite_array("edges_hz", edges_hz, (len(ratio) + 1,))
    if len(ratio) == 0 or np.any(np.diff(edges) <= 0) or not 0 < share <= 1:
        raise InvalidArgumentError("expected at least one band, ascending edges and a share in (0, 1]")
    best = int(np.argmax(ratio))
    below = np.flatnonzero(ratio < share * ratio[best])
    low = int(below[below < best].max(initial=-1)) + 1
    high = int(below[below > best].min(initial=len(ratio)))
    return float(edges[low]), float(edges[high])
