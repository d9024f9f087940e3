"""Signatures of a corpus of clips: 16 log-energies each, and what is known of the clip."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from worldstate.frontend.hop_spectra import LevelMeter
from worldstate.frontend.settings import FrontEndSettings
from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import BoolArray, Float32Array, FloatArray, IndexArray, TextArray
from worldstate.simulation.parallel import in_processes

from .traffic_clips import BACKGROUND, ClipLabels, TrafficClip, read_clip

# Bands end at whole bins of 512 samples, so clips of two rates would have different bands: all are brought
# to the rate of the larger corpus first.
RATE_HZ = 48_000.0
# The highest band ends at 8 kHz, where 0.45 of the sample rate must still reach.
LOWEST_RATE_HZ = 8000.0 / 0.45
MOTOR_VEHICLES = ("car", "truck", "bus", "motorcycle")


_COLUMNS = ("energy", "kinds", "microphones", "recordings", "sites", "splits")


@dataclass(frozen=True, slots=True, eq=False)
class ClipSignatures:
    """One row a clip."""

    name: str
    energy: FloatArray  # shape (n, 16): Log-energies
    kinds: TextArray  # shape (n,), as the others: see `ClipLabels`
    microphones: TextArray
    recordings: TextArray
    sites: TextArray
    splits: TextArray
    left_out: tuple[str, ...] = ()  # Why clips could not be heard

    @classmethod
    def of(
        cls,
        name: str,
        rows: Sequence[tuple[ClipLabels, FloatArray]],
        *,
        left_out: tuple[str, ...] = (),
    ) -> "ClipSignatures":
        """Put clips one below the other."""
        labels = [one for one, _ in rows]
        return cls(
            name=name,
            energy=np.array([energy for _, energy in rows]),
            kinds=np.array([one.kind for one in labels]),
            microphones=np.array([one.microphone for one in labels]),
            recordings=np.array([one.recording for one in labels]),
            sites=np.array([one.site for one in labels]),
            splits=np.array([one.split for one in labels]),
            left_out=left_out,
        )

    @property
    def background(self) -> BoolArray:
        """Clips without a vehicle."""
        return np.asarray(self.kinds == BACKGROUND)

    @property
    def motor(self) -> BoolArray:
        """Clips of the kinds that the roadside corpus has, from which signatures are learned."""
        return np.isin(self.kinds, MOTOR_VEHICLES)

    def select(self, chosen: BoolArray | IndexArray) -> "ClipSignatures":
        """Return these rows."""
        return replace(self, **{name: getattr(self, name)[chosen] for name in _COLUMNS})


@cache
def signature_edges_hz() -> FloatArray:
    """Return the edges of the 16 bands, shape (17,), which grow by an equal ratio from 50 Hz to 8 kHz."""
    return LevelMeter(1, RATE_HZ, FrontEndSettings()).edges_hz


def signature(samples: Float32Array, rate_hz: float) -> FloatArray:
    """Return the log-energy of a clip (n, channels) in every band, shape (16,).

    It is the logarithm of the mean over all frames and channels: a passage counts by its loudest moment.
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
    """Return the signatures of files; what is damaged is left out and named."""
    rows, left_out = [], []
    for clip, heard in zip(clips, in_processes(_heard, clips, jobs), strict=True):
        if isinstance(heard, str):
            left_out.append(heard)
        else:
            rows.append((clip.labels, heard))
        on_clip()
    if not rows:
        raise InputFileError(name, f"expected clips that can be read; the first one: {left_out[0]}")
    return ClipSignatures.of(name, rows, left_out=tuple(left_out))


def _heard(clip: TrafficClip) -> FloatArray | str:
    try:
        samples, rate_hz = read_clip(clip)
    except InputFileError as error:
        return str(error)
    if rate_hz < LOWEST_RATE_HZ:
        return f"{clip.path}: expected a rate of at least {LOWEST_RATE_HZ:.0f} Hz, got {rate_hz:g}"
    return signature(samples, rate_hz)
