"""What only a simulation knows."""

from dataclasses import asdict
from typing import Any

import numpy as np

from worldstate.adapters.datasets.ovad import FRAME_RATE_HZ
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.simulation.scene.driving import comes_into_view_s
from worldstate.simulation.scene.settings import SimulationSettings
from worldstate.simulation.scene.sound_settings import SoundSettings
from worldstate.simulation.scene.vehicle import Trajectory

SCHEMA = "worldstate.simulation.truth"
SCHEMA_VERSION = "1.2.0"


def describe(
    settings: SimulationSettings, frames_s: FloatArray, seen: list[Trajectory], sights: list[BoolArray]
) -> dict[str, Any]:
    """Return settings and, per camera frame, where the vehicles and the ego are, ready for JSON."""
    # Keys of a frame: `position_m` (front bumper, x ahead and y left of the array), `speed_mps`,
    # `azimuth_rad` (of the front axle, left positive), `range_m`, `line_of_sight` (whether the front is in
    # the camera's view: between the edges of its image, and nothing stands before it), `time_to_visible_s`
    # (negative afterwards, null where it never comes into view). `frames` are those of the vehicle that
    # `approach` names, `others` those of the rest. Without the former there are no frames and `entry_s` is
    # null. `ego` has the ego's way along its street, 0 where it stops. `sounds` has the azimuth and range of
    # what else sounds at a place, and when.
    ego_x = settings.ego.x_m(frames_s)
    entries = [comes_into_view_s(settings, vehicle) for vehicle in settings.traffic]
    frames = [_frames(*one, ego_x) for one in zip(seen, sights, entries, strict=True)]
    named = 0 if settings.approach == "none" else 1
    return {
        "schema": SCHEMA,
        "version": SCHEMA_VERSION,
        "settings": asdict(settings),
        "frame_rate_hz": FRAME_RATE_HZ,
        "entry_s": entries[0] if named else None,
        "frames": frames[0] if named else [],
        "others": frames[named:],
        "sounds": [_sound(sound, frames_s, ego_x) for sound in settings.sounds],
        "ego": {"x_m": ego_x.round(6).tolist(), "speed_mps": settings.ego.at_mps(frames_s).round(6).tolist()},
    }


def _sound(sound: SoundSettings, frames_s: FloatArray, ego_x_m: FloatArray) -> dict[str, Any]:
    sounding = (frames_s >= sound.start_s) & (frames_s < sound.end_s)
    told = {
        "kind": sound.kind,
        "label": sound.what.label,
        "of": sound.what.origin,
        "start_s": sound.start_s,
        "end_s": sound.end_s,
        "sounding": sounding.tolist(),
    }
    if not sound.has_place:
        return told
    x, y = sound.at(frames_s)
    return told | {
        "azimuth_rad": np.arctan2(y, x - ego_x_m).round(6).tolist(),
        "range_m": np.hypot(y, x - ego_x_m).round(6).tolist(),
    }


def _frames(
    seen: Trajectory, sight: BoolArray, entry_s: float | None, ego_x_m: FloatArray
) -> list[dict[str, Any]]:
    axle_x, axle_y = seen.behind(seen.kind.axles_m[0])
    columns = {
        "time_s": seen.time_s,
        "speed_mps": seen.speed_mps,
        "azimuth_rad": np.arctan2(axle_y, axle_x - ego_x_m),
        "range_m": np.hypot(axle_y, axle_x - ego_x_m),
    }
    ahead = seen.behind(0.0)[0] - ego_x_m
    return [
        {name: round(float(values[i]), 6) for name, values in columns.items()}
        | {"position_m": [round(float(ahead[i]), 6), round(float(seen.front_y_m[i]), 6)]}
        | {"line_of_sight": bool(sight[i])}
        | {"time_to_visible_s": None if entry_s is None else round(entry_s - float(seen.time_s[i]), 6)}
        for i in range(len(sight))
    ]
