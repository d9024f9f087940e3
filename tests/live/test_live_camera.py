"""A live camera and detector as the channel of co-evidence."""

import io
import json
import math
import time
from functools import partial

import numpy as np
import pytest
from camera_boxes import EMPTY, boxed
from stand_ins import send, wall

from worldstate import Absent, DetectionFrame, PinholeCamera, Present, nanoseconds
from worldstate.adapters import DetectionLog, RawPcm, open_source
from worldstate.adapters.camera.vision_query import NO_LOOKS, REMEMBERED, VisionQuery
from worldstate.adapters.live.live_sensors import CameraFeed, DetectionSocket, ImageLooks, image_channel
from worldstate.adapters.own_parts import OwnDetector
from worldstate.core.memory import MOST_BOXES
from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.ground.errors import InputFileError, OwnPartError
from worldstate.measurement.measurement import Bearing

CAMERA = PinholeCamera.ovad(width_px=640, height_px=480, position_m=(0.0, 0.0, 0.0), pitch_rad=0.0)
AHEAD, IMAGE = Bearing(0.0, 0.05), np.zeros((480, 640, 3), np.uint8)


def box(left_px):
    return boxed((left_px, 100.0, left_px + 120.0, 300.0))


def stamp(number):
    return nanoseconds(0.1 * number)


@pytest.fixture
def camera():
    pipe = RawPcm(io.BytesIO(), 48_000, 56, "f32")
    source = open_source(pipe, array=ovad_array(), camera=CAMERA, detections=NO_LOOKS)
    return source.camera_channel()


class Fixed:
    """A detector that gives these parts in turn, or always a box; it counts its images."""

    def __init__(self, *given):
        self.given, self.seen = iter(given) if given else None, 0

    def detect(self, image):
        self.seen += 1
        found = box(float(image[0, 0, 0])) if self.given is None else next(self.given)
        if isinstance(found, Exception):
            raise found
        return found() if callable(found) else found


def looks_at(images, detector=None):
    return ImageLooks(images, detector or Fixed(), nanoseconds, (640, 480))


def test_a_live_camera_equals_that_of_a_recording(camera):
    # A car that crosses the image, stops and disappears.
    places = [None] * 10 + [30.0 * n for n in range(10)] + [300.0] * 15 + [None] * 5
    frames = [EMPTY if place is None else box(place) for place in places]
    recorded = VisionQuery(CAMERA, DetectionLog.at_rate(frames, 10.0))
    for number, frame in enumerate(frames):
        camera.see(stamp(number), frame)
        assert camera.ask(stamp(number), AHEAD) == recorded.ask(stamp(number), AHEAD)
        assert camera.sightings(stamp(number)) == recorded.sightings(stamp(number))
        assert camera.last_look(stamp(number)) == recorded.last_look(stamp(number))
    assert any(seen.moving for seen in recorded.sightings(stamp(15)))
    assert not any(seen.moving for seen in recorded.sightings(stamp(34)))


@pytest.mark.parametrize("rate_hz", [60, 100, 400])
def test_a_parked_car_is_static_at_any_frame_rate(camera, rate_hz):
    for number in range(2 * rate_hz):
        camera.see(nanoseconds(number / rate_hz), box(300.0))
    assert [seen.moving for seen in camera.sightings(nanoseconds(2.0))] == [False]
    assert len(camera.detections) <= REMEMBERED


def test_looks_out_of_order_are_dropped(camera):
    for look in ((stamp(5), EMPTY), (stamp(3), box(260.0)), (stamp(5), box(260.0))):
        camera.see(*look)
    assert isinstance(camera.ask(stamp(5), AHEAD), Absent)


def test_the_camera_keeps_a_bounded_memory(camera):
    """Three images per hop, and a query at every tenth hop."""
    images, detector = image_channel(), Fixed()
    looks = looks_at(images, detector)
    for hop in range(300):
        for part in range(3):
            images.put((0.1 * hop + 0.03 * part, IMAGE))
        if hop % 10 == 9:
            looks.deliver(camera.see)
            camera.ask(nanoseconds(0.1 * hop + 0.06), AHEAD)
    assert detector.seen == 30 * 4
    assert detector.seen + images.dropped == 900
    assert len(camera.detections.frames) == REMEMBERED


IMAGES = {
    "expected a time and an image": (*(None, 5, "image", (), (0.1,), (0.1, IMAGE, 1), [0.1, IMAGE]), IMAGE),
    "": tuple((at_s, IMAGE) for at_s in (None, "now", 1j, math.nan, math.inf, 1e308)),
    "expected images, got": (
        *((0.1, image) for image in (None, "image", IMAGE.tolist(), IMAGE[0], IMAGE[:, :, None])),
        *((0.1, IMAGE.astype(kind)) for kind in (float, object, bool, np.int16)),
    ),
    "images of the lens's 640 x 480 px, got 1280 x 720": ((0.1, np.zeros((720, 1280, 3), np.uint8)),),
}
NO_IMAGES = [(one, words) for words, given in IMAGES.items() for one in given]


@pytest.mark.parametrize(("given", "words"), NO_IMAGES, ids=range(len(NO_IMAGES)))
def test_wrong_images_cost_only_themselves(camera, given, words):
    images = image_channel()
    looks = looks_at(images)
    for one in (given, (0.2, IMAGE)):
        images.put(one)
    assert looks.deliver(camera.see) == looks.refused == 1
    assert words in looks.problem
    assert camera.last_look(nanoseconds(0.2)) is not None


GOOD = (300.0, 100.0, 400.0, 300.0)
WRONG = (((math.nan, *GOOD[1:]), 0.9), (GOOD, math.nan), (GOOD, 1.7), ((400.0, 100.0, 300.0, 300.0), 0.9))


@pytest.mark.parametrize(("places", "score"), WRONG)
def test_wrong_boxes_are_counted_and_the_run_continues(camera, places, score):
    images = image_channel()
    images.put((0.9, IMAGE))
    found = partial(DetectionFrame, np.array([places]), np.array([score]), ("car",))
    assert looks_at(images, Fixed(found)).deliver(camera.see) == 1
    assert camera.sightings(stamp(10)) == ()


@pytest.mark.parametrize("own", [lambda one: one, lambda one: OwnDetector("mine", one)])
def test_a_failing_detector_costs_only_its_image(camera, own):
    detector = Fixed(None, RuntimeError("no memory on the card"), 7, KeyError("boxes"), box(260.0))
    images, problems = image_channel(), []
    looks = looks_at(images, own(detector))
    for number in range(5):
        images.put((0.1 * number, IMAGE))
        try:
            looks.deliver(camera.see)
        except OwnPartError as error:  # an error in a user's detector ends the run with its name
            problems.append(str(error))
            continue
        problems.append(looks.problem)
    assert looks.refused + sum("mine: expected a part" in one for one in problems) == 4
    assert "ultralytics, got None" in problems[0]
    assert "no memory on the card" in problems[1]
    assert [seen.label for seen in camera.sightings(nanoseconds(0.4))] == ["car"]


def test_the_error_of_a_camera_is_counted_once(camera):
    images = image_channel()
    looks = looks_at(images)
    images.close(OSError("unplugged"))
    assert [looks.deliver(camera.see) for _ in range(3)] == [1, 0, 0]
    assert "unplugged" in looks.problem


def received(detections, *datagrams, take=lambda *look: None):
    looks = []
    with detections:
        send(detections.port, *datagrams)
        until_s = time.monotonic() + 5.0
        while len(looks) + detections.refused < len(datagrams) and time.monotonic() < until_s:
            detections.deliver(lambda *look: (take(*look), looks.append(look)))
            time.sleep(0.01)
    return looks


def look(*boxes, **more):
    about = {"boxes": boxes, "scores": [0.9] * len(boxes), "classes_str": ["car"] * len(boxes)}
    return json.dumps(about | more).encode()


def test_datagrams_carry_detections_with_their_age():
    now_ns = time.monotonic_ns()
    detections = DetectionSocket("127.0.0.1:0", nanoseconds)
    looks = received(detections, look([260, 100, 380, 300], age_s=2.0), look())
    assert [frame.labels for _, frame in looks] == [("car",), ()]
    assert looks[0][0] - now_ns == pytest.approx(-2e9, abs=1e9)
    assert looks[1][0] > now_ns


def test_unreadable_datagrams_and_boxes_outside_the_image_cost_only_themselves(camera):
    detections = DetectionSocket("127.0.0.1:0", lambda at_s: stamp(1))
    assert received(detections, b"\xff", b"[]", look([1, 2, 3, 4], scores=[])) == []
    assert detections.refused == 3
    assert "1 boxes, 0 scores" in detections.problem
    detections = DetectionSocket("127.0.0.1:0", lambda at_s: stamp(1))
    received(detections, *(look([x, 100, x + 120, 300]) for x in (5000, 260)), take=camera.see)
    assert detections.refused == 1
    assert "expected boxes within the camera's 640 x 480 px" in detections.problem
    assert isinstance(camera.ask(stamp(1), AHEAD), Present)


def test_a_camera_that_stops_gives_its_images_first_and_a_missing_one_an_error(monkeypatch):
    wall(monkeypatch, images=3)
    images, stamps_s = image_channel(), []
    with CameraFeed(0, images), pytest.raises(TimeoutError):
        while (image := images.take(1.0)) is not None:
            stamps_s.append(image[0])
    assert len(stamps_s) == 3
    assert stamps_s == sorted(stamps_s)
    assert 0.0 < time.monotonic() - stamps_s[0] < 5.0
    with pytest.raises(InputFileError, match=r"camera 7: .* cannot be opened"):
        CameraFeed(7, image_channel())


def test_a_crowded_image_keeps_the_highest_scores():
    """A hop with a thousand boxes costs no more than one with as many as are kept."""
    rng = np.random.default_rng(0)
    left, top = rng.uniform(0.0, 1800.0, 200), rng.uniform(0.0, 500.0, 200)
    places = np.stack([left, top, left + 100.0, top + 150.0], axis=1)
    scores, labels = rng.uniform(0.76, 1.0, 200), ("person",) * 100 + ("car",) * 100
    mixed = DetectionFrame(places, np.where(np.arange(200) < 100, 1.0, scores), labels)
    looked = VisionQuery(PinholeCamera.ovad(), None)
    looked.see(900_000_000, mixed)
    recorded = VisionQuery(PinholeCamera.ovad(), DetectionLog((mixed,), np.array([900_000_000])))
    highest = np.sort(scores[100:])[-MOST_BOXES:]
    for query in (looked, recorded):
        assert np.sort(query.detections.frames[0].scores).tolist() == highest.tolist()
        assert len(query.sightings(900_000_000)) == MOST_BOXES
