"""A recording played as if microphones heard it now."""

import threading
import time
from collections.abc import Iterator

from worldstate.adapters.audio.sound_file import Audio
from worldstate.ground.checks import in_range
from worldstate.ground.typing import Float32Array

from .bounded_channel import BoundedChannel
from .live_sound import SoundBlock, block_samples


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
        except Exception as failure:  # it is raised at whoever takes the blocks
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
