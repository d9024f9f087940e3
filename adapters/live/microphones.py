"""Where live sound comes from: microphones through PortAudio, or a recording played in their place."""

import threading
import time
from collections.abc import Iterator
from typing import Any

from worldstate.adapters.audio.sound_file import Audio
from worldstate.ground import InvalidArgumentError, WorldstateError, in_range
from worldstate.ground.extras import optional
from worldstate.ground.typing import Float32Array

from .bounded_channel import BoundedChannel
from .live_sound import SoundBlock, block_samples

# Lost samples are told from the jitter of a callback's time by this share of a block.
_LOST_SHARE = 0.5


class MissingPortAudioError(WorldstateError):
    """The package sounddevice is installed, the system's library PortAudio is not."""


def portaudio() -> Any:
    """Return the module `sounddevice`.

    Raises
    ------
    MissingExtraError
        If it is not installed.
    MissingPortAudioError
        If it finds no PortAudio library.
    """
    try:
        return optional("sounddevice")
    except OSError as error:
        raise MissingPortAudioError(
            "expected the system's library PortAudio, found none: install it "
            "(Debian, Ubuntu: apt-get install libportaudio2; Fedora: dnf install portaudio; "
            "macOS and Windows: it comes with sounddevice)"
        ) from error


class PortAudioInput:
    """The first channels of an input device, one a microphone.

    Parameters
    ----------
    channels : int
        Number of microphones.
    sample_rate_hz : int
        Samples a second.
    device : int or str, optional
        Number or part of the name of the device; the system's default input where not given.

    Raises
    ------
    MissingExtraError, MissingPortAudioError
        If sounddevice or PortAudio is not installed.
    InvalidArgumentError
        If there is no such device, or it has not so many channels or not that rate.
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
        """Open the device and begin to record."""

        def on_block(samples: Float32Array, frames: int, times: Any, status: Any) -> None:
            into.put(self._block(samples, times, status))

        self._stream = self._sounddevice.InputStream(
            samplerate=self.sample_rate_hz,
            blocksize=block_samples(self.sample_rate_hz),
            device=self._device,
            channels=self.channels,
            dtype="float32",
            callback=on_block,
            finished_callback=into.close,
        )
        self._stream.start()

    def stop(self) -> None:
        """Close the device."""
        if self._stream is not None:
            self._stream.close()

    def _block(self, samples: Float32Array, times: Any, status: Any) -> SoundBlock:
        """Stamp what the device gave; the array is PortAudio's own and is overwritten after the call."""
        now_s, taken_s = time.monotonic(), times.inputBufferAdcTime
        length_s = len(samples) / self.sample_rate_hz
        if status.input_overflow:
            self.overflows += 1
            self._next += self._lost(taken_s, length_s)
        first, self._next = self._next, self._next + len(samples)
        # Some drivers give no capture time; then the block is as old as the call.
        age_s = max(times.currentTime - taken_s - length_s, 0.0) if taken_s else 0.0
        if taken_s:
            self._begun_s = taken_s - first / self.sample_rate_hz
        return SoundBlock(samples.copy(), first, now_s - age_s)

    def _lost(self, taken_s: float, length_s: float) -> int:
        """Return how many samples an overflow has cost, by the time of the first one after it."""
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
    """Give the blocks of a recording at the times at which a converter would.

    A block counts as captured when its last sample is due, so that a late player shows as latency.

    Parameters
    ----------
    audio : Audio
        The recording; closed with the playback.
    speed : float
        Seconds of sound a second, in [0.1, 100].
    duration_s : float, optional
        Seconds of sound after which it ends; a recording that is shorter is played again from its start.
        Its own length where not given.
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
        """Begin to play."""
        self._thread = threading.Thread(target=self._play, args=(into,), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End, and close the recording."""
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
        except Exception as failure:  # it is raised where the blocks are taken
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
