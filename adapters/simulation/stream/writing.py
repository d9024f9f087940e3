"""A stream on disk: sound block by block, array, detections and truth in one folder."""

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from worldstate.adapters.datasets.ovad_layout import ARRAY_NAME, AUDIO_NAME, DETECTION_NAMES, TRUTH_NAME
from worldstate.adapters.files.array_file import write_array_xml
from worldstate.adapters.simulation.camera.simulated_detector import to_json
from worldstate.adapters.simulation.dataset.recording import FULL_SCALE_PA
from worldstate.adapters.simulation.dataset.recording_folder import (
    put_in_place,
    refuse_foreign,
    sound_writer,
    write_json,
)
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.ovad_array import ovad_array
from worldstate.ground.checks import in_range
from worldstate.ground.typing import FloatArray

from .ambience import stream_ambience
from .arrivals import SoundEvent, draw_events, draw_sounds
from .microphones import draw_microphones
from .rendering import Block, StreamScene, render_blocks
from .settings import StreamSettings
from .sight import detected_frames
from .spectrogram import Spectrogram
from .truth import (
    EVENTS_NAME,
    ROWS_NAME,
    VehicleTruth,
    describe_events,
    describe_stream,
    rows_csv,
    vehicle_truth,
)

ARRIVALS, CHANNELS, LEVEL, CAMERA, SOUNDS = 0, 1, 2, 5, 6  # purposes of generators; 3 and 4 are the pieces'


@dataclass(frozen=True, slots=True, eq=False)
class WrittenStream:
    """What was written, and what a figure of it needs."""

    folder: Path
    settings: StreamSettings
    vehicles: tuple[VehicleTruth, ...]
    sounds: tuple[SoundEvent, ...]
    spectrogram: Spectrogram  # Of the microphone nearest to the array's centre


def write_stream(
    root: str | Path,
    settings: StreamSettings,
    *,
    array: MicrophoneArray | None = None,
    jobs: int = 1,
    progress: Callable[[float], None] | None = None,
) -> WrittenStream:
    """Simulate a continuous stream with traffic and write it to a folder below `root`.

    The folder is named after site, traffic and seed. It holds `out_multi.wav` (RF64 beyond 4 GiB, written
    block by block), `array.xml`, camera detections, `truth.json` in the form of a recording's, `events.json`
    with one entry a vehicle or other sound, and `vehicles.csv` with one row a vehicle and tenth of a second.
    The same settings give the same bytes, whatever the number of jobs. Interrupted, it leaves nothing.

    Parameters
    ----------
    root : str or Path
        Folder to write to; made if it is not there. A simulated stream of the same name is replaced.
    settings : StreamSettings
        What to simulate.
    array : MicrophoneArray, optional
        What listens. Default `ovad_array`.
    jobs : int
        Processes, 1 to 256.
    progress : callable, optional
        Called with the seconds that were written since the last call.

    Returns
    -------
    WrittenStream
        Folder, vehicles and the spectrogram of one channel.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.
    InputFileError
        If something that was not simulated stands there, or the disk is full.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from worldstate.adapters.simulation import site
    >>> pair = MicrophoneArray([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]])
    >>> settings = StreamSettings(site("SB1"), minutes=0.1, sample_rate_hz=6000.0)
    >>> with TemporaryDirectory() as root:
    ...     stream = write_stream(root, settings, array=pair)
    ...     stream.folder.name, (stream.folder / "out_multi.wav").stat().st_size // 6
    ('SB1-calm-1', 36007)
    """
    in_range("jobs", jobs, 1, 256)
    folder, listening = Path(root), ovad_array() if array is None else array
    target = folder / f"{settings.site.name}-{settings.traffic.name}-{settings.seed}"
    refuse_foreign(target)
    folder.mkdir(parents=True, exist_ok=True)
    scene = StreamScene(
        settings,
        stream_ambience(settings, settings.generator(LEVEL)),
        draw_microphones(settings, listening, settings.generator(CHANNELS)),
    )
    events = draw_events(
        settings.site, settings.traffic, settings.preset, settings.duration_s, settings.generator(ARRIVALS)
    )
    vehicles = tuple(vehicle_truth(number, event, settings) for number, event in enumerate(events))
    sounds = draw_sounds(settings, listening.n_microphones, settings.generator(SOUNDS))
    heard = Spectrogram(settings.sample_rate_hz)
    # Beside the target, on the same disk, so that the whole stream takes its name in one step.
    with TemporaryDirectory(prefix=".simulated-", dir=folder) as hidden:
        temporary = Path(hidden) / target.name
        temporary.mkdir()
        with closing(render_blocks(scene, [*events, *sounds], jobs)) as blocks:
            loudness = _write_sound(temporary / AUDIO_NAME, scene, blocks, heard, progress)
        write_array_xml(temporary / ARRAY_NAME, listening)
        _write_beside(temporary, settings, vehicles, sounds, loudness)
        put_in_place(target, temporary)
    return WrittenStream(target, settings, vehicles, tuple(sounds), heard)


def _write_sound(
    path: Path,
    scene: StreamScene,
    blocks: Iterator[Block],
    heard: Spectrogram,
    progress: Callable[[float], None] | None,
) -> dict[int, FloatArray]:
    """Write the blocks as they come; return the loudness of all events."""
    microphones, rate = scene.microphones, scene.settings.sample_rate_hz
    channels = len(microphones.positions_m)
    # Gains are the converters': they come after everything that sounds, and are in no level of the truth.
    gains = (microphones.gains / FULL_SCALE_PA).astype(np.float32)[:, None]
    middle = int(
        np.linalg.norm(microphones.positions_m - microphones.positions_m.mean(axis=0), axis=1).argmin()
    )
    loudness: dict[int, FloatArray] = {}
    with sound_writer(path, scene.settings.samples, channels, rate) as file:
        for block in blocks:
            file.write(np.clip(block.pressure_pa * gains, -1.0, 1.0).T)
            heard.add(block.pressure_pa[middle])
            loudness |= block.loudness_db
            if progress is not None:
                progress(block.pressure_pa.shape[1] / rate)
    return loudness


def _write_beside(
    folder: Path,
    settings: StreamSettings,
    vehicles: tuple[VehicleTruth, ...],
    sounds: list[SoundEvent],
    loudness: dict[int, FloatArray],
) -> None:
    events = [one.event for one in vehicles]
    frames = detected_frames(settings, events, sounds, settings.generator(CAMERA))
    write_json(folder / DETECTION_NAMES[0], to_json(frames))
    write_json(folder / TRUTH_NAME, describe_stream(settings, vehicles))
    write_json(folder / EVENTS_NAME, describe_events(vehicles, sounds, loudness))
    (folder / ROWS_NAME).write_text(rows_csv(vehicles, loudness), encoding="utf-8", newline="\n")
