"""Vehicles in view as the camera saw them and as the array heard them."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from worldstate.adapters.audio.open_sound import open_sound
from worldstate.adapters.listen import Source
from worldstate.frontend.array.geometry import SPEED_OF_SOUND_M_S
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.typing import FloatArray
from worldstate.operations.labelling.box_tracks import BoxTrack, box_tracks
from worldstate.operations.recordings.bearing_track import BearingTrack, track_bearings

# By then most of a vehicle has left the corner, which cuts its box before.
_WHOLE_AFTER_S = 0.5
# Where in its box a vehicle is heard, from the leading edge to the trailing one: between the front axle, with
# the engine, and the middle. On 38 simulated passes an alignment that is none comes out as none; a tenth of a
# box more or less is 0.1 s of offset.
_HEARD_AT = 0.33
# Shorter views say little of when and where at once.
_SHORTEST_S = 0.5
# Less certain is a bearing of a flat spectrum; what is of another sound is left to the fit.
_LARGEST_STD_DEG = 40.0


@dataclass(frozen=True, slots=True, eq=False)
class HeardPass:
    """One vehicle: where in its boxes it is heard, and every bearing of the sound around that time."""

    box_time_s: FloatArray  # Shape (n,), increasing, on the clock of the images
    box_rad: FloatArray  # Shape (n,): azimuth of that place
    sound_time_s: FloatArray  # Shape (m,): when the sound left the vehicle, on the clock of the sound
    sound_rad: FloatArray  # Shape (m,)


def heard_passes(source: Source, margin_s: float) -> list[HeardPass]:
    """Return every vehicle that turned through the view, with the bearings `margin_s` before and after."""
    if source.detections is None:
        return []
    bearings = _bearings(source)
    # The sound that arrives now left the vehicle before.
    emitted_s = bearings.time_s - source.camera.nominal_range_m / SPEED_OF_SOUND_M_S
    usable = np.isfinite(bearings.azimuth_deg) & (bearings.std_deg < _LARGEST_STD_DEG)
    found = []
    for time_s, heard_rad in _whole(box_tracks(source.detections, source.camera, source.settings.boxes)):
        near = usable & (emitted_s > time_s[0] - margin_s) & (emitted_s < time_s[-1] + margin_s)
        sound_rad = np.radians(bearings.azimuth_deg[near])
        found.append(HeardPass(time_s, heard_rad, emitted_s[near], sound_rad))
    return found


def _bearings(source: Source) -> BearingTrack:
    with open_sound(source.sound, source.array.n_microphones, strict=False) as audio:
        settings = source.settings.front_end(source.array, audio.sample_rate_hz)
        return track_bearings(audio, FrontEnd(source.array, audio.sample_rate_hz, settings))


def _whole(tracks: list[BoxTrack]) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield times and azimuths at which vehicles are heard, where neither corner nor image cuts the box."""
    for track in tracks:
        trailing_rad = track.left_rad + track.right_rad - track.leading_rad
        heard_rad = (1.0 - _HEARD_AT) * track.leading_rad + _HEARD_AT * trailing_rad
        whole = np.isfinite(heard_rad) & (track.time_s >= track.time_s[0] + _WHOLE_AFTER_S)
        time_s = track.time_s[whole]
        if track.arm is not None and len(time_s) > 1 and time_s[-1] - time_s[0] >= _SHORTEST_S:
            yield time_s, heard_rad[whole]
