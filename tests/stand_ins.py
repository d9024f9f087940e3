"""Stand-ins for sound card, camera and detector that play a recording."""

import math
import socket
import sys
import threading
import time
from contextlib import contextmanager
from importlib.machinery import ModuleSpec
from types import ModuleType, SimpleNamespace

import numpy as np
import soundfile

from worldstate.adapters.camera.detections import read_detections


class Tensor:
    """A tensor of a graphics card: an array only after `cpu`, as in torch."""

    def __init__(self, values):
        self._values = values

    def cpu(self):
        return self._values


class Results:
    """Results of ultralytics: `names` and tensors of `boxes`."""

    def __init__(self, frame, names):
        self.names = dict(enumerate(names))
        numbers = np.array([names.index(label) for label in frame.labels], dtype=np.float32)
        corners, scores = frame.boxes_px.astype(np.float32), frame.scores.astype(np.float32)
        self.boxes = SimpleNamespace(xyxy=Tensor(corners), conf=Tensor(scores), cls=Tensor(numbers))


class Street:
    """One recording, played at `speed` by sound card and camera."""

    def __init__(self, recording, speed):
        self.samples, self.rate_hz = soundfile.read(recording / "out_multi.wav", dtype="float32")
        self.frames = read_detections(recording / "camera_baseline_results.json").frames
        self.speed, self.begun_s = speed, None
        self.card = SoundCard(self.samples.shape[1], self)

    def wait_until(self, time_s):
        """Wait until so much sound has been played; return whether there is as much."""
        while self.begun_s is None or self.speed * (time.monotonic() - self.begun_s) < time_s:
            time.sleep(0.002)
        return time_s < len(self.samples) / self.rate_hz

    def __iter__(self):
        """Yield the sound in blocks for a `SoundCard`."""
        self.begun_s, length = time.monotonic(), self.card.stream.blocksize
        for first in range(0, len(self.samples), length):
            block = self.samples[first : first + length]
            self.wait_until((first + len(block)) / self.rate_hz)
            yield block, 0.0, False

    def images(self):
        """Yield image k at 0.1 k s, with its number in a pixel."""
        for number in range(len(self.frames)):
            if not self.wait_until(0.1 * number):
                return
            image = np.zeros((1216, 1936, 3), np.uint8)
            image[0, 0, 0] = number
            yield image


class SoundCard(ModuleType):
    """Stand-in for sounddevice with one device, which gives blocks: samples, time of capture, overflow."""

    class PortAudioError(Exception):
        pass

    def __init__(self, channels, blocks=()):
        super().__init__("sounddevice")
        self.__spec__, self.channels, self.blocks = ModuleSpec("sounddevice", None), channels, blocks

    def query_devices(self, device=None, kind=None):
        known = {"index": 3, "name": "roof array", "max_input_channels": self.channels}
        if kind is None:
            return [{"index": 0, "name": "speaker", "max_input_channels": 0}, known]
        if device not in (None, 3, "roof"):
            raise ValueError(f"No input device matching {device!r}")
        return known

    def check_input_settings(self, device, channels, dtype, samplerate):
        if channels > self.channels:
            raise self.PortAudioError("Invalid number of channels")

    def InputStream(self, **settings):  # noqa: N802 - its name there
        closed = threading.Event()
        self.stream = SimpleNamespace(**settings, start=self.give, close=closed.set, closed=closed)
        return self.stream

    def give(self):
        stream = self.stream
        for samples, taken_s, overflow in self.blocks:
            if stream.closed.is_set():
                return
            mine = np.array(samples[:, : stream.channels], np.float32)
            times = SimpleNamespace(inputBufferAdcTime=taken_s)
            times.currentTime = taken_s + len(mine) / stream.samplerate + 0.01
            stream.callback(mine, len(mine), times, SimpleNamespace(input_overflow=overflow))
            mine[:] = 99.0  # PortAudio writes the next one there


class Capture:
    """Stand-in for VideoCapture of OpenCV; a camera without images does not exist."""

    def __init__(self, images):
        self.images = images

    def isOpened(self):  # noqa: N802 - its name there
        return self.images is not None

    def read(self):
        image = next(self.images, None)
        return image is not None, image

    def release(self):
        pass


def stand_in(monkeypatch, recording, speed=2.0):
    """Replace sound card, camera and detector by a recording."""
    street, yolo = Street(recording, speed), ModuleType("ultralytics")

    def model(weights):
        return lambda image, verbose: [Results(street.frames[image[0, 0, 0]], ("person", "car"))]

    yolo.YOLO = model
    give = street.card.give
    street.card.give = lambda: threading.Thread(target=give, daemon=True).start()
    monkeypatch.setitem(sys.modules, "sounddevice", street.card)
    monkeypatch.setitem(sys.modules, "ultralytics", yolo)
    monkeypatch.setattr("cv2.VideoCapture", lambda device: Capture(street.images()))


def free_port(kind=socket.SOCK_DGRAM):
    with socket.socket(socket.AF_INET, kind) as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def send(port, *datagrams):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for datagram in datagrams:
            sender.sendto(datagram, ("127.0.0.1", port))


@contextmanager
def sending(port, *datagrams):
    """Send datagrams, or what functions return, 20 times per second from one port while the block runs."""
    ended = threading.Event()

    def again():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not ended.wait(0.05):
                for one in datagrams:
                    sender.sendto(one() if callable(one) else one, ("127.0.0.1", port))

    thread = threading.Thread(target=again)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def played(street, *more):
    """Return the words of `live` for the noise of a folder."""
    play = "--play", street / "street.wav", "--array", street / "mics.csv", "--uncalibrated"
    return ["live", *map(str, (*play, *more))]


def wall(monkeypatch, images=math.inf):
    """Replace cameras: number 0 shows a grey wall at 10 Hz, in so many images; others do not exist."""

    def grey():
        shown = 0
        while shown < images:
            time.sleep(0.1)
            shown += 1
            yield np.full((480, 640, 3), 90, np.uint8)

    opencv = SimpleNamespace(VideoCapture=lambda device: Capture(None if device else grey()))
    monkeypatch.setattr("worldstate.adapters.live.live_sensors.optional", lambda module: opencv)
