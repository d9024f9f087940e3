"""One recording: sound at every microphone, detections of the camera, and the truth."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import soundfile
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

from worldstate.adapters.datasets.ovad import FRAME_RATE_HZ, TRUTH_NAME
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import BoolArray, Float32Array, FloatArray
from worldstate.simulation.camera.simulated_detector import Frame, detect, line_of_sight, park, through_rain
from worldstate.simulation.emitters.placed_sound import add_signal, add_sound, add_vehicle
from worldstate.simulation.scene.driving import comes_into_view_s, trajectories
from worldstate.simulation.scene.settings import SimulationSettings, SoundSettings
from worldstate.simulation.scene.vehicle import Trajectory
from worldstate.simulation.sound.delay import KNOT_SAMPLES
from worldstate.simulation.sound.ego_sound import add_ego
from worldstate.simulation.sound.receiver import Receiver, standing_m
from worldstate.simulation.sound.renderers import add_ambience
from worldstate.simulation.sound.static_field import StaticSources, StreetSound

SCHEMA = "worldstate.simulation.truth"
SCHEMA_VERSION = "1.2.0"


def describe(
    settings: SimulationSettings, frames_s: FloatArray, seen: list[Trajectory], sights: list[BoolArray]
) -> dict[str, Any]:
    """Return the settings and, per camera frame, the positions of all vehicles, ready for JSON."""
    # Keys of a frame: `position_m` (front bumper, x ahead and y left of the array), `speed_mps`,
    # `azimuth_rad` (of the front axle, left positive), `range_m`, `line_of_sight` (whether the front is in
    # view: between the edges of the image and not hidden), `time_to_visible_s` (negative afterwards, null if
    # it never comes into view). `frames` belongs to the vehicle of `approach`, `others` to the other
    # vehicles. Without a vehicle of `approach`, `frames` is empty and `entry_s` is null. `ego` contains the
    # ego's position along its street, 0 at its stop. `sounds` contains the azimuth, range and time of other
    # placed sounds.
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


WAV_LIMIT_BYTES = (1 << 32) - (1 << 16)  # A WAV file has 32-bit sizes; a longer file is RF64
SAMPLE_BYTES = 3


@contextmanager
def sound_writer(
    path: Path, samples: int, channels: int, sample_rate_hz: float
) -> Iterator[soundfile.SoundFile]:
    """Open a file for a number of 24-bit samples, which are written at once or in blocks."""
    kind = "RF64" if SAMPLE_BYTES * samples * channels > WAV_LIMIT_BYTES else "WAV"
    try:
        with soundfile.SoundFile(path, "w", round(sample_rate_hz), channels, "PCM_24", format=kind) as file:
            yield file
    except soundfile.SoundFileError as error:
        problem = f"expected to write {samples} samples, the disk may be full: {error}"
        raise InputFileError(path, problem) from error


def refuse_foreign(target: Path) -> None:
    """Refuse to replace a folder without simulated truth."""
    if target.exists() and not (target / TRUTH_NAME).is_file():
        raise InputFileError(target, "expected a free name or a simulated recording, found something else")


@contextmanager
def finished_folder(target: Path) -> Iterator[Path]:
    """Yield a hidden folder beside `target`, on the same disk, and move it there when it is complete."""
    refuse_foreign(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=".simulated-", dir=target.parent) as hidden:
        temporary = Path(hidden) / target.name
        temporary.mkdir()
        yield temporary
        put_in_place(target, temporary)


def put_in_place(target: Path, finished: Path) -> None:
    """Move a finished folder to its place, and an old folder there to the temporary parent of the new one."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.exists():
        target.replace(finished.with_suffix(".old"))
    finished.replace(target)


FULL_SCALE_PA = 20.0  # 120 dB, the upper limit of measurement microphones
HEAD_START_S = 2.0  # Emission starts this long before the recording, to cover travel time and late field
SAMPLES_AT_ONCE = 1024
NO_VEHICLE_T0 = 0.7  # OVAD assigns frame 70 of 100 to recordings without a vehicle


@dataclass(frozen=True, slots=True)
class SimulatedRecording:
    """Result of `simulate_recording`.

    Parameters
    ----------
    audio : ndarray, shape (n, M)
        float32, 1.0 is `FULL_SCALE_PA`.
    sample_rate_hz : float
        Rate of `audio`.
    t0_frame : int
        First camera frame with line of sight, at 10 frames per second; without a vehicle at 70 %
        of the length.
    detections : tuple of tuple of SimulatedDetection
        One tuple per camera frame; no frames for a moving ego, for which OVAD has no detections: vision is
        unqueried there.
    truth : dict
        Settings, trajectory, line of sight and azimuth per frame; see `describe`.
    array : MicrophoneArray
        The array, in the order of the channels.

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

    Every microphone receives the vehicle's sound by mirror images in the walls of both streets. Each path is
    straight or diffracted at a corner and has its own travel time. The ambient field of the site is added.
    All levels are absolute, so the signal-to-noise ratio is lower while the vehicle is hidden.

    Parameters
    ----------
    settings : SimulationSettings
        Site, approach and motion.
    rng : numpy.random.Generator
        Source of randomness; the same state gives the same recording.
    array : MicrophoneArray, optional
        Default `ovad_array`. Its centre is placed 1.7 m above the road.

    Raises
    ------
    InvalidArgumentError
        If a microphone would be below the road.

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
    with threadpool_limits(1):  # The number of BLAS threads would change the last bits
        audio = _record(settings, array, to_sound)
    frames = np.arange(max(round(settings.duration_s * FRAME_RATE_HZ), 1)) / FRAME_RATE_HZ
    seen = [path.at(frames) for path in trajectories(settings, _knots(settings))]
    ego_x = settings.ego.x_m(frames)
    sights = [line_of_sight(path, settings.site, ego_x) for path in seen]
    return SimulatedRecording(
        audio=audio,
        sample_rate_hz=settings.sample_rate_hz,
        t0_frame=_t0_frame(len(frames), sights if settings.approach != "none" else []),
        detections=_detections(settings, seen, len(frames), to_camera),
        truth=describe(settings, frames, seen, sights),
        array=array,
    )


def _record(settings: SimulationSettings, array: MicrophoneArray, rng: np.random.Generator) -> Float32Array:
    """Return the recording of the array, shape (n, M)."""
    to_emission, to_street, to_channels = rng.spawn(3)
    positions = standing_m(array)
    skew = settings.preset.delay_mismatch_s * to_channels.standard_normal(len(positions))
    blocks = -(-round(settings.duration_s * settings.sample_rate_hz) // KNOT_SAMPLES)
    knots = np.arange(blocks + 1) * KNOT_SAMPLES / settings.sample_rate_hz
    receiver = Receiver(positions, skew, knots, settings.ego)
    sound = np.zeros((len(positions), receiver.samples), np.float32)
    static = StaticSources(sound, settings.sample_rate_hz)
    paths = trajectories(settings, _knots(settings))
    street = StreetSound(static, settings.site, settings.preset, receiver)
    for path, draws in zip(paths, to_emission.spawn(len(paths)), strict=True):
        add_vehicle(street, path, draws)
    # Sounds have generators of their own, so that a sound does not change the rest of the recording.
    for path, vehicle in zip(paths, settings.traffic, strict=True):
        if vehicle.signal:
            add_signal(street, vehicle.signal, path, rng.spawn(1)[0])
    for other in settings.sounds:
        add_sound(street, other, rng.spawn(1)[0])
    static.render()
    add_ambience(sound, receiver, settings.site, settings.preset, to_street)
    if not settings.ego.stands:
        add_ego(sound, receiver, settings.site, settings.preset, to_channels)
    return _to_samples(sound, settings, to_channels)


def _knots(settings: SimulationSettings) -> FloatArray:
    """Return emission knots, from a head start before the recording to its end."""
    knot_s = KNOT_SAMPLES / settings.sample_rate_hz
    before, after = -(-HEAD_START_S // knot_s), -(-settings.duration_s // knot_s)
    return np.arange(-before, after + 1) * knot_s


def _to_samples(sound: Float32Array, settings: SimulationSettings, rng: np.random.Generator) -> Float32Array:
    """Convert Pa (M, n) to full scale (n, M), with the channels' gains."""
    gain = 10.0 ** (settings.preset.gain_mismatch_db * rng.standard_normal(len(sound)) / 20.0) / FULL_SCALE_PA
    samples = np.empty((round(settings.duration_s * settings.sample_rate_hz), len(sound)), np.float32)
    # One transposition of everything would not fit into the cache
    for at in range(0, len(samples), SAMPLES_AT_ONCE):
        some = slice(at, min(at + SAMPLES_AT_ONCE, len(samples)))
        samples[some] = np.clip(sound[:, some] * gain[:, None].astype(np.float32), -1.0, 1.0).T
    return samples


def _t0_frame(frames: int, sights: list[BoolArray]) -> int:
    """Return the first frame with any vehicle in line of sight; the last frame if there is none."""
    if not sights:
        return min(round(NO_VEHICLE_T0 * frames), frames - 1)
    sight = np.any(sights, axis=0)
    return int(sight.argmax()) if sight.any() else frames - 1


def _detections(
    settings: SimulationSettings, seen: list[Trajectory], frames: int, rng: np.random.Generator
) -> tuple[Frame, ...]:
    if not settings.ego.stands:
        return ()
    boxes = list[Frame]([()] * frames)
    if settings.parked_car:
        boxes = park(settings.site, frames, rng)
    for path in seen:
        passing = detect(path, settings.site, rng)
        boxes = [standing + moving for standing, moving in zip(boxes, passing, strict=True)]
    showers = ((sound.start_s, sound.end_s, sound.lens_missed) for sound in settings.sounds)
    return tuple(through_rain(boxes, showers, rng))
