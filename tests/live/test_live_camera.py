"""A live camera and detector as the channel of co-evidence."""

import json
import resource
import socket
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from worldstate.abduction.co_evidence import Absent, Present, Unqueried
from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.vision_query import NO_LOOKS, REMEMBERED, VisionQuery
from worldstate.adapters.live.live_sensors import CameraFeed, DetectionSocket, ImageLooks, image_channel
from worldstate.adapters.live.live_sound import BoundedChannel, LiveSound
from worldstate.adapters.own_parts import OwnDetector
from worldstate.adapters.source import ListenSettings, Source, open_source
from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.ground.errors import InputFileError, OwnPartError
from worldstate.ground.values import nanoseconds
from worldstate.measurement.measurement import Bearing

CAMERA = PinholeCamera.ovad(width_px=640, height_px=480, position_m=(0.0, 0.0, 0.0), pitch_rad=0.0)
AHEAD = Bearing(0.0, 0.05)
EMPTY = DetectionFrame(np.empty((0, 4)), np.empty(0), ())


def box(left_px: float) -> DetectionFrame:
    return DetectionFrame(np.array([[left_px, 100.0, left_px + 120.0, 300.0]]), np.array([0.9]), ("car",))


def stamp(number: int) -> int:
    return nanoseconds(0.1 * number)


class Silent:
    name, sample_rate_hz, channels, speed, overflows = "silent", 48_000, 56, 1.0, 0

    def start(self, into: BoundedChannel, /) -> None:
        into.close()

    def stop(self) -> None:
        pass


@pytest.fixture(scope="module")
def source() -> Source:
    return open_source(LiveSound(Silent()), array=ovad_array(), camera=CAMERA, settings=ListenSettings())


def test_a_live_camera_equals_that_of_a_recording(source):
    # A car that crosses the image, stops and disappears.
    places = [None] * 10 + [30.0 * n for n in range(10)] + [300.0] * 15 + [None] * 5
    frames = [EMPTY if place is None else box(place) for place in places]
    log = DetectionLog.at_rate(frames, 10.0)
    recorded = replace(source, detections=log).camera_channel()
    live = replace(source, detections=NO_LOOKS).camera_channel()
    for number, frame in enumerate(frames):
        live.see(stamp(number), frame)
        assert live.ask(stamp(number), AHEAD) == recorded.ask(stamp(number), AHEAD)
        assert live.sightings(stamp(number)) == recorded.sightings(stamp(number))
        assert live.last_look(stamp(number)) == recorded.last_look(stamp(number))
    assert any(seen.moving for seen in recorded.sightings(stamp(15)))
    assert not any(seen.moving for seen in recorded.sightings(stamp(34)))


@pytest.mark.parametrize("rate_hz", [60, 100, 400])
def test_a_parked_car_is_static_at_any_frame_rate(source, rate_hz):
    camera = replace(source, detections=NO_LOOKS).camera_channel()
    for number in range(2 * rate_hz):
        camera.see(nanoseconds(number / rate_hz), box(300.0))
    assert [seen.moving for seen in camera.sightings(nanoseconds(2.0))] == [False]
    assert len(camera.detections) <= REMEMBERED


@pytest.mark.parametrize(
    ("places", "score"),
    [
        ((np.nan, 100.0, 400.0, 300.0), 0.9),
        ((300.0, 100.0, 400.0, 300.0), np.nan),
        ((300.0, 100.0, 400.0, 300.0), 1.7),
        ((400.0, 100.0, 300.0, 300.0), 0.9),
    ],
)
def test_wrong_boxes_are_counted_and_the_run_continues(source, places, score):
    class Broken:
        def detect(self, image):
            return DetectionFrame(np.array([places]), np.array([score]), ("car",))

    camera, images = replace(source, detections=NO_LOOKS).camera_channel(), image_channel()
    images.put((0.9, np.zeros((480, 640, 3), np.uint8)))
    assert ImageLooks(images, Broken(), nanoseconds, (640, 480)).deliver(camera.see) == 1
    assert camera.sightings(stamp(10)) == ()


def test_without_an_image_the_camera_is_unqueried(source):
    camera = replace(source, detections=NO_LOOKS).camera_channel()
    assert isinstance(camera.ask(0, AHEAD), Unqueried)
    camera.see(0, EMPTY)
    assert isinstance(camera.ask(stamp(1), AHEAD), Absent)
    # The camera hangs, so its last image is no current look.
    assert isinstance(camera.ask(stamp(5), AHEAD), Unqueried)
    camera.see(stamp(5), box(260.0))
    assert isinstance(camera.ask(stamp(5), AHEAD), Present)


def test_looks_out_of_order_are_dropped(source):
    camera = source.camera_channel()
    for look in ((stamp(5), EMPTY), (stamp(3), box(260.0)), (stamp(5), box(260.0))):
        camera.see(*look)
    assert isinstance(camera.ask(stamp(5), AHEAD), Absent)


class Counting:
    """A detector that finds one box and counts its images."""

    def __init__(self) -> None:
        self.seen = 0

    def detect(self, frame: np.ndarray) -> DetectionFrame:
        self.seen += 1
        return box(float(frame[0, 0, 0]))


def camera_day(source: Source, hops: int) -> tuple[VisionQuery, int, int]:
    """Pass three images per hop and query at every tenth hop."""
    images, detector = image_channel(), Counting()
    looks = ImageLooks(images, detector, nanoseconds, (640, 480))
    camera = source.camera_channel()
    image = np.zeros((480, 640, 3), np.uint8)
    for hop in range(hops):
        for part in range(3):
            images.put((0.1 * hop + 0.03 * part, image))
        if hop % 10 == 9:
            looks.deliver(camera.see)
            camera.ask(nanoseconds(0.1 * hop + 0.06), AHEAD)
    return camera, detector.seen, images.dropped


def test_the_camera_keeps_a_bounded_memory(source):
    camera, seen, dropped = camera_day(source, 300)
    assert seen == 30 * 4
    assert seen + dropped == 900
    assert camera.detections is not None
    assert len(camera.detections.frames) == REMEMBERED


def test_images_of_another_size_are_dropped(source):
    images = image_channel()
    for height, width in ((720, 1280), (480, 640)):
        images.put((0.0, np.zeros((height, width, 3), np.uint8)))
    looks = ImageLooks(images, Counting(), nanoseconds, (640, 480))
    assert looks.deliver(source.camera_channel().see) == looks.refused == 1
    assert "expected images of the lens's 640 x 480 px, got 1280 x 720" in looks.problem


def test_a_box_outside_the_image_costs_only_its_look(source):
    camera = replace(source, detections=NO_LOOKS).camera_channel()
    detections = DetectionSocket("127.0.0.1:0", lambda at_s: stamp(1))
    outside, inside = (
        {"boxes": [[x, 100, x + 120, 300]], "scores": [0.9], "classes_str": ["car"]} for x in (5000, 260)
    )
    sent(detections, json.dumps(outside).encode(), json.dumps(inside).encode(), take=camera.see)
    assert detections.refused == 1
    assert "expected boxes within the camera's 640 x 480 px" in detections.problem
    assert isinstance(camera.ask(stamp(1), AHEAD), Present)


def sent(
    detections: DetectionSocket, *datagrams: bytes, take=lambda *look: None
) -> list[tuple[int, DetectionFrame]]:
    looks = []
    with detections, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as detector:
        for datagram in datagrams:
            detector.sendto(datagram, ("127.0.0.1", detections.port))
        until_s = time.monotonic() + 5.0
        while len(looks) + detections.refused < len(datagrams) and time.monotonic() < until_s:
            detections.deliver(lambda *look: (take(*look), looks.append(look)))
            time.sleep(0.01)
    return looks


def test_datagrams_carry_detections_with_their_age(source):
    now_ns = time.monotonic_ns()
    one = {"boxes": [[260, 100, 380, 300]], "scores": [0.9], "classes_str": ["car"], "age_s": 2.0}
    none = {"boxes": [], "scores": [], "classes_str": []}
    detections = DetectionSocket("127.0.0.1:0", nanoseconds)
    looks = sent(detections, json.dumps(one).encode(), json.dumps(none).encode())
    assert [frame.labels for _, frame in looks] == [("car",), ()]
    assert looks[0][0] - now_ns == pytest.approx(-2e9, abs=1e9)
    assert looks[1][0] > now_ns


def test_unreadable_datagrams_are_counted_and_reported():
    wrong = [b"\xff", b"[]", b'{"boxes": [[1, 2, 3, 4]], "scores": [], "classes_str": []}']
    detections = DetectionSocket("127.0.0.1:0", nanoseconds)
    assert sent(detections, *wrong) == []
    assert detections.refused == 3
    assert "1 boxes, 0 scores" in detections.problem


class Odd:
    """A detector with a different fault per image."""

    def __init__(self) -> None:
        self._given = iter([None, RuntimeError("no memory on the card"), 7, KeyError("boxes"), box(260.0)])

    def detect(self, image: np.ndarray) -> object:
        given = next(self._given)
        if isinstance(given, Exception):
            raise given
        return given


@pytest.mark.parametrize("own", [Odd, lambda: OwnDetector("mine", Odd())])
def test_a_failing_callback_costs_only_its_image(source, own):
    camera, images = replace(source, detections=NO_LOOKS).camera_channel(), image_channel()
    looks, problems = ImageLooks(images, own(), nanoseconds, (640, 480)), []
    for number, image in enumerate([None, np.zeros(4), *[np.zeros((480, 640, 3), np.uint8)] * 5]):
        images.put((0.1 * number, image))
        try:
            looks.deliver(camera.see)
        except OwnPartError as error:  # an error in a user's detector ends the run with its name
            problems.append(str(error))
            continue
        problems.append(looks.problem)
    assert looks.refused + sum("mine: expected a part" in one for one in problems) == 6
    assert "expected images, got NoneType" in problems[0]
    assert "ultralytics, got None" in problems[2]
    assert "no memory on the card" in problems[3]
    assert [seen.label for seen in camera.sightings(nanoseconds(0.6))] == ["car"]


IMAGE = np.zeros((480, 640, 3), np.uint8)
NO_IMAGES = (
    *(None, 5, "image", (), (0.1,), (0.1, IMAGE, 1), [0.1, IMAGE], IMAGE),
    *((at_s, IMAGE) for at_s in (None, "now", 1j, float("nan"), float("inf"), 1e308)),
    *((0.1, image) for image in (None, "image", IMAGE.tolist(), IMAGE[0], IMAGE[:, :, None])),
    *((0.1, IMAGE.astype(kind)) for kind in (float, object, bool, np.int16)),
)


@pytest.mark.parametrize("given", NO_IMAGES, ids=range(len(NO_IMAGES)))
def test_wrong_images_cost_only_themselves(source, given):
    camera, images = replace(source, detections=NO_LOOKS).camera_channel(), image_channel()
    looks = ImageLooks(images, Counting(), nanoseconds, (640, 480))
    for one in (given, (0.2, IMAGE)):
        images.put(one)
    assert looks.deliver(camera.see) == looks.refused == 1
    assert camera.last_look(nanoseconds(0.2)) is not None


def test_the_error_of_a_camera_is_counted_once(source):
    images = image_channel()
    looks = ImageLooks(images, Counting(), nanoseconds, (640, 480))
    images.close(OSError("unplugged"))
    assert [looks.deliver(source.camera_channel().see) for _ in range(3)] == [1, 0, 0]
    assert "unplugged" in looks.problem


class Capture:
    """Stand-in for VideoCapture of OpenCV that stops after three images."""

    def __init__(self, device: int) -> None:
        self._left = 3 if device == 0 else 0
        self._there = device == 0

    def isOpened(self) -> bool:  # noqa: N802 - its name there
        return self._there

    def read(self) -> tuple[bool, np.ndarray | None]:
        time.sleep(0.01)
        self._left -= 1
        return (True, np.zeros((480, 640, 3), np.uint8)) if self._left >= 0 else (False, None)

    def release(self) -> None:
        self._there = False


@pytest.fixture
def cameras(monkeypatch):
    monkeypatch.setattr(
        "worldstate.adapters.live.live_sensors.optional", lambda module: SimpleNamespace(VideoCapture=Capture)
    )


def test_a_camera_that_stops_gives_its_images_first(cameras):
    images, taken = image_channel(), []
    with CameraFeed(0, images), pytest.raises(TimeoutError):
        while (image := images.take(1.0)) is not None:
            taken.append(image)
    stamps_s = [captured_s for captured_s, _ in taken]
    assert len(stamps_s) == 3
    assert stamps_s == sorted(stamps_s)
    assert 0.0 < time.monotonic() - stamps_s[0] < 5.0


def test_a_missing_camera_raises_an_error(cameras):
    with pytest.raises(InputFileError, match=r"camera 7: .* cannot be opened"):
        CameraFeed(7, image_channel())


@pytest.mark.slow
def test_a_day_of_looks_needs_no_more_memory(source):
    def largest_kb() -> int:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    camera_day(source, 600)
    before = largest_kb()
    # A day of ten images per second, three per hop of the loop.
    hops = 24 * 3600 * 10 // 3
    camera, seen, dropped = camera_day(source, hops)
    assert seen + dropped == 3 * hops
    assert camera.detections is not None
    assert len(camera.detections.frames) == REMEMBERED
    assert largest_kb() - before < 8 << 10
