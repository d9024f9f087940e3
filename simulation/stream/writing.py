"""A stream on disk: sound block by block, array, detections and truth in one folder."""

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from worldstate.adapters.datasets.ovad_layout import ARRAY_NAME, AUDIO_NAME, DETECTION_NAMES, TRUTH_NAME
from worldstate.adapters.files.array_file import write_array_xml
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.ovad_array import ovad_array
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray
from worldstate.simulation.camera.simulated_detector import to_json
from worldstate.simulation.dataset.recording_folder import (
    put_in_place,
    refuse_foreign,
    sound_writer,
    write_json,
)

from .arrivals import SoundEvent
from .drawn_stream import DrawnStream, draw_stream
from .rendering import Block
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
)

CAMERA = 5  # purpose of a generator; the others are the drawn stream's


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
        If a number is out of range or the ego of the site moves.
    InputFileError
        If something that was not simulated stands there, or the disk is full.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from worldstate.simulation import site
    >>> pair = MicrophoneArray([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]])
    >>> settings = StreamSettings(site("SB1"), minutes=0.1, sample_rate_hz=6000.0)
    >>> with TemporaryDirectory() as root:
    ...     stream = write_stream(root, settings, array=pair)
    ...     stream.folder.name, (stream.folder / "out_multi.wav").stat().st_size // 6
    ('SB1-calm-1', 36007)
    """
    in_range("jobs", jobs, 1, 256)
    if not settings.ego.stands:
        got = f"{settings.site.name}: drives are heard, not written"
        raise InvalidArgumentError(f"site: expected one where the ego stands, got {got}")
    folder = Path(root)
    target = folder / settings.name
    refuse_foreign(target)
    folder.mkdir(parents=True, exist_ok=True)
    stream = draw_stream(settings, ovad_array() if array is None else array)
    heard = Spectrogram(settings.sample_rate_hz)
    # Beside the target, on the same disk, so that the whole stream takes its name in one step.
    with TemporaryDirectory(prefix=".simulated-", dir=folder) as hidden:
        temporary = Path(hidden) / target.name
        temporary.mkdir()
        with closing(stream.blocks(jobs)) as blocks:
            loudness = _write_sound(temporary / AUDIO_NAME, stream, blocks, heard, progress)
        write_array_xml(temporary / ARRAY_NAME, stream.array)
        _write_beside(temporary, stream, loudness)
        put_in_place(target, temporary)
    return WrittenStream(target, settings, stream.vehicles, stream.sounds, heard)


def _write_sound(
    path: Path,
    stream: DrawnStream,
    blocks: Iterator[Block],
    heard: Spectrogram,
    progress: Callable[[float], None] | None,
) -> dict[int, FloatArray]:
    """Write the blocks as they come; return the loudness of all events."""
    microphones, settings = stream.scene.microphones, stream.scene.settings
    channels, rate = len(microphones.positions_m), settings.sample_rate_hz
    loudness: dict[int, FloatArray] = {}
    with sound_writer(path, settings.samples, channels, rate) as file:
        for block in blocks:
            file.write(stream.recorded(block))
            heard.add(block.pressure_pa[stream.array.middle])
            loudness |= block.loudness_db
            if progress is not None:
                progress(block.pressure_pa.shape[1] / rate)
    return loudness


def _write_beside(folder: Path, stream: DrawnStream, loudness: dict[int, FloatArray]) -> None:
    settings, vehicles = stream.scene.settings, stream.vehicles
    events = [one.event for one in vehicles]
    frames = detected_frames(settings, events, stream.sounds, settings.generator(CAMERA))
    write_json(folder / DETECTION_NAMES[0], to_json(frames))
    write_json(folder / TRUTH_NAME, describe_stream(settings, vehicles))
    write_json(folder / EVENTS_NAME, describe_events(vehicles, stream.sounds, loudness))
    (folder / ROWS_NAME).write_text(rows_csv(vehicles, loudness), encoding="utf-8", newline="\n")
