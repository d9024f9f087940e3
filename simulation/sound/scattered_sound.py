"""What rough walls send on of a moving source, rendered at every microphone."""

from dataclasses import dataclass, replace

import numpy as np

from worldstate.ground.typing import BoolArray, Float32Array, FloatArray, IndexArray

from .delay import KNOT_SAMPLES, add_delayed, emission_times
from .diffraction import SPEED_OF_SOUND_MPS
from .emission import Emission, MovingSource
from .paths import receiver_images
from .receiver import NEAREST_M, Receiver, Surroundings, add_turning, distance_m
from .scatter import (
    IMAGE_ORDERS,
    FirstLeg,
    Patches,
    first_legs,
    last_leg,
    mirrored,
    patches,
    seen_through_mouth,
)
from .static_field import StaticSources

# Left out where it is 30 dB below all that rough walls send on together: while the ego moves most patches and
# images are, at any moment. Features change by 1e-4 rms.
FAINTEST = 1e-3
STRETCH_KNOTS = 64  # a sixth of a second, in which it is decided


def add_scattered(static: StaticSources, source: MovingSource, around: Surroundings) -> None:
    """Add what rough walls send on of one moving source, from where they stand, to all microphones."""
    if not around.scattering.any() or around.site.is_open:
        return
    every: list[_Shown] = []
    for group in patches(around.site):
        arrived = np.zeros((len(group.strengths_m), around.receiver.samples), np.float32)
        for index, signal in enumerate(arrived):
            for leg in first_legs(group, index, source, around):
                sent = replace(leg, gain=leg.gain * np.sqrt(around.scattered(group.beyond_mouth)))
                _add_leg(signal, source.emission, sent, around, group.positions_m[index])
        every += _shown(group, arrived, around)
    _add_shown(static, every, around.receiver)


def _add_leg(
    out: Float32Array, emission: Emission, leg: FirstLeg, around: Surroundings, patch_m: FloatArray
) -> None:
    """Add what one patch sends on, as late as the array's centre hears it."""
    made = emission.table(leg.gain)
    if made is None:
        return
    table, span = made
    receiver = around.receiver
    knots, first = emission.knots_s[span], leg.length_m[span]
    total, _ = receiver.arrivals(knots, lambda x: first + distance_m(patch_m, x, receiver.centre_m))
    emit = emission_times(receiver.knots_s, knots, total, SPEED_OF_SOUND_MPS)
    length = np.interp(np.nan_to_num(emit), knots, first)
    add_delayed(out, table, emit, 1.0 / np.maximum(length, NEAREST_M))


@dataclass(frozen=True, slots=True, eq=False)
class _Shown:
    """Patches as the array sees them, directly or in a side wall."""

    group: Patches
    arrived: Float32Array  # shape (P, n)
    later: IndexArray  # shape (P,): Samples by which the way to the array is longer than the direct one
    gain: FloatArray  # shape (P, K + 1): Amplitude factor of the last leg to the array's centre
    share: FloatArray  # shape (P, K + 1): What is seen of each

    def signal(self, index: int) -> Float32Array:
        """Return what one of them sends, as late as the array's centre hears it."""
        sent, by = self.arrived[index], int(self.later[index])
        return np.concatenate([np.zeros(by, np.float32), sent[: len(sent) - by]])


def _shown(group: Patches, arrived: Float32Array, around: Surroundings) -> list[_Shown]:
    """Patches themselves and, if they stand opposite, their images in the side walls."""
    site, receiver = around.site, around.receiver
    x, count = receiver.ego.x_m(receiver.knots_s), len(arrived)
    if not group.beyond_mouth:
        seen = np.ones((count, len(x)))
        return [_Shown(group, arrived, np.zeros(count, int), _last_gain(group, receiver), seen)]
    away, every = np.linalg.norm(group.positions_m - receiver.centre_m, axis=1), []
    for image in receiver_images(site):
        if image.order > IMAGE_ORDERS:
            continue
        shown = mirrored(group, image)
        seen = np.stack([seen_through_mouth(site, place, x, image) for place in group.positions_m])
        # The way by a wall is longer: without its delay every image would be in phase with the patch.
        later_s = (np.linalg.norm(shown.positions_m - receiver.centre_m, axis=1) - away) / SPEED_OF_SOUND_MPS
        # What lies beyond the plane of a wall is not mirrored by it: its image would be the nearer one.
        seen *= (later_s >= 0.0)[:, None]
        later = np.round(np.maximum(later_s, 0.0) * receiver.sample_rate_hz).astype(int)
        every.append(_Shown(shown, arrived, later, _last_gain(shown, receiver), seen))
    return every


def _last_gain(group: Patches, receiver: Receiver) -> FloatArray:
    """Amplitude factor from every patch to the array's centre, shape (P, K + 1)."""
    x = receiver.ego.x_m(receiver.knots_s)
    gains = []
    for place, normal in zip(group.positions_m, group.normals, strict=True):
        distance = np.maximum(distance_m(place, x, receiver.centre_m), NEAREST_M)
        cosine = np.abs((x - place[0]) * normal[0] - place[1] * normal[1]) / distance
        gains.append(np.sqrt(np.minimum(cosine, 1.0)) / distance)
    return np.stack(gains)


def _add_shown(static: StaticSources, every: list[_Shown], receiver: Receiver) -> None:
    """Let every patch and image sound to all microphones while it is loud enough to matter."""
    power = [_power(one) for one in every]
    whole = np.sum([own.sum(axis=0) for own in power], axis=0)
    for one, own in zip(every, power, strict=True):
        loud = own > FAINTEST * whole
        used = np.flatnonzero(loud.any(axis=1))
        if receiver.ego.stands and len(used):
            signals = np.stack([one.signal(i) for i in used.tolist()])
            distance, gain = last_leg(one.group, receiver.positions_m)
            centre = np.linalg.norm(one.group.positions_m - receiver.centre_m, axis=1)
            delays = (distance - centre[:, None]) / SPEED_OF_SOUND_MPS + receiver.skew_s
            static.add(signals, delays[used], gain[used] * one.share[used, :1])
            continue
        for i in used.tolist():
            gain = one.gain[i] * one.share[i] * _within(loud[i], one.gain.shape[1])
            add_turning(static.out, one.signal(i), one.group.positions_m[i], gain, receiver)


def _power(one: _Shown) -> FloatArray:
    """Power at the array's centre in stretches of time, shape (P, S)."""
    sent = np.stack([np.square(signal).reshape(-1, KNOT_SAMPLES).sum(axis=1) for signal in one.arrived])
    heard = sent * (one.gain * one.share)[:, :-1] ** 2
    return np.add.reduceat(heard, np.arange(0, heard.shape[1], STRETCH_KNOTS), axis=1)


def _within(loud: BoolArray, knots: int) -> FloatArray:
    """1 from a stretch before the first loud one to one after the last, shape (K + 1,)."""
    first, last = np.flatnonzero(loud)[[0, -1]]
    at = np.arange(knots) // STRETCH_KNOTS
    return np.asarray((at >= first - 1) & (at <= last + 1), np.float64)
