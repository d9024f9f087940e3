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
        self.images = read_detections(recording / "camera_baseline_results.json").frames
        self.speed, self.begun_s = speed, None

    def wait_until(self, time_s):
        """Wait until so much sound has been played; return whether there is as much."""
        while self.begun_s is None or self.speed * (time.monotonic() - self.begun_s) < time_s:
            time.sleep(0.002)
        return time_s < len(self.samples) / self.rate_hz


class SoundCard(ModuleType):
    """Stand-in for sounddevice."""

    class PortAudioError(Exception):
        pass

    def __init__(self, street):
        super().__init__("sounddevice")
        self.street, self.__spec__ = street, ModuleSpec("sounddevice", None)

    def query_devices(self, device=None, kind=None):
        one = {"index": 0, "name": "roof", "max_input_channels": self.street.samples.shape[1]}
        return [one] if kind is None else one

    def check_input_settings(self, device, channels, dtype, samplerate):
        assert (channels, samplerate) == (self.street.samples.shape[1], self.street.rate_hz)

    def InputStream(self, *, callback, blocksize, **settings):  # noqa: N802 - its name there
        street, closed = self.street, threading.Event()

        def play():
            street.begun_s = time.monotonic()
            none = SimpleNamespace(inputBufferAdcTime=0.0, currentTime=0.0)
            for first in range(0, len(street.samples), blocksize):
                block = street.samples[first : first + blocksize]
                street.wait_until((first + len(block)) / street.rate_hz)
                if closed.is_set():
                    return
                callback(block, len(block), none, SimpleNamespace(input_overflow=False))

        thread = threading.Thread(target=play, daemon=True)
        return SimpleNamespace(start=thread.start, close=closed.set)


class Camera:
    """Stand-in for VideoCapture of OpenCV: image k at 0.1 k s, its number in a pixel."""

    def __init__(self, street):
        self.street, self.number = street, -1

    def isOpened(self):  # noqa: N802 - its name there
        return True

    def read(self):
        self.number += 1
        if self.number >= len(self.street.images) or not self.street.wait_until(0.1 * self.number):
            return False, None
        image = np.zeros((1216, 1936, 3), np.uint8)
        image[0, 0, 0] = self.number
        return True, image

    def release(self):
        pass


def stand_in(monkeypatch, recording, speed=2.0):
    """Replace sound card, camera and detector by a recording."""
    street, yolo = Street(recording, speed), ModuleType("ultralytics")

    def model(weights):
        return lambda image, verbose: [Results(street.images[image[0, 0, 0]], ("person", "car"))]

    yolo.YOLO = model
    monkeypatch.setitem(sys.modules, "sounddevice", SoundCard(street))
    monkeypatch.setitem(sys.modules, "ultralytics", yolo)
    monkeypatch.setattr("cv2.VideoCapture", lambda device: Camera(street))


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

    class Capture:
        def __init__(self, device):
            self._left = images if device == 0 else -1

        def isOpened(self):  # noqa: N802 - its name there
            return self._left >= 0

        def read(self):
            time.sleep(0.1)
            self._left -= 1
            return (True, np.full((480, 640, 3), 90, np.uint8)) if self._left >= 0 else (False, None)

        def release(self):
            pass

    opencv = SimpleNamespace(VideoCapture=Capture)
    monkeypatch.setattr("worldstate.adapters.live.live_sensors.optional", lambda module: opencv)
