"""Signatures of a corpus of clips: 16 log-energies each, the labels of the clip, and the informative bands.

Source of the profile, computed for one band at a time: R. A. Fisher, "The use of multiple measurements in
taxonomic problems", 1936.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from worldstate.frontend.hop_spectra import LevelMeter
from worldstate.frontend.settings import FrontEndSettings
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.ground.parallel import in_processes
from worldstate.ground.typing import BoolArray, Float32Array, FloatArray, IndexArray, TextArray

from .traffic_clips import BACKGROUND, ClipLabels, TrafficClip, read_clip

# Band edges are whole bins of 512 samples, so clips with different rates would have different bands: all
# clips are first resampled to the rate of the larger corpus.
RATE_HZ = 48_000.0
# The highest band ends at 8 kHz, which must not exceed 0.45 of the sample rate.
LOWEST_RATE_HZ = 8000.0 / 0.45
MOTOR_VEHICLES = ("car", "truck", "bus", "motorcycle")


_OF_A_CLIP = ("kind", "microphone", "recording", "site", "split")
_COLUMNS = ("energy", "kinds", "microphones", "recordings", "sites", "splits")


@dataclass(frozen=True, slots=True, eq=False)
class ClipSignatures:
    """Signatures and labels, one row per clip."""

    name: str
    energy: FloatArray  # shape (n, 16): Log-energies
    kinds: TextArray  # shape (n,), like the following fields: see `ClipLabels`
    microphones: TextArray
    recordings: TextArray
    sites: TextArray
    splits: TextArray
    left_out: tuple[str, ...] = ()  # Reasons why clips could not be read

    @classmethod
    def of(
        cls, name: str, rows: Sequence[tuple[ClipLabels, FloatArray]], *, left_out: tuple[str, ...] = ()
    ) -> "ClipSignatures":
        """Combine clips into one table."""
        singles = zip(_COLUMNS[1:], _OF_A_CLIP, strict=True)
        labels: dict[str, Any] = {to: np.array([getattr(one, of) for one, _ in rows]) for to, of in singles}
        return cls(name, np.array([energy for _, energy in rows]), left_out=left_out, **labels)

    @property
    def background(self) -> BoolArray:
        """Clips without a vehicle."""
        return np.asarray(self.kinds == BACKGROUND)

    @property
    def motor(self) -> BoolArray:
        """Clips of the vehicle kinds in the roadside corpus, on which models are trained."""
        return np.isin(self.kinds, MOTOR_VEHICLES)

    def select(self, chosen: BoolArray | IndexArray) -> "ClipSignatures":
        """Return these rows."""
        return replace(self, **{name: getattr(self, name)[chosen] for name in _COLUMNS})


@cache
def signature_edges_hz() -> FloatArray:
    """Return the edges of the 16 bands, shape (17,), with a constant ratio from 50 Hz to 8 kHz."""
    return LevelMeter(1, RATE_HZ, FrontEndSettings()).edges_hz


def signature(samples: Float32Array, rate_hz: float) -> FloatArray:
    """Return the log-energy of a clip (n, channels) in every band, shape (16,).

    It is the logarithm of the mean over all frames and channels, so the loudest moment of a passage
    dominates.
    """
    if rate_hz != RATE_HZ:
        from scipy.signal import resample_poly

        common = np.gcd(round(rate_hz), round(RATE_HZ))
        ways = round(RATE_HZ) // common, round(rate_hz) // common
        samples = resample_poly(samples, *ways, axis=0).astype(np.float32)
    return LevelMeter(samples.shape[1], RATE_HZ, FrontEndSettings()).push(samples)


def hear_clips(
    name: str, clips: Sequence[TrafficClip], jobs: int = 1, on_clip: Callable[[], None] = lambda: None
) -> ClipSignatures:
    """Return the signatures of files; damaged files are left out and listed."""
    rows, left_out = [], []
    for clip, heard in zip(clips, in_processes(_heard, clips, jobs), strict=True):
        if isinstance(heard, str):
            left_out.append(heard)
        else:
            rows.append((clip.labels, heard))
        on_clip()
    if not rows:
        raise InputFileError(name, f"expected readable clips; the first one: {left_out[0]}")
    return ClipSignatures.of(name, rows, left_out=tuple(left_out))


def _heard(clip: TrafficClip) -> FloatArray | str:
    try:
        samples, rate_hz = read_clip(clip)
    except InputFileError as error:
        return str(error)
    if rate_hz < LOWEST_RATE_HZ:
        return f"{clip.path}: expected a rate of at least {LOWEST_RATE_HZ:.0f} Hz, got {rate_hz:g}"
    return signature(samples, rate_hz)


@dataclass(frozen=True, slots=True, eq=False)
class BandProfile:
    """Fisher ratio of every band between windows with a vehicle and without one."""

    edges_hz: FloatArray  # shape (B + 1,)
    by_level: FloatArray  # shape (B,): Of the log-energies
    by_shape: FloatArray  # shape (B,): Of their shape, which does not change with gain or range
    range_hz: tuple[float, float]  # Range around the best band by shape: see `discriminative_range_hz`


def band_profile(windows: Iterable[tuple[Float32Array, float]], vehicle: BoolArray) -> BandProfile:
    """Compare the band levels of windows, samples (n, M) at a rate, with and without a vehicle."""
    # All windows use the bands of the first window's rate.
    rows, edges_hz = [], None
    for samples, rate_hz in windows:
        meter = LevelMeter(samples.shape[1], rate_hz, FrontEndSettings())
        edges_hz = meter.edges_hz if edges_hz is None else edges_hz
        if not np.array_equal(meter.edges_hz, edges_hz):
            raise InvalidArgumentError(f"windows: expected a single sample rate, got {rate_hz:g} Hz too")
        rows.append(meter.push(samples))
    if edges_hz is None or min(vehicle.sum(), (~vehicle).sum()) < 2:
        raise InvalidArgumentError("windows: expected at least two with a vehicle and two without")
    energy = np.array(rows)
    shape = level_invariant_shape(energy)
    by_level, by_shape = (fisher_profile(one[vehicle], one[~vehicle]) for one in (energy, shape))
    return BandProfile(edges_hz, by_level, by_shape, discriminative_range_hz(by_shape, edges_hz))


def level_invariant_shape(band_log_energy: FloatArray) -> FloatArray:
    r"""Remove the level from log band energies: the result does not change with gain or range.

    .. math:: s_b = \ln E_b - \frac1B \sum_{b'} \ln E_{b'}

    References
    ----------
    J. Aitchison, "The statistical analysis of compositional data", J. Roy. Statist. Soc. B 44, 1982 (centred
    log-ratio).
    """
    return np.asarray(band_log_energy - band_log_energy.mean(axis=-1, keepdims=True))


def fisher_profile(vehicle: FloatArray, background: FloatArray) -> FloatArray:
    r"""Return the Fisher ratio of every band between two classes.

    .. math:: F_b = \frac{(\mu_{1b} - \mu_{0b})^2}{\sigma_{1b}^2 + \sigma_{0b}^2}

    Parameters
    ----------
    vehicle, background : (n, B), (m, B) float
        One signature per row, for example from `level_invariant_shape`; at least two rows each.

    Returns
    -------
    (B,) float
        >= 0, with unbiased variances; 0 if both classes are the same constant, infinite if they are
        different constants.

    Notes
    -----
    Sampling adds a bias: without any difference the mean ratio is about 1/(2n) + 1/(2m).

    Examples
    --------
    >>> fisher_profile(np.array([[3.0, 0.0], [5.0, 2.0]]), np.array([[0.0, 0.0], [2.0, 2.0]]))
    array([2.25, 0.  ])
    """
    distance = (vehicle.mean(axis=0) - background.mean(axis=0)) ** 2
    spread = vehicle.var(axis=0, ddof=1) + background.var(axis=0, ddof=1)
    constant = np.where(distance > 0, np.inf, 0.0)
    return np.asarray(np.divide(distance, spread, out=constant, where=spread > 0))


def discriminative_range_hz(profile: FloatArray, edges_hz: FloatArray) -> tuple[float, float]:
    r"""Return the contiguous range of bands around the best one whose ratio is at least half of its ratio.

    .. math:: F_b \ge \tfrac12 \max_{b'} F_{b'} \quad \text{for all bands } b \text{ of the range}

    Shapes: profile (B,), edges_hz (B + 1,).
    """
    best = int(np.argmax(profile))
    below = np.flatnonzero(profile < 0.5 * profile[best])
    low = int(below[below < best].max(initial=-1)) + 1
    high = int(below[below > best].min(initial=len(profile)))
    return float(edges_hz[low]), float(edges_hz[high])
