"""Whose datagrams a port takes."""

import argparse
import hashlib
import hmac
import json
import socket
import time

import numpy as np
import pytest
import soundfile

from worldstate.adapters.live import live_sensors
from worldstate.adapters.live.live_sensors import OdometrySocket, Trust
from worldstate.cli.live import _trust
from worldstate.cli.main import main
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.values import nanoseconds

SECRET = b"sixteen bytes or more"


def odometry(speed_mps: float, **more: object) -> bytes:
    return json.dumps({"speed_mps": speed_mps, "yaw_rate_rad_s": 0.0, **more}).encode()


def signed(text: bytes, key: bytes = SECRET) -> bytes:
    return text + b"\n" + hmac.new(key, text, hashlib.sha256).hexdigest().encode()


def taken(
    trust: Trust, *sent: tuple[int, bytes], hosts=("127.0.0.1", "127.0.0.1")
) -> tuple[list[float], str]:
    """Send datagrams from two sockets, by number; return the speeds that were taken, and the last problem."""
    speeds: list[float] = []
    told = OdometrySocket("127.0.0.1:0", nanoseconds, trust)
    senders = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in hosts]
    for sender, host in zip(senders, hosts, strict=True):
        sender.bind((host, 0))
    with told:
        for number, datagram in sent:
            senders[number].sendto(datagram, ("127.0.0.1", told.port))
            done, until_s = len(speeds) + told.refused, time.monotonic() + 5.0
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


def test_nonsense_does_not_pin():
    assert taken(Trust(), (1, b"nonsense"), (0, odometry(1)), (1, odometry(2)))[0] == [1]


def test_another_sender_follows_one_that_is_silent(monkeypatch):
    monkeypatch.setattr(live_sensors, "PINNED_S", 0.0)
    assert taken(Trust(), (0, odometry(1, number=7)), (1, odometry(2, number=1)))[0] == [1, 2]


def test_only_addresses_that_are_allowed_are_taken():
    sent = (0, odometry(1)), (1, odometry(2))
    speeds, problem = taken(Trust(allow=("127.0.0.2",)), *sent, hosts=("127.0.0.1", "127.0.0.2"))
    assert speeds == [2]
    assert "expected one of 127.0.0.2, got 127.0.0.1" in problem


def test_a_host_is_allowed_by_its_name_too():
    asked = argparse.Namespace(allow=["localhost", "127.0.0.2"], key=None)
    assert _trust(asked).allow == ("127.0.0.1", "127.0.0.2")
    with pytest.raises(InvalidArgumentError, match="--allow: expected hosts"):
        _trust(argparse.Namespace(allow=["no such host"], key=None))


def test_numbers_rise_and_what_is_old_is_left_out():
    sent = [odometry(n, number=n) for n in (1, 2, 2, 1, 3)] + [odometry(4, number=4, age_s=2.1)]
    assert taken(Trust(), *((0, one) for one in sent))[0] == [1, 2, 3]


def test_a_key_is_proved_by_any_sender_and_nothing_is_taken_twice():
    first = signed(odometry(1, number=1))
    wrong = [
        odometry(2, number=2),
        signed(odometry(3, number=3), b"another secret of 16 bytes"),
        signed(odometry(4)),  # without a number it could be sent again
        first,
        first.replace(b'"speed_mps": 1', b'"speed_mps": 9'),
    ]
    sent = [(0, first), *((1, one) for one in wrong), (1, signed(odometry(5, number=5)))]
    assert taken(Trust(key=SECRET), *sent)[0] == [1, 5]


def test_a_short_secret_is_refused(tmp_path, capsys):
    (tmp_path / "key").write_text("short\n")
    (tmp_path / "mics.csv").write_text("0,0.1,0\n0,0.02,0.05\n0,-0.04,0\n0,-0.1,0.03\n")
    soundfile.write(tmp_path / "a.wav", np.random.default_rng(0).normal(0.0, 0.1, (16_000, 4)), 8_000)
    play = "--play", str(tmp_path / "a.wav"), "--array", str(tmp_path / "mics.csv"), "--uncalibrated"
    assert main(["live", *play, "--odometry", "127.0.0.1:0", "--key", str(tmp_path / "key")]) == 2
    assert "at least 16 bytes" in capsys.readouterr().err


def test_a_secret_is_not_printed():
    assert "sixteen" not in repr(Trust(key=SECRET))
