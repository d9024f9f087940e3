"""Microphones that stand or move, and what reaches them from places that stand still."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from worldstate.adapters.simulation.scene.ego_motion import ARRAY_HEIGHT_M, EgoMotion
from worldstate.adapters.simulation.scene.octave_bands import resample_whole
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import Float32Array, FloatArray

from .delay import KNOT_SAMPLES, OVERSAMPLING, Table, add_delayed
from .diffraction import SPEED_OF_SOUND_MPS

NEAREST_M = 0.5  # nothing comes nearer to a microphone, and louder
ARRIVAL_ROUNDS = 4


@dataclass(frozen=True, slots=True)
class Receiver:
    """Microphones, how they move, and the times at which they listen."""

    positions_m: FloatArray  # shape (M, 3): In `base_link`, z above the road
    skew_s: FloatArray  # shape (M,): Phase mismatch of every channel as a delay
    knots_s: FloatArray  # shape (K + 1,): Receive times of the knots; K * KNOT_SAMPLES samples are heard
    ego: EgoMotion = field(default_factory=EgoMotion)  # How `base_link` moves along x

    @property
    def samples(self) -> int:
        """Number of samples between the first and the last knot."""
        return (len(self.knots_s) - 1) * KNOT_SAMPLES

    @property
    def sample_rate_hz(self) -> float:
        """Rate at which is heard."""
        return float(KNOT_SAMPLES / (self.knots_s[1] - self.knots_s[0]))

    @property
    def centre_m(self) -> FloatArray:
        """Array's centre in `base_link`, shape (3,)."""
        return np.asarray(self.positions_m.mean(axis=0))

    def above(self, height_m: float) -> float:
        """Height of the array's centre above a source."""
        return float(self.centre_m[2]) - height_m

    def arrivals(
        self, emit_s: FloatArray, length_m: Callable[[FloatArray], FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        r"""Solve a = t + r(x(a)) / c for what is emitted at t and heard at a by an ego at x.

        Shapes: emit_s (T,), length_m (T,).
        """
        x = self.ego.x_m(emit_s)
        length = length_m(x)
        # The ego is far slower than sound: every round is wrong by v / c < 6 % of what the last one was.
        for _ in range(0 if self.ego.stands else ARRIVAL_ROUNDS):
            x = self.ego.x_m(emit_s + length / SPEED_OF_SOUND_MPS)
            length = length_m(x)
        return length, x


def standing_m(array: MicrophoneArray) -> FloatArray:
    """Positions in `base_link`, z above the road, of an array with its centre at `ARRAY_HEIGHT_M`, (M, 3).

    Examples
    --------
    >>> standing_m(MicrophoneArray([[1.0, 0.1, 3.0], [1.0, -0.1, 3.2]])).round(2).tolist()
    [[0.0, 0.1, 1.6], [0.0, -0.1, 1.8]]
    """
    positions = array.centred_m + np.array([0.0, 0.0, ARRAY_HEIGHT_M])
    lowest = float(positions[:, 2].min())
    if lowest <= 0.0:
        got = f"one {ARRAY_HEIGHT_M - lowest:.2f} m below its centre"
        raise InvalidArgumentError(f"array: expected microphones above the road, got {got}")
    return np.asarray(positions)


def distance_m(place_m: FloatArray, x_m: FloatArray, offset_m: FloatArray) -> FloatArray:
    """Distance from a place to a point fixed at `offset_m` on an ego at `x_m` (T,)."""
    across = np.hypot(place_m[1] - offset_m[1], place_m[2] - offset_m[2])
    return np.asarray(np.hypot(place_m[0] - offset_m[0] - x_m, across))


def add_turning(
    out: Float32Array, signal: Float32Array, place_m: FloatArray, gain: FloatArray, receiver: Receiver
) -> None:
    """Spread over the microphones of a moving ego what its centre hears from a place that stands still."""
    if not np.abs(signal).any():
        return
    rate_hz = receiver.sample_rate_hz
    values = resample_whole(signal, OVERSAMPLING)
    table = Table(values, float(receiver.knots_s[0]), rate_hz * OVERSAMPLING)
    x, knots = receiver.ego.x_m(receiver.knots_s), receiver.knots_s
    left = knots - distance_m(place_m, x, receiver.centre_m) / SPEED_OF_SOUND_MPS
    for microphone, position, skew in zip(out, receiver.positions_m, receiver.skew_s, strict=True):
        wanted = knots - skew - distance_m(place_m, x, position) / SPEED_OF_SOUND_MPS
        # What the centre hears before the beginning and after the end is not known.
        heard = np.clip(np.interp(wanted, left, knots), knots[0], knots[-1] - 1.0 / rate_hz)
        add_delayed(microphone, table, heard, gain)
