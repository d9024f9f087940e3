"""A continuous stream: everything is drawn before rendering starts, and written while it is rendered."""

from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.fft import rfft, rfftfreq

from worldstate.adapters.datasets.ovad import ARRAY_NAME, AUDIO_NAME, DETECTION_NAMES, TRUTH_NAME
from worldstate.adapters.files.array_file import write_array_xml
from worldstate.adapters.files.file_io import write_json, write_rows
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.ground import InvalidArgumentError, in_range
from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.camera.simulated_detector import to_json
from worldstate.simulation.dataset.recording import FULL_SCALE_PA, finished_folder, sound_writer
from worldstate.simulation.scene.octave_bands import REFERENCE_PA

from . import truth
from .arrivals import SoundEvent, draw_events, draw_sounds
from .rendering import Block, Microphones, StreamScene, draw_microphones, render_blocks
from .settings import StreamSettings

ARRIVALS, CHANNELS, LEVEL, SOUNDS = 0, 1, 2, 6  # Purposes of generators; 3 and 4 belong to the pieces


@dataclass(frozen=True, slots=True, eq=False)
class DrawnStream:
    """Arrivals and microphones of a stream; its sound is written or processed while it is rendered."""

    scene: StreamScene
    arrays: tuple[MicrophoneArray, ...]
    vehicles: tuple[truth.VehicleTruth, ...]
    sounds: tuple[SoundEvent, ...]

    def blocks(self, jobs: int = 1) -> Generator[Block, None, None]:
        """Yield its blocks from the beginning."""
        return render_blocks(self.scene, [*(one.event for one in self.vehicles), *self.sounds], jobs)

    def recorded(self, block: Block) -> Float32Array:
        """Return the output of the converters of all arrays for a block, shape (n, M), full scale 1."""
        # Gains belong to the converters: they apply last and do not affect levels of the truth.
        gains = (self.scene.microphones.gains / FULL_SCALE_PA).astype(np.float32)[:, None]
        return np.asarray(np.clip(block.pressure_pa * gains, -1.0, 1.0).T)


def draw_stream(settings: StreamSettings, *arrays: MicrophoneArray) -> DrawnStream:
    """Draw vehicles, other sounds, background and microphones of a stream, each from its own generator.

    Several arrays share one position; each receives the sound it would receive alone.
    """
    events = draw_events(settings, settings.generator(ARRIVALS))
    drawn = [draw_microphones(settings, one, settings.generator(CHANNELS)) for one in arrays]
    sizes = [one.n_microphones for one in arrays]
    return DrawnStream(
        StreamScene.drawn(settings, Microphones.joined(drawn), settings.generator(LEVEL)),
        arrays,
        tuple(truth.vehicle_truth(number, event, settings) for number, event in enumerate(events)),
        tuple(draw_sounds(settings, sizes, settings.generator(SOUNDS))),
    )


LINE_S = 0.5
FFT_SAMPLES = 256
HIGHEST_HZ = 3000.0


@dataclass(slots=True)
class Spectrogram:
    """Mean power of lines of half a second: one hour takes less than 10 MB."""

    sample_rate_hz: float
    _rest: Float32Array = field(default_factory=lambda: np.zeros(0, np.float32))
    _lines: list[FloatArray] = field(default_factory=list)

    def add(self, samples_pa: Float32Array) -> None:
        """Add the next samples of the channel, shape (n,)."""
        frames = round(LINE_S * self.sample_rate_hz) // FFT_SAMPLES
        length = frames * FFT_SAMPLES
        whole = np.concatenate([self._rest, samples_pa])
        cut = len(whole) // length * length
        # Blocks without overlap lose a third of the samples to the window; a picture does not need them.
        window = np.hanning(FFT_SAMPLES).astype(np.float32)
        blocks = whole[:cut].reshape(-1, frames, FFT_SAMPLES) * window
        for block in blocks:
            power = (np.abs(rfft(block, axis=-1)) ** 2).mean(axis=0)
            self._lines.append(power[1 : 1 + len(self.frequencies_hz)])
        self._rest = whole[cut:]

    @property
    def frequencies_hz(self) -> FloatArray:
        """Middle of the bins, without that at 0 Hz, shape (F,)."""
        every = rfftfreq(FFT_SAMPLES, 1.0 / self.sample_rate_hz)
        return np.asarray(every[1 : np.searchsorted(every, HIGHEST_HZ)])

    @property
    def times_s(self) -> FloatArray:
        """Start time of every line, shape (T,)."""
        step = round(LINE_S * self.sample_rate_hz) // FFT_SAMPLES * FFT_SAMPLES / self.sample_rate_hz
        return step * np.arange(len(self._lines), dtype=np.float64)

    def levels_db(self) -> FloatArray:
        """Level of every bin, dB re 20 uPa, shape (T, F)."""
        scale = 2.0 / (FFT_SAMPLES * 0.375 * FFT_SAMPLES)  # One-sided, normalised by the Hann window's power
        power = np.array(self._lines).reshape(-1, len(self.frequencies_hz)) * scale
        return np.asarray(10.0 * np.log10(np.maximum(power, REFERENCE_PA**2 * 1e-3) / REFERENCE_PA**2))


CAMERA = 5  # Purpose of a generator; the others are those of the drawn stream


@dataclass(frozen=True, slots=True, eq=False)
class WrittenStream:
    """A written stream, and the data of its figure."""

    folder: Path
    settings: StreamSettings
    vehicles: tuple[truth.VehicleTruth, ...]
    sounds: tuple[SoundEvent, ...]
    spectrogram: Spectrogram  # Spectrogram of the microphone nearest to the array's centre


def write_stream(
    root: str | Path,
    settings: StreamSettings,
    *,
    array: MicrophoneArray | None = None,
    jobs: int = 1,
    progress: Callable[[float], None] | None = None,
) -> WrittenStream:
    """Simulate a continuous stream with traffic and write it to a folder below `root`.

    The folder is named after site, traffic and seed. It contains `out_multi.wav` (RF64 beyond 4 GiB, written
    block by block), `array.xml`, camera detections, `truth.json` in the form of a recording's, `events.json`
    with one entry per vehicle or other sound, and `vehicles.csv` with one row per vehicle and tenth of a
    second. The same settings give the same bytes for any number of jobs. An interrupted call leaves no files.

    Parameters
    ----------
    root : str or Path
        Output folder; it is created if needed. A simulated stream of the same name is replaced.
    settings : StreamSettings
        Settings of the stream.
    array : MicrophoneArray, optional
        The array. Default `ovad_array`.
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
        If a number is out of range or the site has a moving ego.
    InputFileError
        If the folder exists and is not simulated, or the disk is full.

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
    target = Path(root) / settings.name
    with finished_folder(target) as temporary:
        stream = draw_stream(settings, ovad_array() if array is None else array)
        heard, loudness = _write_sound(temporary / AUDIO_NAME, stream, jobs, progress)
        write_array_xml(temporary / ARRAY_NAME, stream.arrays[0])
        _write_beside(temporary, stream, loudness)
    return WrittenStream(target, settings, stream.vehicles, stream.sounds, heard)


def _write_sound(
    path: Path, stream: DrawnStream, jobs: int, progress: Callable[[float], None] | None
) -> tuple[Spectrogram, dict[int, FloatArray]]:
    """Write the blocks in order; return the spectrogram of one channel and the loudness of all events."""
    microphones, settings = stream.scene.microphones, stream.scene.settings
    channels, rate = len(microphones.positions_m), settings.sample_rate_hz
    heard, loudness = Spectrogram(rate), dict[int, FloatArray]()
    with sound_writer(path, settings.samples, channels, rate) as file, closing(stream.blocks(jobs)) as blocks:
        for block in blocks:
            file.write(stream.recorded(block))
            heard.add(block.pressure_pa[stream.arrays[0].middle])
            loudness |= {number: levels[0] for number, levels in block.loudness_db.items()}
            if progress is not None:
                progress(block.pressure_pa.shape[1] / rate)
    return heard, loudness


def _write_beside(folder: Path, stream: DrawnStream, loudness: dict[int, FloatArray]) -> None:
    settings, vehicles = stream.scene.settings, stream.vehicles
    events = [one.event for one in vehicles]
    frames = truth.detected_frames(settings, events, stream.sounds, settings.generator(CAMERA))
    write_json(folder / DETECTION_NAMES[0], to_json(frames))
    write_json(folder / TRUTH_NAME, truth.describe_stream(settings, vehicles))
    write_json(folder / truth.EVENTS_NAME, truth.describe_events(vehicles, stream.sounds, loudness))
    write_rows(folder / truth.ROWS_NAME, truth.COLUMNS, truth.truth_rows(vehicles, loudness), newline="\n")
