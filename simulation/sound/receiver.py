"""Standing or moving microphones, and sound on its way to all of them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.fft import next_fast_len

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.octave_bands import resample_whole, smooth_step
from worldstate.simulation.scene.vehicle import ARRAY_HEIGHT_M, EgoMotion

from .delay import KNOT_SAMPLES, PHASES, Emission, Phases, SampledSignal, add_delayed, emission_times
from .diffraction import SPEED_OF_SOUND_MPS

NEAREST_M = 0.5  # Shortest distance to a microphone, which limits the level
ARRIVAL_ROUNDS = 4


@dataclass(frozen=True, slots=True)
class Receiver:
    """Microphones, their motion, and the sample times."""

    positions_m: FloatArray  # shape (M, 3): In `base_link`, z above the road
    skew_s: FloatArray  # shape (M,): Phase mismatch of every channel as a delay
    # shape (K + 1,): Receive times of the knots, between which K * KNOT_SAMPLES samples are rendered
    knots_s: FloatArray
    ego: EgoMotion = field(default_factory=EgoMotion)  # Motion of `base_link` along x

    @property
    def samples(self) -> int:
        """Number of samples between the first and the last knot."""
        return (len(self.knots_s) - 1) * KNOT_SAMPLES

    @property
    def sample_rate_hz(self) -> float:
        """Sample rate."""
        return float(KNOT_SAMPLES / (self.knots_s[1] - self.knots_s[0]))

    @property
    def centre_m(self) -> FloatArray:
        """Array's centre in `base_link`, shape (3,)."""
        return np.asarray(self.positions_m.mean(axis=0))

    @property
    def reach_knots(self) -> int:
        """Number of knots within which sound at the centre reaches all microphones."""
        offsets = np.linalg.norm(self.positions_m - self.centre_m, axis=1) / SPEED_OF_SOUND_MPS
        return int(np.ceil((offsets + np.abs(self.skew_s)).max() * self.sample_rate_hz / KNOT_SAMPLES)) + 1

    def above(self, height_m: float) -> float:
        """Height of the array's centre above a source."""
        return float(self.centre_m[2]) - height_m

    def arrivals(
        self, emit_s: FloatArray, length_m: Callable[[FloatArray], FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        r"""Solve a = t + r(x(a)) / c for sound that is emitted at t and received at a by an ego at x.

        Shapes: emit_s (T,), length_m (T,).
        """
        x = self.ego.x_m(emit_s)
        length = length_m(x)
        # The ego is far slower than sound: each round reduces the error to v / c < 6 % of the last one.
        for _ in range(0 if self.ego.stands else ARRIVAL_ROUNDS):
            x = self.ego.x_m(emit_s + length / SPEED_OF_SOUND_MPS)
            length = length_m(x)
        return length, x


def passed_places(heard_x_m: FloatArray, step_m: float) -> Iterator[tuple[float, slice, FloatArray]]:
    """Yield the evenly spaced places near which an ego at `heard_x_m` (T,) receives the sound.

    Each place comes with the knots of the sound received near it, two more at either end, and its share at
    these knots: 1 at the place, 0 at the next one. The shares sum to one, so that the gains of places blend
    smoothly.

    Examples
    --------
    >>> [(x_m, share.tolist()) for x_m, _, share in passed_places(np.array([-2.0, -1.5, 0.0]), 2.0)]
    [(-2.0, [1.0, 0.75, 0.0]), (0.0, [0.0, 0.25, 1.0])]
    """
    at = heard_x_m / step_m
    for number in range(int(np.floor(at.min())), int(np.ceil(at.max())) + 1):
        share = np.maximum(1.0 - np.abs(at - number), 0.0)
        near = np.flatnonzero(share)
        if len(near):
            span = slice(max(int(near[0]) - 2, 0), int(near[-1]) + 3)
            yield step_m * number, span, share[span]


def standing_m(array: MicrophoneArray) -> FloatArray:
    """Return the positions in `base_link`, z above the road, of an array centred at `ARRAY_HEIGHT_M`, (M, 3).

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
    """Return the distance from a place to a point at `offset_m` on an ego at `x_m` (T,)."""
    across = np.hypot(place_m[1] - offset_m[1], place_m[2] - offset_m[2])
    return np.asarray(np.hypot(place_m[0] - offset_m[0] - x_m, across))


def add_along(
    out: Float32Array,
    table: SampledSignal,
    emit_s: FloatArray,
    travel_m: FloatArray,
    receive_s: FloatArray,
    spread_m: FloatArray | None = None,
) -> None:
    """Add sound that was emitted at `emit_s` and travelled `travel_m`, with loss over that or `spread_m`."""
    emit = emission_times(receive_s, emit_s, travel_m)
    length = np.interp(np.nan_to_num(emit), emit_s, travel_m if spread_m is None else spread_m)
    add_delayed(out, table, emit, 1.0 / np.maximum(length, NEAREST_M))


def add_to_all(
    out: Float32Array,
    emission: Emission,
    gain: FloatArray,
    travel_m: Callable[[FloatArray], FloatArray],
    receiver: Receiver,
    *,
    fades: bool = False,
) -> None:
    """Add a sound with gains (T, 8) to all microphones; `travel_m` returns its path to a position, (T,)."""
    made = emission.table(gain, fades=fades)
    if made is None:
        return
    table, span = made
    # The sound is rendered once, for the centre; every microphone receives it a little earlier or later. A
    # look-up of every sample for each microphone took twice as long.
    knots, step, reach = receiver.knots_s, KNOT_SAMPLES / receiver.sample_rate_hz, receiver.reach_knots
    emit_s, way = emission.knots_s[span], travel_m(receiver.centre_m)[span]
    heard_s = emit_s + way / SPEED_OF_SOUND_MPS
    ends = (heard_s[[0, -1]] - knots[0]) / step + np.array([-reach, reach])
    first, last = (int(end) for end in np.clip(np.rint(ends), -reach, len(knots) - 1 + reach))
    if last <= first:
        return
    centre_s = knots[0] + np.arange(first, last + 1) * step
    values = np.zeros((last - first) * PHASES * KNOT_SAMPLES, np.float32)
    add_along(values, table, emit_s, way, centre_s)
    phases, rows = Phases(values), slice(max(first, 0), min(last, len(knots) - 1))
    at_s = knots[rows.start : rows.stop + 1]
    for microphone, position, skew in zip(out, receiver.positions_m, receiver.skew_s, strict=True):
        own = travel_m(position)[span]
        arrives = emit_s + own / SPEED_OF_SOUND_MPS + skew
        wanted = np.interp(at_s, arrives, heard_s, left=np.nan, right=np.nan) - centre_s[0]
        nearer = np.maximum(way, NEAREST_M) / np.maximum(own, NEAREST_M)
        heard = microphone[rows.start * KNOT_SAMPLES : rows.stop * KNOT_SAMPLES]
        louder = np.interp(at_s[:-1], arrives, nearer)
        phases.add_to(heard, wanted * (receiver.sample_rate_hz * PHASES), louder)


def add_turning(
    out: Float32Array, signal: Float32Array, place_m: FloatArray, gain: FloatArray, receiver: Receiver
) -> None:
    """Spread the sound at the centre of a moving ego over its microphones, for a fixed source position."""
    knots, reach = receiver.knots_s, receiver.reach_knots
    blocks = signal.reshape(-1, KNOT_SAMPLES)
    loud = np.flatnonzero(np.abs(blocks).max(axis=1) * np.maximum(gain[:-1], gain[1:]) > 0.0)
    if not len(loud):
        return
    first, last = int(loud[0]), int(loud[-1]) + 1
    ramp = np.arange(KNOT_SAMPLES) / KNOT_SAMPLES
    factor = gain[first:last, None] + np.diff(gain[first : last + 1])[:, None] * ramp
    # A length with a fast transform; silence at its end costs less.
    part = np.zeros((next_fast_len(last - first + 2 * reach, real=True), KNOT_SAMPLES), np.float32)
    part[reach : reach + last - first] = blocks[first:last] * factor
    phases = Phases(resample_whole(part.ravel(), PHASES))
    rows = slice(max(first - reach, 0), min(last + reach, len(blocks)))
    x, at_s = receiver.ego.x_m(knots), knots[rows.start : rows.stop + 1]
    left = knots - distance_m(place_m, x, receiver.centre_m) / SPEED_OF_SOUND_MPS
    here, even = x[rows.start : rows.stop + 1], np.ones(rows.stop - rows.start)
    step = knots[1] - knots[0]
    for microphone, position, skew in zip(out, receiver.positions_m, receiver.skew_s, strict=True):
        wanted = at_s - skew - distance_m(place_m, here, position) / SPEED_OF_SOUND_MPS
        # The sound at the centre before the beginning and after the end is unknown.
        heard = np.interp(wanted, left, knots, left=np.nan, right=np.nan)
        at = ((heard - knots[0]) / step - (first - reach)) * (KNOT_SAMPLES * PHASES)
        phases.add_to(microphone[rows.start * KNOT_SAMPLES : rows.stop * KNOT_SAMPLES], at, even)


# Length of the blend between the models of both streets; they agree behind the corners, so it has little
# effect.
MOUTH_BLEND_M = 0.5


def in_own_street(site: Site, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
    """Return 1 if a source is between the side walls of the ego's street and 0 beyond its mouth, shape (T,).

    Examples
    --------
    >>> plan = Site("SA1", 2.8, 2.8, 4.0, 10.0, 3.0, 3.0, 6.0)
    >>> in_own_street(plan, np.array([8.0, 3.0, -20.0, -20.0]), np.array([0.0, 0.0, 2.9, 9.0]))
    array([0., 1., 1., 0.])
    """
    before = smooth_step((site.corner_ahead_m - x_m) / MOUTH_BLEND_M)
    gap = np.minimum(site.side_wall_left_m - y_m, y_m + site.side_wall_right_m)
    return np.asarray(before * smooth_step(1.0 + gap / MOUTH_BLEND_M))
