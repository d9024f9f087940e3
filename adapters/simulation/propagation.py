"""A moving source carried along every path to every microphone."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .bands import split_octaves
from .delay import KNOT_SAMPLES, OVERSAMPLING, Table, add_delayed, emission_times
from .diffraction import SPEED_OF_SOUND_MPS
from .paths import LEFT, RIGHT, Path, ReceiverImage, receiver_images, trace_paths
from .presets import Preset
from .scatter import NEAREST_M, FirstLeg, first_legs, last_leg, patches, scattering
from .scene import Site
from .static_field import add_static
from .vehicle import SOURCE_HEIGHT_M

Array = NDArray[np.float64]
Signal = NDArray[np.float32]

TYPICAL_LEG_M = 8.0  # source to corner; only the tilt of the last leg depends on it
FAINTEST = 1e-3  # a path below this share of the whole is left out


@dataclass(frozen=True, slots=True)
class Emission:
    """What a source sends out, split into octave bands between emission knots.

    Parameters
    ----------
    bands : ndarray, shape (K, 8, KNOT_SAMPLES * OVERSAMPLING)
        Pressure at 1 m, Pa, oversampled.
    start_s : float
        Emission time of the first value.
    sample_rate_hz : float
        Rate before oversampling.
    """

    bands: Signal
    start_s: float
    sample_rate_hz: float

    @classmethod
    def of(cls, signal: Signal, start_s: float, sample_rate_hz: float) -> "Emission":
        """Split `signal`, whose length is a multiple of KNOT_SAMPLES."""
        bands = split_octaves(signal, sample_rate_hz, OVERSAMPLING)
        blocks = bands.reshape(8, -1, KNOT_SAMPLES * OVERSAMPLING).transpose(1, 0, 2)
        return cls(np.ascontiguousarray(blocks), start_s, sample_rate_hz)

    @property
    def knots_s(self) -> Array:
        """Emission times of the knots, shape (K + 1,)."""
        return self.start_s + np.arange(len(self.bands) + 1) * KNOT_SAMPLES / self.sample_rate_hz

    def table(self, gain: Array) -> tuple[Table, slice] | None:
        """Add up the bands, weighted by gains (K + 1, 8) at the knots, over the span where any is not 0.

        Returns
        -------
        (Table, slice) or None
            The signal and the knots that it covers; None where every gain is 0.
        """
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


@dataclass(frozen=True, slots=True)
class Receiver:
    """Microphones and the times at which they listen.

    Parameters
    ----------
    positions_m : ndarray, shape (M, 3)
        In `base_link`.
    skew_s : ndarray, shape (M,)
        Phase mismatch of every channel as a delay.
    knots_s : ndarray, shape (K + 1,)
        Receive times of the knots; K * KNOT_SAMPLES samples are heard.
    """

    positions_m: Array
    skew_s: Array
    knots_s: Array

    @property
    def samples(self) -> int:
        """Number of samples between the first and the last knot."""
        return (len(self.knots_s) - 1) * KNOT_SAMPLES

    @property
    def height_m(self) -> float:
        """Height of the array's centre above the sources."""
        return float(self.positions_m[:, 2].mean()) - SOURCE_HEIGHT_M


def add_source(
    out: Signal,
    emission: Emission,
    lane_x_m: float,
    source_y_m: Array,
    site: Site,
    receiver: Receiver,
    cap_db: float,
    specular: Array | None = None,
) -> None:
    """Add one moving source, by every path, to all microphones.

    Parameters
    ----------
    out : ndarray, shape (M, K * KNOT_SAMPLES)
        Pa, float32, added to in place.
    emission : Emission
        Its sound.
    lane_x_m : float
        Distance ahead of the lane along which it moves.
    source_y_m : ndarray, shape (T,)
        Its lateral position at the knots of `emission`.
    site : Site
        The junction.
    receiver : Receiver
        Microphones and receive times.
    cap_db : float
        Largest screen attenuation.
    specular : ndarray, shape (8,), optional
        Share of the amplitude per octave that a wall reflects as a mirror; one if not given.
    """
    paths = trace_paths(site, lane_x_m, source_y_m, receiver.height_m, cap_db, specular=specular)
    images = receiver_images(site)
    bent = np.zeros((len(images), 2, receiver.samples), np.float32)
    for path in _audible(paths):
        for edge in (LEFT, RIGHT):
            _add_bent(bent[images.index(path.receiver), edge], emission, path, edge, receiver.knots_s)
        _add_lit(out, emission, path, source_y_m, receiver)
    _add_corners(out, bent, images, site, receiver, emission.sample_rate_hz)


def add_scattered(
    out: Signal,
    emission: Emission,
    source_x_m: float | Array,
    source_y_m: Array,
    site: Site,
    receiver: Receiver,
    preset: Preset,
) -> None:
    """Add what rough walls send on of one moving source, from where they stand, to all microphones.

    Parameters
    ----------
    out, emission, site, receiver
        As for `add_source`.
    source_x_m, source_y_m : float or ndarray, ndarray, shape (T,)
        Where the source is at the knots of `emission`.
    preset : Preset
        Scattering coefficient and largest screen attenuation.
    """
    amplitude = np.sqrt(scattering(preset))
    if not amplitude.any():
        return
    for group in patches(site):
        arrived = np.zeros((len(group.strengths_m), receiver.samples), np.float32)
        for index, signal in enumerate(arrived):
            for leg in first_legs(
                site, group, index, source_x_m, source_y_m, SOURCE_HEIGHT_M, preset.screen_cap_db
            ):
                _add_leg(signal, emission, leg, amplitude, receiver, group.positions_m[index])
        distance, gain = last_leg(group, receiver.positions_m)
        centre = _to_centre(group.positions_m, receiver)
        delays = (distance - centre[:, None]) / SPEED_OF_SOUND_MPS + receiver.skew_s
        add_static(out, arrived, delays, emission.sample_rate_hz, gain)


def _to_centre(positions_m: Array, receiver: Receiver) -> Array:
    return np.asarray(np.linalg.norm(positions_m - receiver.positions_m.mean(axis=0), axis=1))


def _add_leg(
    out: Signal, emission: Emission, leg: FirstLeg, amplitude: Array, receiver: Receiver, patch_m: Array
) -> None:
    """Add what one patch sends on, as late as the array's centre hears it."""
    made = emission.table(leg.gain * amplitude)
    if made is None:
        return
    table, span = made
    knots, onward = emission.knots_s[span], _to_centre(patch_m[None], receiver)[0]
    emit = emission_times(receiver.knots_s, knots, leg.length_m[span] + onward, SPEED_OF_SOUND_MPS)
    length = np.interp(np.nan_to_num(emit), knots, leg.length_m[span])
    add_delayed(out, table, emit, 1.0 / np.maximum(length, NEAREST_M))


def _audible(paths: list[Path]) -> list[Path]:
    """Paths that at some moment carry more than a thousandth of the whole amplitude."""
    strength = np.array([path.gain.max(axis=1) / path.bent_m for path in paths])
    share = strength / np.maximum(strength.sum(axis=0), 1e-30)
    return [path for path, peak in zip(paths, share.max(axis=1), strict=True) if peak > FAINTEST]


def _add_bent(out: Signal, emission: Emission, path: Path, edge: int, receive_s: Array) -> None:
    """Add what reaches the array's centre round one corner."""
    weight = (1.0 - path.lit) * (path.edge == edge)
    made = emission.table(path.gain * weight[:, None])
    if made is None:
        return
    table, span = made
    emit = emission_times(receive_s, emission.knots_s[span], path.bent_m[span], SPEED_OF_SOUND_MPS)
    length = np.interp(np.nan_to_num(emit), emission.knots_s[span], path.bent_m[span])
    add_delayed(out, table, emit, 1.0 / length)


def _add_lit(out: Signal, emission: Emission, path: Path, source_y: Array, receiver: Receiver) -> None:
    """Add what reaches every microphone along the straight line."""
    made = emission.table(path.gain * path.lit[:, None])
    if made is None:
        return
    table, span = made
    emit_knots = emission.knots_s[span]
    for microphone, position, skew in zip(out, receiver.positions_m, receiver.skew_s, strict=True):
        across = source_y[span] - path.receiver.mirror(position[1:2])
        along = path.source.x_m - position[0]
        travel = np.sqrt(along**2 + across**2 + (position[2] - SOURCE_HEIGHT_M) ** 2)
        emit = emission_times(receiver.knots_s - skew, emit_knots, travel, SPEED_OF_SOUND_MPS)
        length = np.interp(np.nan_to_num(emit), emit_knots, travel)
        add_delayed(microphone, table, emit, 1.0 / length)


def _add_corners(
    out: Signal, bent: Signal, images: list[ReceiverImage], site: Site, receiver: Receiver, rate_hz: float
) -> None:
    """Let every corner, as every side image sees it, sound to all microphones."""
    corners = np.array([site.corner_left_m, -site.corner_right_m])
    delays = np.stack(
        [_corner_delays(image, y, site.corner_ahead_m, receiver) for image in images for y in corners]
    )
    signals = bent.reshape(-1, bent.shape[2])
    used = np.flatnonzero(np.abs(signals).max(axis=1) > 0.0)
    if len(used):
        add_static(out, signals[used], delays[used], rate_hz)


def _corner_delays(image: ReceiverImage, corner_y: float, mouth: float, receiver: Receiver) -> Array:
    """Delay of every microphone against the array's centre for sound from a corner, shape (M,)."""
    x, y, z = receiver.positions_m.T
    last_leg = np.hypot(mouth - x, image.mirror(y) - corner_y)
    to_centre = np.hypot(mouth, float(image.mirror(np.zeros(1))[0]) - corner_y)
    tilted = np.hypot(TYPICAL_LEG_M + last_leg, z - SOURCE_HEIGHT_M)
    centre = np.hypot(TYPICAL_LEG_M + to_centre, receiver.height_m)
    return np.asarray((tilted - centre) / SPEED_OF_SOUND_MPS + receiver.skew_s)
