"""Accepted and dropped datagrams of a port."""

import argparse
import hashlib
import hmac
import json
import re
import socket
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from worldstate.adapters.files.checkpoint_file import (
    Checkpoint,
    PortNumbers,
    read_checkpoint,
    save_checkpoint,
)
from worldstate.adapters.live import live_sensors
from worldstate.adapters.live.live_sensors import DetectionSocket, OdometrySocket, Trust
from worldstate.cli.live import _trust
from worldstate.cli.main import main
from worldstate.core.filter import WorldFilter
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.values import nanoseconds

SECRET = b"sixteen bytes or more"


def odometry(speed_mps: float, **more: object) -> bytes:
    return json.dumps({"speed_mps": speed_mps, "yaw_rate_rad_s": 0.0, **more}).encode()


def signed(speed_mps: float, number: int, key: bytes = SECRET, **other: object) -> bytes:
    """Return a datagram by the recipe of the page."""
    about = {"port": "odometry", "sent_s": time.time(), "number": number}
    text = odometry(speed_mps, **(about | other))
    return text + b"\n" + hmac.new(key, text, hashlib.sha256).hexdigest().encode()


def taken(
    trust: Trust, *sent: tuple[int, bytes], hosts=("127.0.0.1", "127.0.0.1")
) -> tuple[list[float], str]:
    """Send datagrams from two sockets; return the accepted speeds and the last problem."""
    speeds: list[float] = []
    told = OdometrySocket("127.0.0.1:0", nanoseconds, trust)
    senders = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in hosts]
    for sender, host in zip(senders, hosts, strict=True):
        sender.bind((host, 0))
    with told:
        for number, datagram in sent:
            # Set before sending, because the reading thread counts dropped datagrams at once.
            done, until_s = len(speeds) + told.refused, time.monotonic() + 5.0
            senders[number].sendto(datagram, ("127.0.0.1", told.port))
            while len(speeds) + told.refused == done and time.monotonic() < until_s:
                told.deliver(lambda stamp_ns, record: speeds.append(record.speed_mps))
                time.sleep(0.005)
    for sender in senders:
        sender.close()
    assert told.refused == len(sent) - len(speeds)
    return speeds, told.problem


def test_the_first_sender_is_pinned():
    speeds, problem = taken(Trust(), (0, odometry(1)), (1, odometry(2)), (0, odometry(3)))
    assert speeds == [1, 3]
    assert "the first one" in problem


def test_unreadable_datagrams_do_not_pin_a_sender():
    assert taken(Trust(), (1, b"nonsense"), (0, odometry(1)), (1, odometry(2)))[0] == [1]


def test_another_sender_replaces_a_silent_one(monkeypatch):
    monkeypatch.setattr(live_sensors, "PINNED_S", 0.0)
    assert taken(Trust(), (0, odometry(1, number=7)), (1, odometry(2, number=1)))[0] == [1, 2]


def test_only_allowed_addresses_are_accepted():
    sent = (0, odometry(1)), (1, odometry(2))
    speeds, problem = taken(Trust(allow=("127.0.0.2",)), *sent, hosts=("127.0.0.1", "127.0.0.2"))
    assert speeds == [2]
    assert "expected one of 127.0.0.2, got 127.0.0.1" in problem


def test_hosts_are_allowed_by_name():
    asked = argparse.Namespace(allow=["localhost", "127.0.0.2"], key=None)
    assert _trust(asked).allow == ("127.0.0.1", "127.0.0.2")
    with pytest.raises(InvalidArgumentError, match="--allow: expected hosts"):
        _trust(argparse.Namespace(allow=["no such host"], key=None))


@pytest.mark.parametrize(("age_s", "read"), [(-0.002, True), (-0.05, True), (-0.051, False), (-3600, False)])
def test_small_negative_ages_count_as_zero(age_s, read):
    """Clocks that differ by 2 ms lose no datagram."""
    assert taken(Trust(), (0, odometry(1, age_s=age_s)), (0, odometry(2)))[0] == [1] * read + [2]


@pytest.mark.parametrize("age_s", ["x", None, [1], {}, True])
def test_an_age_that_is_no_number_is_dropped(age_s):
    assert taken(Trust(), (0, odometry(1, age_s=age_s)), (0, odometry(2)))[0] == [2]


def test_datagrams_with_old_numbers_are_dropped():
    sent = [odometry(n, number=n) for n in (1, 2, 2, 1, 3)] + [odometry(4, number=4, age_s=2.1)]
    assert taken(Trust(), *((0, one) for one in sent))[0] == [1, 2, 3]


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


def test_signatures_of_another_camera_are_dropped():
    look = {"boxes": [], "scores": [], "classes_str": []}
    for camera, looks in (("front", 1), ("rear", 0)):
        seen: list[object] = []
        with DetectionSocket("127.0.0.1:0", nanoseconds, Trust(key=SECRET), camera) as told:
            send(told.port, live_sensors.signed(look, SECRET, "detections/front"))
            wait_until(lambda told=told, seen=seen: told.deliver(lambda *look: seen.append(look)) or seen)
        assert len(seen) == looks
        assert told.problem == ("" if looks else "port: expected 'detections/rear', got 'detections/front'")


def test_accepted_datagrams_are_dropped_after_a_restart():
    first, speeds = signed(1, 7), []
    numbers: dict[str, int] = {}
    for datagram in (first, first, signed(2, 8)):
        trust = Trust(key=SECRET, numbers=numbers)
        with OdometrySocket("127.0.0.1:0", nanoseconds, trust) as told:
            send(told.port, datagram)
            before = len(speeds)
            wait_until(
                lambda told=told, before=before: (
                    told.deliver(lambda at_ns, one: speeds.append(one.speed_mps)) or len(speeds) > before
                )
            )
        numbers = told.numbers
    assert speeds == [1, 2]
    assert numbers == {"odometry": 8}


def test_numbers_are_saved_with_the_belief(tmp_path):
    save_checkpoint(tmp_path / "a.json", Checkpoint(WorldFilter(), ports=PortNumbers({"odometry": 2**62})))
    before = read_checkpoint(tmp_path / "a.json")
    assert _trust(argparse.Namespace(allow=[], key=None), before).numbers == {"odometry": 2**62}
    assert _trust(argparse.Namespace(allow=[], key=None), Checkpoint(WorldFilter())).numbers == {}


def test_datagrams_of_strangers_displace_no_queued_ones():
    sent = [live_sensors.signed({"speed_mps": n, "yaw_rate_rad_s": 0.0}, SECRET, "odometry") for n in (1, 2)]
    speeds: list[float] = []
    with OdometrySocket("127.0.0.1:0", nanoseconds, Trust(key=SECRET)) as told:
        send(told.port, sent[0])
        for _ in range(20):
            send(told.port, *[b"rubbish"] * 50)
            time.sleep(0.01)
        send(told.port, sent[1])
        wait_until(lambda: told.refused == 1000)
        wait_until(lambda: told.deliver(lambda at_ns, one: speeds.append(one.speed_mps)) and len(speeds) == 2)
    assert speeds == [1, 2]
    assert (told.dropped, told.refused) == (0, 1000)


def test_the_recipe_of_the_page_is_accepted(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "reference" / "live_details.md").read_text("utf-8")
    recipe = next(one for one in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "hmac.new" in one)
    (tmp_path / "secret").write_bytes(SECRET + b"\n")
    monkeypatch.chdir(tmp_path)
    looks: list[object] = []
    with DetectionSocket("127.0.0.1:0", nanoseconds, Trust(key=SECRET)) as told:
        exec(recipe.replace("9100", str(told.port)), {})
        wait_until(lambda: told.deliver(lambda *look: looks.append(look)) or looks)
    assert (len(looks), told.problem) == (1, "")


def send(port: int, *datagrams: bytes) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for datagram in datagrams:
            sender.sendto(datagram, ("127.0.0.1", port))


def wait_until(holds: Callable[[], object]) -> None:
    until_s = time.monotonic() + 5.0
    while not holds() and time.monotonic() < until_s:
        time.sleep(0.005)


def test_a_short_secret_raises_an_error(street, tmp_path, capsys):
    (tmp_path / "key").write_text("short\n")
    play = "--play", str(street / "street.wav"), "--array", str(street / "mics.csv"), "--uncalibrated"
    assert main(["live", *play, "--odometry", "127.0.0.1:0", "--key", str(tmp_path / "key")]) == 2
    assert "at least 16 bytes" in capsys.readouterr().err


def test_a_secret_is_not_printed():
    assert "sixteen" not in repr(Trust(key=SECRET))
