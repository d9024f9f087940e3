"""One recording: sound at every microphone, detections of the camera, and the truth."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.datasets.ovad import FRAME_RATE_HZ
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.ground.typing import BoolArray, Float32Array, FloatArray
from worldstate.simulation.camera.simulated_detector import (
    Frame,
    detect,
    line_of_sight,
    lost,
    park,
)
from worldstate.simulation.emitters.placed_sound import add_signal, add_sound
from worldstate.simulation.scene.driving import trajectories
from worldstate.simulation.scene.settings import SimulationSettings
from worldstate.simulation.scene.vehicle import Trajectory
from worldstate.simulation.sound.background import add_background
from worldstate.simulation.sound.delay import KNOT_SAMPLES
from worldstate.simulation.sound.ego_sound import add_ego_echo, ego_noise
from worldstate.simulation.sound.receiver import Receiver, standing_m
from worldstate.simulation.sound.static_field import StaticSources
from worldstate.simulation.sound.vehicle_sound import add_vehicle

from .truth import describe

FULL_SCALE_PA = 20.0  # 120 dB, where measurement microphones of this kind end
HEAD_START_S = 2.0  # emission begins this long before the recording: travel time and late field
SAMPLES_AT_ONCE = 1024
NO_VEHICLE_T0 = 0.7  # OVAD gives recordings without a vehicle frame 70 of 100


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
    detections : tuple of tuple of SimulatedDetection
        One tuple per camera frame; no frame at all for a moving ego, of which OVAD has no detections: vision
        is unqueried there.
    truth : dict
        Settings, trajectory, line of sight and azimuth per frame; see `truth.describe`.
    array : MicrophoneArray
        What listened, in the order of the channels.

    Examples
    --------
    >>> from worldstate.simulation import SimulationSettings, site
    >>> settings = SimulationSettings(site("SB1"), "none", duration_s=0.5)
    >>> recording = simulate_recording(settings, np.random.default_rng(1))
    >>> recording.audio.dtype, recording.truth["settings"]["approach"]
    (dtype('float32'), 'none')
    """

    audio: Float32Array
    sample_rate_hz: float
    t0_frame: int
    detections: tuple[Frame, ...]
    truth: dict[str, Any]
    array: MicrophoneArray


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
        Default `ovad_array`. Its centre stands 1.7 m above the road, whatever heights its positions name.

    Returns
    -------
    SimulatedRecording

    Raises
    ------
    InvalidArgumentError
        If a microphone would stand below the road.

    Examples
    --------
    >>> from worldstate.simulation import SimulationSettings, site
    >>> settings = SimulationSettings(site("SA1"), "left", duration_s=0.6, entry_s=0.45)
    >>> recording = simulate_recording(settings, np.random.default_rng(1))
    >>> recording.audio.shape, len(recording.detections), recording.t0_frame
    ((28799, 56), 6, 5)
    """
    to_sound, to_camera = rng.spawn(2)
    array = ovad_array() if array is None else array
    with threadpool_limits(1):  # the number of BLAS threads would change the last bits
        audio = _record(settings, array, to_sound)
    camera, frames = PinholeCamera(), _frame_times(settings)
    seen = [path.at(frames) for path in trajectories(settings, _knots(settings))]
    ego_x = settings.ego.x_m(frames)
    sights = [line_of_sight(path, settings.site, camera, ego_x) for path in seen]
    return SimulatedRecording(
        audio=audio,
        sample_rate_hz=settings.sample_rate_hz,
        t0_frame=_t0_frame(len(frames), sights if settings.approach != "none" else []),
        detections=_through_rain(
            _detections(settings, seen, len(frames), camera, to_camera), settings, to_camera
        ),
        truth=describe(settings, frames, seen, sights),
        array=array,
    )


def _record(settings: SimulationSettings, array: MicrophoneArray, rng: np.random.Generator) -> Float32Array:
    """Return what the array records, shape (n, M)."""
    to_emission, to_street, to_channels = rng.spawn(3)
    receiver = _receiver(settings, array, to_channels)
    sound = np.zeros((len(receiver.positions_m), receiver.samples), np.float32)
    static = StaticSources(sound, settings.sample_rate_hz)
    paths = trajectories(settings, _knots(settings))
    for path, draws in zip(paths, to_emission.spawn(len(paths)), strict=True):
        add_vehicle(static, settings.site, settings.preset, path, receiver, draws)
    positions, rate = receiver.positions_m, settings.sample_rate_hz
    # Generators of their own, and only where something sounds: the rest stays what it is without.
    _add_sounds(static, settings, paths, receiver, rng)
    static.render()
    add_background(sound, receiver, settings.site, settings.preset, to_street)
    if not settings.ego.stands:
        time, engine_db = np.arange(receiver.samples) / rate, settings.preset.ego_engine_db
        to_ego, to_echo = to_channels.spawn(2)
        speed, tyre_db = settings.ego.at_mps(time), settings.site.surface_db
        sound += ego_noise(positions, speed, rate, to_ego, engine_db, tyre_db).T
        add_ego_echo(sound, receiver, settings.site, engine_db, to_echo)
    return _to_samples(sound, settings, to_channels)


def _add_sounds(
    static: StaticSources,
    settings: SimulationSettings,
    paths: list[Trajectory],
    receiver: Receiver,
    rng: np.random.Generator,
) -> None:
    """Add what vehicles warn with, and what else sounds."""
    site, preset = settings.site, settings.preset
    for path, vehicle in zip(paths, settings.traffic, strict=True):
        if vehicle.signal:
            add_signal(static, vehicle.signal, path, site, preset, receiver, rng.spawn(1)[0])
    for sound in settings.sounds:
        add_sound(static, sound, site, preset, receiver, rng.spawn(1)[0])


def _receiver(settings: SimulationSettings, array: MicrophoneArray, rng: np.random.Generator) -> Receiver:
    positions = standing_m(array)
    skew = settings.preset.delay_mismatch_s * rng.standard_normal(len(positions))
    blocks = -(-_samples(settings) // KNOT_SAMPLES)
    knots = np.arange(blocks + 1) * KNOT_SAMPLES / settings.sample_rate_hz
    return Receiver(positions, skew, knots, settings.ego)


def _samples(settings: SimulationSettings) -> int:
    return round(settings.duration_s * settings.sample_rate_hz)


def _frame_times(settings: SimulationSettings) -> FloatArray:
    return np.arange(max(round(settings.duration_s * FRAME_RATE_HZ), 1)) / FRAME_RATE_HZ


def _knots(settings: SimulationSettings) -> FloatArray:
    """Emission knots, from a head start before the recording to its end."""
    knot_s = KNOT_SAMPLES / settings.sample_rate_hz
    before, after = -(-HEAD_START_S // knot_s), -(-settings.duration_s // knot_s)
    return np.arange(-before, after + 1) * knot_s


def _to_samples(sound: Float32Array, settings: SimulationSettings, rng: np.random.Generator) -> Float32Array:
    """From Pa (M, n) to full scale (n, M), with the channels' gains."""
    gain = 10.0 ** (settings.preset.gain_mismatch_db * rng.standard_normal(len(sound)) / 20.0) / FULL_SCALE_PA
    samples = np.empty((_samples(settings), len(sound)), np.float32)
    for at in range(0, len(samples), SAMPLES_AT_ONCE):  # a transposition at once would not fit any cache
        some = slice(at, min(at + SAMPLES_AT_ONCE, len(samples)))
        samples[some] = np.clip(sound[:, some] * gain[:, None].astype(np.float32), -1.0, 1.0).T
    return samples


def _t0_frame(frames: int, sights: list[BoolArray]) -> int:
    """First frame in which any vehicle is in line of sight; the last one where none ever is."""
    if not sights:
        return min(round(NO_VEHICLE_T0 * frames), frames - 1)
    sight = np.any(sights, axis=0)
    return int(sight.argmax()) if sight.any() else frames - 1


def _detections(
    settings: SimulationSettings,
    seen: list[Trajectory],
    frames: int,
    camera: PinholeCamera,
    rng: np.random.Generator,
) -> tuple[Frame, ...]:
    if not settings.ego.stands:
        return ()
    boxes: list[Frame] = [()] * frames
    if settings.parked_car:
        boxes = park(settings.site, camera, frames, rng)
    for path in seen:
        passing = detect(path, settings.site, camera, rng)
        boxes = [standing + moving for standing, moving in zip(boxes, passing, strict=True)]
    return tuple(boxes)


def _through_rain(
    detections: tuple[Frame, ...], settings: SimulationSettings, rng: np.random.Generator
) -> tuple[Frame, ...]:
    """Lose the detections that drops on the lens take while it rains."""
    missed = np.zeros(len(detections))
    time = np.arange(len(detections)) / FRAME_RATE_HZ
    for sound in settings.sounds:
        raining = (time >= sound.start_s) & (time < sound.end_s)
        missed = np.maximum(missed, sound.lens_missed * raining)
    return tuple(lost(detections, missed, rng)) if missed.any() else detections
