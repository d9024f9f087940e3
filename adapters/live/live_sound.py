"""Live sound from microphones or a replayed recording; lost blocks are replaced by zeros."""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import soundfile

from worldstate.adapters.audio.sound_file import Audio
from worldstate.adapters.files.file_io import claimed_file, is_named
from worldstate.frontend.settings import HOP_RATE_HZ
from worldstate.ground import InputFileError, InvalidArgumentError, WorldstateError, in_range, nanoseconds
from worldstate.ground.extras import optional
from worldstate.ground.threads import BoundedChannel
from worldstate.ground.typing import Float32Array

_LOG = logging.getLogger(__name__)
# Blocks per second of a source. The state of a hop that ends within a block waits for the end of the block:
# at most 25 ms, and not at all if hops are whole blocks, as at 48 kHz.
BLOCKS_PER_SECOND = 40
# Largest waiting time of sound. A short stall of the process is made up for; sound that waits longer is
# dropped, because a later state is no warning.
LONGEST_WAIT_S = 2.0
# Lost sound of up to this duration, plus at most one hop, is replaced by silence. The snapshot then reports
# lost samples, but not yet dead microphones. Silence takes as long to process as sound, so a slow computer
# could not catch up if all lost sound were replaced. The rest of a longer gap is left out together with all
# waiting blocks, so that the sound after it is continuous.
HEARD_SILENCE_S = 0.9
# A longer gap is no loss; the device was asleep.
LONGEST_GAP_S = 60.0
# A device without data for this time has stalled. The state follows within 1 s, one more hop included.
STALL_S = 0.5
# Relative to full scale. A converter gives at most 1, and single precision sums squares up to this without
# overflow.
LARGEST_SAMPLE = 1000.0
# Converters of such arrays have 24 bits. WAV ends at 4 GiB, which is nine minutes of 56 channels; RF64 has no
# such limit and is read by WAV readers.
_FORMAT, _SUBTYPE = "RF64", "PCM_24"
# SFC_SET_UPDATE_HEADER_AUTO of libsndfile.
_UPDATE_HEADER = 0x1061


@dataclass(frozen=True, slots=True)
class SoundBlock:
    """Samples that were captured together."""

    samples: Float32Array  # Shape (n, M), full scale 1
    first: int  # Number of the first sample since the start, including lost ones
    captured_s: float  # Capture time of the last sample on the clock of `time.monotonic`


NO_SOUND = SoundBlock(np.zeros((0, 0), np.float32), 0, 0.0)
# Largest time of `time.monotonic`, which starts at boot; beyond it nanoseconds overflow.
_LATEST_S = 1e9


def block_samples(sample_rate_hz: int) -> int:
    """Return the length of a block, rounded up, because shorter ones would end just before the hops.

    Examples
    --------
    >>> block_samples(48_000), block_samples(47_998)
    (1200, 1200)
    """
    return -(-sample_rate_hz // BLOCKS_PER_SECOND)


class SoundFeed(Protocol):
    """Interface of microphones or a replacement: it gives blocks from its own thread until stopped.

    Examples
    --------
    >>> class OneBlock:
    ...     name, sample_rate_hz, channels, speed, overflows = "one block", 8000, 2, 1.0, 0
    ...     def start(self, into):
    ...         into.put(SoundBlock(np.zeros((400, 2), np.float32), 0, time.monotonic()))
    ...         into.close()
    ...     def stop(self): pass
    >>> feed: SoundFeed = OneBlock()
    >>> [block.shape for block in LiveSound(feed).blocks()]
    [(400, 2)]
    """

    name: str
    sample_rate_hz: int
    channels: int
    speed: float  # Seconds of sound per second: 1 for microphones
    overflows: int  # Number of times that samples were lost before they formed blocks

    def start(self, into: BoundedChannel[SoundBlock], /) -> None:
        """Start to put blocks into the channel."""

    def stop(self) -> None:
        """Stop giving blocks, and close what was opened."""


class LiveSound(Audio):
    """A live source as a recording without end, for `open_source` and `listen_steps`.

    Parameters
    ----------
    feed : SoundFeed
        Source of the blocks.
    keep : callable, optional
        Called with every block, with zeros for lost ones. Without it no sound is kept longer than a window.

    Attributes
    ----------
    start_ns : int
        Time of the first sample on the stream's clock; not 0 if a belief is resumed. It increases by the
        sound that was left out.
    lost_samples : int
        Number of lost samples per channel; `blocks` gave zeros for at most 1 s of each gap.
    refused : int
        Number of blocks of another shape, or with a repeated, decreasing or far larger number, and of blocks
        with invalid or impossible samples, which `blocks` replaced by zeros.
    """

    def __init__(self, feed: SoundFeed, keep: Callable[[Float32Array], None] | None = None) -> None:
        self.path, self.frames = Path(feed.name), 0
        self.sample_rate_hz, self.channels = feed.sample_rate_hz, feed.channels
        # Silence is detected only after 1 s; the front-end excludes a silent channel.
        self.silent_channels = ()
        self.lost_samples, self.start_ns, self.refused = 0, 0, 0
        self._feed, self._keep = feed, keep
        self._channel: BoundedChannel[SoundBlock] = BoundedChannel(int(LONGEST_WAIT_S * BLOCKS_PER_SECOND))
        self._captured_s = time.monotonic()
        # Difference between the numbers of a block in the stream and on the device: it grows with each stall
        # of the device, and is None during a stall.
        self._behind: int | None = 0

    @property
    def overruns(self) -> int:
        """Number of times that sound was lost: blocks not taken in time, and overflows of the device."""
        return self._channel.dropped + self._feed.overflows

    @property
    def lost_s(self) -> float:
        """Seconds of lost sound."""
        return self.lost_samples / self.sample_rate_hz

    def check_size(self, expect_channels: int | None) -> None:
        """Refuse a wrong number of channels; the length is not known."""
        self.check_channels(expect_channels)

    def blocks(self, frames: int = 4800) -> Iterator[Float32Array]:
        """Yield the sound from now until the source ends or is closed, in blocks of the source's length.

        If the device stalls, its sound is replaced by zeros.
        """
        self._feed.start(self._channel)
        self._captured_s = accepted_s = time.monotonic()
        try:
            while True:
                wait_s = STALL_S if self._behind is not None else 1.0 / BLOCKS_PER_SECOND
                try:
                    given: object = self._channel.take(wait_s)
                except TimeoutError:
                    given = NO_SOUND
                if given is None and self._channel.ended:
                    return
                block = self._checked(given)
                missing_s = self._missing(block) / self.sample_rate_hz
                if HEARD_SILENCE_S + 1.0 / HOP_RATE_HZ < missing_s <= LONGEST_GAP_S:
                    block = self._channel.take_newest(block)
                parts: Iterator[Float32Array]
                if len(block.samples) and self._fits(block):
                    captured_s, parts = block.captured_s, self._sound(block)
                elif time.monotonic() - accepted_s >= wait_s:
                    captured_s, self._behind = time.monotonic(), None
                    stalled_s = (captured_s - self._captured_s) * self._feed.speed
                    parts = self._zeros(round(min(max(stalled_s, 0.0), LONGEST_GAP_S) * self.sample_rate_hz))
                else:
                    continue
                for samples in parts:
                    self.frames += len(samples)
                    self._captured_s = captured_s
                    if self._keep is not None:
                        self._keep(samples)
                    yield samples
                accepted_s = time.monotonic()
        finally:
            self._feed.stop()

    def close(self) -> None:
        """End `blocks` after the waiting blocks; may be called from any thread or a signal handler."""
        self._channel.close()

    def age_s(self, sample: int) -> float:
        """Return how long ago a sample of the last block was captured, seconds."""
        behind_s = (self.frames - sample) / (self.sample_rate_hz * self._feed.speed)
        return time.monotonic() - self._captured_s + behind_s

    def stamp_ns(self, captured_s: float) -> int:
        """Convert a time of `time.monotonic` to the stream's clock.

        The last block links the two clocks, because a converter that is wrong by 50 ppm would be off by 4 s
        after a day.
        """
        since_s = (captured_s - self._captured_s) * self._feed.speed
        return self.start_ns + nanoseconds(self.frames / self.sample_rate_hz + since_s)

    def _missing(self, block: SoundBlock) -> int:
        """Return the number of samples missing between the last sample and a block."""
        # After a stall the device's numbers are unrelated to the earlier ones.
        return 0 if self._behind is None else block.first + self._behind - self.frames

    def _checked(self, given: object) -> SoundBlock:
        """Return a valid block of a feed; count and replace anything else, also None."""
        if isinstance(given, SoundBlock):
            samples, first, captured_s = given.samples, given.first, given.captured_s
            known = isinstance(first, int | np.integer) and isinstance(captured_s, Real)
            floats = isinstance(samples, np.ndarray) and samples.dtype.kind == "f"
            fits = given is NO_SOUND or (floats and samples.shape[1:] == (self.channels,))
            if known and fits and abs(captured_s) < _LATEST_S:
                return given
        self.refused += 1
        return NO_SOUND

    def _fits(self, block: SoundBlock) -> bool:
        """Return whether a block continues the stream; count it if not."""
        # Sound that a device held back during a stall has already been replaced by zeros.
        late = self._behind is None and block.captured_s <= self._captured_s
        if late or not 0 <= self._missing(block) <= LONGEST_GAP_S * self.sample_rate_hz:
            self.refused += 1
            return False
        if self._behind is None:
            self._behind = self.frames - block.first
        return True

    def _sound(self, block: SoundBlock) -> Iterator[Float32Array]:
        """Yield a block that continues the stream, after zeros for the sound lost before it."""
        yield from self._zeros(self._missing(block))
        usable = np.abs(block.samples) <= LARGEST_SAMPLE
        self.refused += not usable.all()
        # Zero only the unusable samples, so that a faulty microphone is silent and the others are still used.
        yield block.samples if usable.all() else np.where(usable, block.samples, np.float32(0.0))

    def _zeros(self, missing: int) -> Iterator[Float32Array]:
        """Yield zeros, at most 1 s, for lost sound; the rest is added to the start time of the stream."""
        self.lost_samples += missing
        # Whole hops, so that stamps stay on their grid.
        hops = max(int(HOP_RATE_HZ * (missing / self.sample_rate_hz - HEARD_SILENCE_S)), 0)
        left_out = round(hops * self.sample_rate_hz / HOP_RATE_HZ)
        if missing > left_out:
            yield np.zeros((missing - left_out, self.channels), np.float32)
        self.start_ns += nanoseconds(hops / HOP_RATE_HZ)
        if self._behind is not None:
            self._behind -= left_out
        while self._keep is not None and left_out > 0:
            some = min(left_out, self.sample_rate_hz)
            self._keep(np.zeros((some, self.channels), np.float32))
            left_out -= some


@contextmanager
def kept_sound(
    path: Path | None, sample_rate_hz: int, channels: int
) -> Iterator[Callable[[Float32Array], None] | None]:
    """Yield a function that writes blocks to a file that is readable at any time; None without a path."""
    if path is None:
        yield None
        return
    if path.suffix.lower() not in (".wav", ".rf64"):
        raise InputFileError(path, "expected a name that ends in .wav or .rf64")
    with (
        claimed_file(path) as raw,
        soundfile.SoundFile(
            raw.fileno(), "w", sample_rate_hz, channels, _SUBTYPE, format=_FORMAT, closefd=False
        ) as file,
    ):
        # Update the length in the header after every block; soundfile has no function for it.
        soundfile._snd.sf_command(file._file, _UPDATE_HEADER, soundfile._ffi.NULL, 1)

        whole = True

        def write(samples: Float32Array) -> None:
            nonlocal whole
            try:
                if whole and is_named(raw, path):
                    file.write(samples)
                    return
                problem = "it was moved or removed"
            except (soundfile.LibsndfileError, AssertionError):
                problem = "no room to write"
            if whole:
                kept_s = file.tell() / sample_rate_hz
                _LOG.warning("%s: nothing is kept after %.1f s: %s", path, kept_s, problem)
            whole = False

        yield write


# A delay above this share of a block means lost samples; a smaller one is jitter of the callback.
_LOST_SHARE = 0.5


class MissingPortAudioError(WorldstateError):
    """The package sounddevice is installed, but not the system's library PortAudio."""


def portaudio() -> Any:
    """Return the module `sounddevice`.

    Raises
    ------
    MissingExtraError
        If the package is not installed.
    MissingPortAudioError
        If the PortAudio library is not found.
    """
    try:
        return optional("sounddevice")
    except OSError as error:
        raise MissingPortAudioError(
            "expected the system's library PortAudio, but it is missing: install it "
            "(Debian, Ubuntu: apt-get install libportaudio2; Fedora: dnf install portaudio; "
            "macOS and Windows: it comes with sounddevice)"
        ) from error


class PortAudioInput:
    """The first channels of an input device, one per microphone.

    Parameters
    ----------
    channels : int
        Number of microphones.
    sample_rate_hz : int
        Samples per second.
    device : int or str, optional
        Number of the device or part of its name; by default the system's input.

    Raises
    ------
    MissingExtraError, MissingPortAudioError
        If sounddevice or PortAudio is not installed.
    InvalidArgumentError
        If there is no such device, it has too few channels, or it does not support this sample rate.
    """

    def __init__(self, channels: int, sample_rate_hz: int, device: int | str | None = None) -> None:
        self._sounddevice = portaudio()
        self.channels, self.sample_rate_hz, self.speed = channels, sample_rate_hz, 1.0
        self.overflows = 0
        self._device = device
        self.name = self._checked_name()
        self._stream: Any = None
        self._next = 0
        self._begun_s: float | None = None

    def start(self, into: BoundedChannel[SoundBlock], /) -> None:
        """Open the device and start to record."""
        self._stream = self._sounddevice.InputStream(
            samplerate=self.sample_rate_hz,
            blocksize=block_samples(self.sample_rate_hz),
            device=self._device,
            channels=self.channels,
            dtype="float32",
            callback=lambda samples, frames, times, status: into.put(self._block(samples, times, status)),
        )
        self._stream.start()

    def stop(self) -> None:
        """Close the device."""
        if self._stream is not None:
            self._stream.close()

    def _block(self, samples: Float32Array, times: Any, status: Any) -> SoundBlock:
        """Stamp and copy a block, because PortAudio overwrites its array after the call."""
        now_s, taken_s = time.monotonic(), times.inputBufferAdcTime
        length_s = len(samples) / self.sample_rate_hz
        if status.input_overflow:
            self.overflows += 1
            self._next += self._lost(taken_s, length_s)
        first, self._next = self._next, self._next + len(samples)
        # Some drivers give no capture time; then the time of the call is used.
        age_s = max(times.currentTime - taken_s - length_s, 0.0) if taken_s else 0.0
        if taken_s:
            self._begun_s = taken_s - first / self.sample_rate_hz
        return SoundBlock(samples.copy(), first, now_s - age_s)

    def _lost(self, taken_s: float, length_s: float) -> int:
        """Return the number of samples lost in an overflow, from the time of the first sample after it."""
        if not taken_s or self._begun_s is None:
            return 0
        lost_s = taken_s - self._begun_s - self._next / self.sample_rate_hz
        return round(lost_s * self.sample_rate_hz) if lost_s > _LOST_SHARE * length_s else 0

    def _checked_name(self) -> str:
        sounddevice = self._sounddevice
        inputs = [one for one in sounddevice.query_devices() if one["max_input_channels"] > 0]
        if not inputs:
            raise InvalidArgumentError("--device: expected a device with microphones, PortAudio finds none")
        try:
            found = sounddevice.query_devices(self._device, "input")
            rate = self.sample_rate_hz
            sounddevice.check_input_settings(self._device, self.channels, "float32", samplerate=rate)
        except (ValueError, sounddevice.PortAudioError) as error:
            known = "; ".join(f"{one['index']} {one['name']} ({one['max_input_channels']})" for one in inputs)
            wanted = f"{self.channels} channels at {self.sample_rate_hz} Hz"
            got = f"got {self._device!r}: {error}"
            problem = f"expected a device with {wanted}, {got}. There are, with their channels: {known}"
            raise InvalidArgumentError(f"--device: {problem}") from error
        return str(found["name"])


class Playback:
    """Replay the blocks of a recording at the times of a converter.

    The capture time of a block is the time at which its last sample is due, so that a late player appears as
    latency.

    Parameters
    ----------
    audio : Audio
        The recording, which is closed with the playback.
    speed : float
        Seconds of sound per second, in [0.1, 100].
    duration_s : float, optional
        Seconds of sound after which the playback ends; a shorter recording is repeated. By default the
        recording is played once.
    """

    def __init__(self, audio: Audio, speed: float = 1.0, duration_s: float | None = None) -> None:
        self.name, self.overflows = str(audio.path), 0
        self.sample_rate_hz, self.channels = audio.sample_rate_hz, audio.channels
        self.speed = in_range("speed", speed, 0.1, 100.0)
        self._audio = audio
        length = audio.frames if duration_s is None else round(duration_s * audio.sample_rate_hz)
        self._length = int(in_range("duration_s", length, 1, 1 << 62))
        self._stopped = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, into: BoundedChannel[SoundBlock], /) -> None:
        """Start to play."""
        self._thread = threading.Thread(target=self._play, args=(into,), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop, and close the recording."""
        self._stopped.set()
        if self._thread is not None:
            self._thread.join()
        self._audio.close()

    def _play(self, into: BoundedChannel[SoundBlock]) -> None:
        error: BaseException | None = None
        try:
            begun_s, sent = time.monotonic(), 0
            for samples in self._blocks():
                sent += len(samples)
                due_s = begun_s + sent / (self.sample_rate_hz * self.speed)
                if self._stopped.wait(max(due_s - time.monotonic(), 0.0)):
                    break
                into.put(SoundBlock(samples, sent - len(samples), due_s))
        except Exception as failure:  # raised in the thread that takes the blocks
            error = failure
        into.close(error)

    def _blocks(self) -> Iterator[Float32Array]:
        left, frames = self._length, block_samples(self.sample_rate_hz)
        while left > 0:
            for samples in self._audio.blocks(frames):
                yield samples[:left]
                left -= len(samples)
                if left <= 0:
                    return
