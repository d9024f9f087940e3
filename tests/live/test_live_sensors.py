"""Cameras, detectors and datagrams of a live run: accepted, dropped and counted."""

import argparse
import hashlib
import hmac
import io
import json
import math
import re
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from camera_boxes import EMPTY, boxed
from stand_ins import free_port, played, send, sending, wall

from worldstate import Absent, DetectionFrame, PinholeCamera, Present, WorldFilter, nanoseconds
from worldstate.adapters import Checkpoint, DetectionLog, RawPcm, open_source
from worldstate.adapters.camera.vision_query import NO_LOOKS, REMEMBERED, VisionQuery
from worldstate.adapters.files.checkpoint_file import PortNumbers, read_checkpoint, save_checkpoint
from worldstate.adapters.live import live_sensors
from worldstate.adapters.live.live_sensors import (
    CameraFeed,
    DetectionSocket,
    ImageLooks,
    OdometrySocket,
    Trust,
    image_channel,
)
from worldstate.adapters.own_parts import OwnDetector
from worldstate.adapters.state_log import read_log
from worldstate.cli.live import _trust
from worldstate.cli.main import main
from worldstate.core.memory import MOST_BOXES
from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.ground.errors import InputFileError, InvalidArgumentError, OwnPartError
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
    return open_source(pipe, array=ovad_array(), camera=CAMERA, detections=NO_LOOKS).camera_channel()


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


SECRET = b"sixteen bytes or more"
LOOK = {"boxes": [], "scores": [], "classes_str": []}


def odometry(speed_mps, **more):
    return json.dumps({"speed_mps": speed_mps, "yaw_rate_rad_s": 0.0, **more}).encode()


def signed(speed_mps, number, key=SECRET, **other):
    """Return a datagram by the recipe of the page."""
    about = {"port": "odometry", "sent_s": time.time(), "number": number}
    text = odometry(speed_mps, **(about | other))
    return text + b"\n" + hmac.new(key, text, hashlib.sha256).hexdigest().encode()


def delivered(port, until, take=lambda *look: None):
    """Return the records that a port delivers until a condition holds, for at most 5 s."""
    found, until_s = [], time.monotonic() + 5.0
    while not until(found) and time.monotonic() < until_s:
        port.deliver(lambda *look: (take(*look), found.append(look[1])))
        time.sleep(0.005)
    return found


def look(*boxes, **more):
    about = {"boxes": boxes, "scores": [0.9] * len(boxes), "classes_str": ["car"] * len(boxes)}
    return json.dumps(about | more).encode()


def test_datagrams_carry_detections_with_their_age():
    now_ns = time.monotonic_ns()
    looks = []
    with DetectionSocket("127.0.0.1:0", nanoseconds) as told:
        send(told.port, look([260, 100, 380, 300], age_s=2.0), look())
        delivered(told, lambda found: len(found) == 2, lambda *one: looks.append(one))
    assert [frame.labels for _, frame in looks] == [("car",), ()]
    assert looks[0][0] - now_ns == pytest.approx(-2e9, abs=1e9)
    assert looks[1][0] > now_ns


def test_unreadable_datagrams_and_boxes_outside_the_image_cost_only_themselves(camera):
    unreadable = b"\xff", b"[]", look([1, 2, 3, 4], scores=[])
    places = (look([x, 100, x + 120, 300]) for x in (5000, 260))
    with DetectionSocket("127.0.0.1:0", lambda at_s: stamp(1)) as told:
        send(told.port, *unreadable)
        assert delivered(told, lambda found: told.refused == 3) == []
        assert "1 boxes, 0 scores" in told.problem
        send(told.port, *places)
        delivered(told, bool, camera.see)
    assert told.refused == 4
    assert "expected boxes within the camera's 640 x 480 px" in told.problem
    assert isinstance(camera.ask(stamp(1), AHEAD), Present)


def taken(trust, *sent, hosts=("127.0.0.1", "127.0.0.1")):
    """Send datagrams from two sockets; return the accepted speeds and the last problem."""
    speeds, senders = [], [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in hosts]
    for sender, host in zip(senders, hosts, strict=True):
        sender.bind((host, 0))
    with OdometrySocket("127.0.0.1:0", nanoseconds, trust) as told:
        for number, datagram in sent:
            # Set before sending, because the reading thread counts dropped datagrams at once.
            done = told.refused
            senders[number].sendto(datagram, ("127.0.0.1", told.port))
            records = delivered(told, lambda found, done=done: found or told.refused > done)
            speeds += [one.speed_mps for one in records]
    for sender in senders:
        sender.close()
    assert told.refused == len(sent) - len(speeds)
    return speeds, told.problem


def test_another_sender_replaces_a_silent_one(monkeypatch):
    monkeypatch.setattr(live_sensors, "PINNED_S", 0.0)
    assert taken(Trust(), (0, odometry(1, number=7)), (1, odometry(2, number=1)))[0] == [1, 2]


def test_only_allowed_addresses_are_accepted():
    sent = (0, odometry(1)), (1, odometry(2))
    speeds, problem = taken(Trust(allow=("127.0.0.2",)), *sent, hosts=("127.0.0.1", "127.0.0.2"))
    assert speeds == [2]
    assert "expected one of 127.0.0.2, got 127.0.0.1" in problem
    asked = argparse.Namespace(allow=["localhost", "127.0.0.2"], key=None)
    assert _trust(asked).allow == ("127.0.0.1", "127.0.0.2")
    with pytest.raises(InvalidArgumentError, match="--allow: expected hosts"):
        _trust(argparse.Namespace(allow=["no such host"], key=None))


NUMBERS = [(0, odometry(n, number=n)) for n in (1, 2, 2, 1, 3)]


@pytest.mark.parametrize(
    ("sent", "speeds", "problem"),
    [
        ([(0, odometry(1)), (1, odometry(2)), (0, odometry(3))], [1, 3], "the first one"),
        ([(1, b"nonsense"), (0, odometry(1)), (1, odometry(2))], [1], "the first one"),
        ([*NUMBERS, (0, odometry(4, number=4, age_s=2.1))], [1, 2, 3], "age_s"),
        # Clocks that differ by 2 ms lose no datagram.
        *(([(0, odometry(1, age_s=age_s))], [1], "") for age_s in (-0.002, -0.05)),
        *(([(0, odometry(1, age_s=bad))], [], "age_s") for bad in (-0.051, -3600, "x", None, [1], {}, True)),
    ],
)
def test_other_senders_old_numbers_and_wrong_ages_are_dropped(sent, speeds, problem):
    found, said = taken(Trust(), *sent)
    assert found == speeds and problem in said


def test_signed_datagrams_of_any_sender_are_accepted_once():
    first = signed(1, 1)
    wrong = [
        odometry(2, number=2),
        signed(3, 3, b"another secret of 16 bytes"),
        signed(4, None),  # without a number it could be replayed
        first,
        first.replace(b'"speed_mps": 1', b'"speed_mps": 9'),
    ]
    sent = [(0, first), *((1, one) for one in wrong), (1, signed(5, 5))]
    assert taken(Trust(key=SECRET), *sent)[0] == [1, 5]


@pytest.mark.parametrize(
    ("other", "problem"),
    [
        ({"port": "detections"}, "port: expected 'odometry', got 'detections'"),
        ({"port": None}, "port: expected 'odometry', got None"),
        ({"sent_s": None}, "sent_s: expected a finite number"),
        ({"sent_s": -6.0}, r"sent_s: expected a time within 0.5 s of now, got one 6.0.. s ago"),
        ({"sent_s": 6.0}, r"sent_s: expected a time within 0.5 s of now, got one -[56]...."),
    ],
)
def test_signatures_of_other_ports_and_times_are_dropped(other, problem):
    if isinstance(other.get("sent_s"), float):
        other = {"sent_s": time.time() + other["sent_s"]}
    speeds, said = taken(Trust(key=SECRET), (0, signed(1, 1, **other)), (0, signed(2, 2)))
    assert speeds == [2]
    assert re.match(problem, said), said


@pytest.mark.parametrize("camera", ["front", "rear"])
def test_signatures_of_another_camera_are_dropped(camera):
    with DetectionSocket("127.0.0.1:0", nanoseconds, Trust(key=SECRET), camera) as told:
        send(told.port, live_sensors.signed(LOOK, SECRET, "detections/front"))
        looks = delivered(told, lambda found: found or told.refused)
    wrong = "port: expected 'detections/rear', got 'detections/front'"
    assert (len(looks), told.problem) == ((1, "") if camera == "front" else (0, wrong))


def test_accepted_datagrams_are_dropped_after_a_restart():
    first, speeds, numbers = signed(1, 7), [], {}
    for datagram in (first, first, signed(2, 8)):
        with OdometrySocket("127.0.0.1:0", nanoseconds, Trust(key=SECRET, numbers=numbers)) as told:
            send(told.port, datagram)
            records = delivered(told, lambda found, told=told: found or told.refused)
            speeds += [one.speed_mps for one in records]
        numbers = told.numbers
    assert speeds == [1, 2]
    assert numbers == {"odometry": 8}


def test_numbers_are_saved_with_the_belief(tmp_path):
    save_checkpoint(tmp_path / "a.json", Checkpoint(WorldFilter(), ports=PortNumbers({"odometry": 2**62})))
    before, nothing = read_checkpoint(tmp_path / "a.json"), argparse.Namespace(allow=[], key=None)
    assert _trust(nothing, before).numbers == {"odometry": 2**62}
    assert _trust(nothing, Checkpoint(WorldFilter())).numbers == {}


def test_datagrams_of_strangers_displace_no_queued_ones():
    with OdometrySocket("127.0.0.1:0", nanoseconds, Trust(key=SECRET)) as told:
        send(told.port, signed(1, 1))
        for _ in range(20):
            send(told.port, *[b"rubbish"] * 50)
            time.sleep(0.01)
        send(told.port, signed(2, 2))
        until_s = time.monotonic() + 5.0
        while told.refused < 1000 and time.monotonic() < until_s:
            time.sleep(0.005)
        records = delivered(told, lambda found: len(found) == 2)
    assert [one.speed_mps for one in records] == [1, 2]
    assert (told.dropped, told.refused) == (0, 1000)


def test_the_recipe_of_the_page_is_accepted(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "reference" / "live_details.md").read_text("utf-8")
    recipe = next(one for one in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "hmac.new" in one)
    (tmp_path / "secret").write_bytes(SECRET + b"\n")
    monkeypatch.chdir(tmp_path)
    with DetectionSocket("127.0.0.1:0", nanoseconds, Trust(key=SECRET)) as told:
        exec(recipe.replace("9100", str(told.port)), {})
        assert (len(delivered(told, bool)), told.problem) == (1, "")


def test_a_short_secret_raises_an_error(street, tmp_path, capsys):
    (tmp_path / "key").write_text("short\n")
    assert main(played(street, "--odometry", "127.0.0.1:0", "--key", tmp_path / "key")) == 2
    assert "at least 16 bytes" in capsys.readouterr().err


def test_a_secret_is_not_printed():
    assert "sixteen" not in repr(Trust(key=SECRET))


# The requested number of datagrams per second, in bursts of 0.01 s.
FLOOD = """
import socket, sys, time
port, rate, size = map(int, sys.argv[1:])
sender, begun_s, sent = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), time.monotonic(), 0
while True:
    while sent < rate * (time.monotonic() - begun_s):
        sender.sendto(b"x" * size, ("127.0.0.1", port))
        sent += 1
    time.sleep(0.002)
"""


def fresh_looks(street, folder, keyed, *flood):
    """Return the share of hops after 2 s of 8 with a fresh look, under a flood of this rate and size."""
    port, folder = free_port(), folder / "-".join(map(str, (0, *flood)))
    folder.mkdir()
    (folder / "key").write_bytes(SECRET)
    seen = "--detections", f"127.0.0.1:{port}", "--camera", street / "lens.json", "--duration", 8
    words = played(street, *seen, "--out", folder / "s.jsonl", *(["--key", folder / "key"] if keyed else []))
    process = subprocess.Popen([sys.executable, "-m", "worldstate", *words])
    attack = [subprocess.Popen([sys.executable, "-c", FLOOD, str(port), *map(str, flood)])] if flood else []
    look = LOOK | {"age_s": 0.02}
    signing = partial(live_sensors.signed, look, SECRET, "detections")
    with sending(port, signing if keyed else json.dumps(look).encode()):
        assert process.wait(timeout=90) == 0
    for one in attack:
        one.kill()
        one.wait()
    states = [state for _, state in read_log(folder / "s.jsonl") if state.stamp_ns > 2_000_000_000]
    assert not flood or states[-1].delivery.refused > 100
    ages_ns = [min(state.stamp_ns - look.stamp_ns for look in state.searched) for state in states]
    return sum(age_ns <= 150_000_000 for age_ns in ages_ns) / len(ages_ns)


@pytest.mark.slow
@pytest.mark.parametrize("size", [7, 1_000])
@pytest.mark.parametrize("keyed", [True, False])
def test_a_flood_costs_at_most_a_tenth_of_the_looks(street, tmp_path, size, keyed):
    without, under = (fresh_looks(street, tmp_path, keyed, *flood) for flood in ((), (5_000, size)))
    print(f"keyed {keyed}, {size} bytes: {without:.3f} without, {under:.3f} under the flood")
    assert under >= 0.9 * without
