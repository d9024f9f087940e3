"""What rough walls send on of a moving source, rendered at every microphone."""

from dataclasses import replace

import numpy as np

from worldstate.ground.typing import Float32Array, FloatArray

from .delay import add_delayed, emission_times
from .diffraction import SPEED_OF_SOUND_MPS
from .emission import Emission, MovingSource
from .paths import receiver_images
from .receiver import NEAREST_M, add_turning, distance_m
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
from .surroundings import Surroundings


def add_scattered(static: StaticSources, source: MovingSource, around: Surroundings) -> None:
    """Add what rough walls send on of one moving source, from where they stand, to all microphones."""
    if not around.scattering.any() or around.site.is_open:
        return
    for group in patches(around.site):
        arrived = np.zeros((len(group.strengths_m), around.receiver.samples), np.float32)
        for index, signal in enumerate(arrived):
            for leg in first_legs(group, index, source, around):
                sent = replace(leg, gain=leg.gain * np.sqrt(around.scattered(group.beyond_mouth)))
                _add_leg(signal, source.emission, sent, around, group.positions_m[index])
        _add_patches(static, arrived, group, around)


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


def _add_patches(static: StaticSources, arrived: Float32Array, group: Patches, around: Surroundings) -> None:
    """Let every patch sound to all microphones; those opposite by way of the side walls, too."""
    if not group.beyond_mouth:
        _add_shown(static, arrived, group, np.ones((len(arrived), 1)), around)
        return
    site, centre = around.site, around.receiver.centre_m
    x = around.receiver.ego.x_m(around.receiver.knots_s)
    away = np.linalg.norm(group.positions_m - centre, axis=1)
    for image in receiver_images(site):
        shown = mirrored(group, image)
        if image.order > IMAGE_ORDERS:
            continue
        seen = np.stack([seen_through_mouth(site, place, x, image) for place in group.positions_m])
        if not seen.any():
            continue
        # The way by a wall is longer: without its delay every image would be in phase with the patch.
        later_s = (np.linalg.norm(shown.positions_m - centre, axis=1) - away) / SPEED_OF_SOUND_MPS
        # What lies beyond the plane of a wall is not mirrored by it: its image would be the nearer one.
        seen *= (later_s >= 0.0)[:, None]
        later = np.round(np.maximum(later_s, 0.0) * static.sample_rate_hz).astype(int)
        signals = np.stack([_later(one, by) for one, by in zip(arrived, later, strict=True)])
        _add_shown(static, signals, shown, seen, around)


def _later(signal: Float32Array, samples: int) -> Float32Array:
    return np.concatenate([np.zeros(samples, np.float32), signal[: len(signal) - samples]])


def _add_shown(
    static: StaticSources, arrived: Float32Array, group: Patches, seen: FloatArray, around: Surroundings
) -> None:
    receiver = around.receiver
    if receiver.ego.stands:
        distance, gain = last_leg(group, receiver.positions_m)
        centre = np.linalg.norm(group.positions_m - receiver.centre_m, axis=1)
        delays = (distance - centre[:, None]) / SPEED_OF_SOUND_MPS + receiver.skew_s
        used = seen[:, 0] > 0.0
        static.add(arrived[used], delays[used], gain[used] * seen[used, :1])
        return
    x = receiver.ego.x_m(receiver.knots_s)
    for place, normal, signal, share in zip(group.positions_m, group.normals, arrived, seen, strict=True):
        distance = np.maximum(distance_m(place, x, receiver.centre_m), NEAREST_M)
        cosine = np.abs((x - place[0]) * normal[0] - place[1] * normal[1]) / distance
        add_turning(static.out, signal, place, share * np.sqrt(np.minimum(cosine, 1.0)) / distance, receiver)
