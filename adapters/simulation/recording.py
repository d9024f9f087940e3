"""One recording: sound at every microphone, detections of the camera, and the truth."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

from worldstate.adapters.camera import PinholeCamera
from worldstate.frontend.array import MicrophoneArray, roof_array_56

from .background import add_background
from .delay import KNOT_SAMPLES
from .detector import ARRAY_HEIGHT_M, FRAME_RATE_HZ, Frame, detect, line_of_sight, park
from .late_field import add_late_field, street_field
from .propagation import Emission, Receiver, add_scattered, add_source
from .scatter import scattering
from .settings import SimulationSettings
from .truth import describe
from .vehicle import Trajectory, drive, emit

Array = NDArray[np.float64]
Signal = NDArray[np.float32]

FULL_SCALE_PA = 20.0  # 120 dB, where measurement microphones of this kind end
HEAD_START_S = 2.0  # emission begins this long before the recording: travel time and late field
NO_VEHICLE_T0 = 0.7  # OVAD gives recordings without a vehicle frame 70 of 100
LATE_DISTANCE_M = 8.0


@dataclass(frozen=True, slots=True)
class SimulatedRecording:
    """What `simulate_recording` returns.

    Parameters
    ----------
    audio : ndarray, shape (n, M)
        float32, 1.0 is `FULL_SCALE_PA`.
    sample_rate_hz : float
        Rate of `audio`.
    t0_frame : int
        First camera frame with line of sight, 10 frames a second from the start; 70 % of all if no vehicle.
    detections : tuple of tuple of Detection
        One tuple per camera frame.
    truth : dict
        Settings, trajectory, line of sight and azimuth per frame; see `truth.describe`.
    """

    audio: Signal
    sample_rate_hz: float
    t0_frame: int
    detections: tuple[Frame, ...]
    truth: dict[str, Any]


def simulate_recording(
    settings: SimulationSettings, rng: np.random.Generator, array: MicrophoneArray | None = None
) -> SimulatedRecording:
    """Simulate one recording.

    The sound of the vehicle reaches every microphone by mirror images in the walls of both streets, straight
    or bent round a corner, each after its own travel time; under it lies the ambient field of the site. All
    levels are absolute, so that the signal-to-noise ratio falls by itself while the vehicle is hidden.

    Parameters
    ----------
    settings : SimulationSettings
        Site, approach and driving.
    rng : numpy.random.Generator
        Source of randomness; the same state gives the same recording.
    array : MicrophoneArray, optional
        Default `roof_array_56`; its centre stands 1.7 m above the road.

    Returns
    -------
    SimulatedRecording

    Examples
    --------
    >>> from worldstate.adapters.simulation import SimulationSettings, site
    >>> settings = SimulationSettings(site("SA1"), "left", duration_s=0.6, entry_s=0.45)
    >>> recording = simulate_recording(settings, np.random.default_rng(1))
    >>> recording.audio.shape, len(recording.detections), recording.t0_frame
    ((28799, 56), 6, 5)
    """
    to_sound, to_camera = rng.spawn(2)
    with threadpool_limits(1):  # the number of BLAS threads would change the last bits
        audio = _listen(settings, roof_array_56() if array is None else array, to_sound)
    camera = PinholeCamera()
    frames = _frame_times(settings)
    trajectory = _trajectory(settings)
    seen = None if trajectory is None else _at(trajectory, frames)
    return SimulatedRecording(
        audio=audio,
        sample_rate_hz=settings.sample_rate_hz,
        t0_frame=_t0_frame(settings, seen, camera),
        detections=_detections(settings, seen, len(frames), camera, to_camera),
        truth=describe(settings, frames, seen, camera),
    )


def _listen(settings: SimulationSettings, array: MicrophoneArray, rng: np.random.Generator) -> Signal:
    """Return what the array records, shape (n, M)."""
    to_emission, to_street, to_channels = rng.spawn(3)
    receiver = _receiver(settings, array, to_channels)
    sound = np.zeros((len(receiver.positions_m), receiver.samples), np.float32)
    trajectory = _trajectory(settings)
    if trajectory is not None:
        _add_vehicle_sound(sound, settings, trajectory, receiver, to_emission)
    positions, rate = receiver.positions_m, settings.sample_rate_hz
    add_background(sound, settings.site, settings.preset, positions, rate, to_street)
    return _to_samples(sound, settings, to_channels)


def _receiver(settings: SimulationSettings, array: MicrophoneArray, rng: np.random.Generator) -> Receiver:
    positions = array.centred_m + np.array([0.0, 0.0, ARRAY_HEIGHT_M])
    skew = settings.preset.delay_mismatch_s * rng.standard_normal(len(positions))
    blocks = -(-_samples(settings) // KNOT_SAMPLES)
    return Receiver(positions, skew, np.arange(blocks + 1) * KNOT_SAMPLES / settings.sample_rate_hz)


def _samples(settings: SimulationSettings) -> int:
    return round(settings.duration_s * settings.sample_rate_hz)


def _frame_times(settings: SimulationSettings) -> Array:
    return np.arange(max(round(settings.duration_s * FRAME_RATE_HZ), 1)) / FRAME_RATE_HZ


def _trajectory(settings: SimulationSettings) -> Trajectory | None:
    """Motion at the emission knots, or None without a vehicle."""
    if settings.approach == "none":
        return None
    knot_s = KNOT_SAMPLES / settings.sample_rate_hz
    before, after = -(-HEAD_START_S // knot_s), -(-settings.duration_s // knot_s)
    near_lane, far_lane = settings.site.lanes_m
    lane = near_lane if settings.approach == "left" else far_lane
    right, left = settings.site.sight_m(lane, PinholeCamera().position_m[:2])
    return drive(
        np.arange(-before, after + 1) * knot_s,
        entry_s=settings.entry_s,
        entry_y_m=left if settings.approach == "left" else right,
        lane_x_m=lane,
        speed_mps=settings.speed_mps,
        braking_mps2=settings.braking_mps2,
    )


def _add_vehicle_sound(
    sound: Signal,
    settings: SimulationSettings,
    path: Trajectory,
    receiver: Receiver,
    rng: np.random.Generator,
) -> None:
    preset = settings.preset
    level = preset.vehicle_level_db + preset.vehicle_spread_db * rng.standard_normal()
    rate, samples = settings.sample_rate_hz, (len(path.time_s) - 1) * KNOT_SAMPLES
    axles = emit(path, samples, rate, level, rng)
    for axle, signal in enumerate(axles):
        emission = Emission.of(signal, path.time_s[0], rate)
        y, cap_db = path.axle_y_m(axle), preset.screen_cap_db
        mirror = np.sqrt(1.0 - scattering(preset))
        add_source(sound, emission, path.lane_x_m, y, settings.site, receiver, cap_db, mirror)
    whole = Emission.of(axles.sum(axis=0), path.time_s[0], rate)
    middle = 0.5 * (path.axle_y_m(0) + path.axle_y_m(1))
    add_scattered(sound, whole, path.lane_x_m, middle, settings.site, receiver, preset)
    dry = axles.sum(axis=0) * _late_gain(settings, path, samples)
    heard = dry[: round(-path.time_s[0] * rate) + sound.shape[1]]
    field = street_field(settings.site, preset.late_lobe_share)
    add_late_field(sound, heard, preset.late_decay_s, receiver.positions_m, rate, rng, field)


def _late_gain(settings: SimulationSettings, path: Trajectory, samples: int) -> Signal:
    """How strongly the source feeds the late field: less the farther it is from the mouth."""
    away = np.hypot(path.lane_x_m - settings.site.corner_ahead_m, path.axle_y_m())
    walled = settings.site.opposite_wall_m is not None
    late_db = settings.preset.late_walled_db if walled else settings.preset.late_open_db
    gain = 10.0 ** (late_db / 20.0) * LATE_DISTANCE_M / (LATE_DISTANCE_M + away)
    knots = np.arange(len(gain)) * KNOT_SAMPLES
    return np.asarray(np.interp(np.arange(samples), knots, gain), np.float32)


def _to_samples(sound: Signal, settings: SimulationSettings, rng: np.random.Generator) -> Signal:
    """From Pa (M, n) to full scale (n, M), with the channels' gains."""
    gain = 10.0 ** (settings.preset.gain_mismatch_db * rng.standard_normal(len(sound)) / 20.0) / FULL_SCALE_PA
    samples = (sound[:, : _samples(settings)] * gain[:, None].astype(np.float32)).T
    return np.ascontiguousarray(np.clip(samples, -1.0, 1.0))


def _at(path: Trajectory, time_s: Array) -> Trajectory:
    """Return the same motion at other times."""
    front = np.interp(time_s, path.time_s, path.front_y_m)
    speed = np.interp(time_s, path.time_s, path.speed_mps)
    return Trajectory(time_s, front, speed, path.lane_x_m, path.heading)


def _t0_frame(settings: SimulationSettings, seen: Trajectory | None, camera: PinholeCamera) -> int:
    frames = len(_frame_times(settings))
    if seen is None:
        return min(round(NO_VEHICLE_T0 * frames), frames - 1)
    visible = np.flatnonzero(line_of_sight(seen, settings.site, camera))
    return int(visible[0]) if len(visible) else frames - 1


def _detections(
    settings: SimulationSettings,
    seen: Trajectory | None,
    frames: int,
    camera: PinholeCamera,
    rng: np.random.Generator,
) -> tuple[Frame, ...]:
    boxes: list[Frame] = [()] * frames
    if settings.parked_car:
        boxes = park(settings.site, camera, frames, rng)
    if seen is not None:
        passing = detect(seen, settings.site, camera, rng)
        boxes = [standing + moving for standing, moving in zip(boxes, passing, strict=True)]
    return tuple(boxes)
