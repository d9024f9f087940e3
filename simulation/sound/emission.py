"""What moving sources send out, ready to be delayed."""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.scene.octave_bands import split_octaves
from worldstate.simulation.scene.vehicle import SOURCE_HEIGHT_M

from .delay import KNOT_SAMPLES, OVERSAMPLING, Table


@dataclass(frozen=True, slots=True)
class Emission:
    """What a source sends out, split into octave bands between emission knots."""

    bands: Float32Array  # shape (K, 8, KNOT_SAMPLES * OVERSAMPLING): Pressure at 1 m, Pa, oversampled
    start_s: float  # Emission time of the first value
    sample_rate_hz: float  # Rate before oversampling

    @classmethod
    def of(cls, signal: Float32Array, start_s: float, sample_rate_hz: float) -> "Emission":
        """Split `signal`, whose length is a multiple of KNOT_SAMPLES."""
        bands = split_octaves(signal, sample_rate_hz, OVERSAMPLING)
        blocks = bands.reshape(8, -1, KNOT_SAMPLES * OVERSAMPLING).transpose(1, 0, 2)
        return cls(np.ascontiguousarray(blocks), start_s, sample_rate_hz)

    @property
    def knots_s(self) -> FloatArray:
        """Emission times of the knots, shape (K + 1,)."""
        return self.start_s + np.arange(len(self.bands) + 1) * KNOT_SAMPLES / self.sample_rate_hz

    def table(self, gain: FloatArray) -> tuple[Table, slice] | None:
        """Add up the bands, weighted by gains (K + 1, 8) at the knots, over the span where any is not 0."""
        loud = np.flatnonzero(gain.max(axis=1) > 0.0)
        if not len(loud):
            return None
        first, last = max(loud[0] - 1, 0), min(loud[-1] + 2, len(gain))
        span = slice(first, last)
        ends = gain[span].astype(np.float32)
        both = np.matmul(np.stack([ends[:-1], np.diff(ends, axis=0)], axis=1), self.bands[first : last - 1])
        ramp = np.arange(both.shape[2], dtype=np.float32) / np.float32(both.shape[2])
        values = (both[:, 0] + ramp * both[:, 1]).ravel()
        return Table(values, self.knots_s[first], self.sample_rate_hz * OVERSAMPLING), span


@dataclass(frozen=True, slots=True, eq=False)
class MovingSource:
    """A sound and where it comes from."""

    emission: Emission  # Its sound
    # shape (T,): How far ahead it is, at the knots of `emission` if it is not on a lane.
    x_m: float | FloatArray
    y_m: FloatArray  # shape (T,): Its lateral position there
    height_m: float = SOURCE_HEIGHT_M  # Above the road

    @property
    def ahead_m(self) -> FloatArray:
        """How far ahead it is, shape (T,)."""
        return np.asarray(self.x_m + np.zeros_like(self.y_m))
