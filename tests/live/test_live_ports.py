"""Accepted and dropped datagrams of a port."""

import argparse
import hashlib
import hmac
import json
import re
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from stand_ins import free_port, played, send, sending

from worldstate import WorldFilter, nanoseconds
from worldstate.adapters import Checkpoint
from worldstate.adapters.files.checkpoint_file import PortNumbers, read_checkpoint, save_checkpoint
from worldstate.adapters.live import live_sensors
from worldstate.adapters.live.live_sensors import DetectionSocket, OdometrySocket, Trust
from worldstate.adapters.state_log import read_log
from worldstate.cli.live import _trust
from worldstate.cli.main import main
from worldstate.ground.errors import InvalidArgumentError

SECRET = b"sixteen bytes or more"
LOOK = {"boxes": [], "scores": [], "classes_str": []}


def odometry(speed_mps, **more):
    return json.dumps({"speed_mps": speed_mps, "yaw_rate_rad_s": 0.0, **more}).encode()


def signed(speed_mps, number, key=SECRET, **other):
    """Return a datagram by the recipe of the page."""
    about = {"port": "odometry", "sent_s": time.time(), "number": number}
    text = odometry(speed_mps, **(about | other))
    return text + b"\n" + hmac.new(key, text, hashlib.sha256).hexdigest().encode()


def delivered(port, until):
    """Return what a port delivers until a condition holds, for at most 5 s."""
    found, until_s = [], time.monotonic() + 5.0
    while not until(found) and time.monotonic() < until_s:
        port.deliver(lambda stamp_ns, record: found.append(record))
        time.sleep(0.005)
    return found


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
    asked = argparse.Namespace(allow=["localhost", "127.0.0.2"], key=None)
    assert _trust(asked).allow == ("127.0.0.1", "127.0.0.2")
    with pytest.raises(InvalidArgumentError, match="--allow: expected hosts"):
        _trust(argparse.Namespace(allow=["no such host"], key=None))


@pytest.mark.parametrize(
    ("age_s", "read"),
    # Clocks that differ by 2 ms lose no datagram.
    [(-0.002, True), (-0.05, True), *((bad, False) for bad in (-0.051, -3600, "x", None, [1], {}, True))],
)
def test_small_negative_ages_count_as_zero_and_others_drop_the_datagram(age_s, read):
    assert taken(Trust(), (0, odometry(1, age_s=age_s)), (0, odometry(2)))[0] == [1] * read + [2]


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
            speeds += [
                one.speed_mps for one in delivered(told, lambda found, told=told: found or told.refused)
            ]
        numbers = told.numbers
    assert speeds == [1, 2]
    assert numbers == {"odometry": 8}


def test_numbers_are_saved_with_the_belief(tmp_path):
    save_checkpoint(tmp_path / "a.json", Checkpoint(WorldFilter(), ports=PortNumbers({"odometry": 2**62})))
    before, nothing = read_checkpoint(tmp_path / "a.json"), argparse.Namespace(allow=[], key=None)
    assert _trust(nothing, before).numbers == {"odometry": 2**62}
    assert _trust(nothing, Checkpoint(WorldFilter())).numbers == {}


def test_datagrams_of_strangers_displace_no_queued_ones():
    sent = [live_sensors.signed({"speed_mps": n, "yaw_rate_rad_s": 0.0}, SECRET, "odometry") for n in (1, 2)]
    with OdometrySocket("127.0.0.1:0", nanoseconds, Trust(key=SECRET)) as told:
        send(told.port, sent[0])
        for _ in range(20):
            send(told.port, *[b"rubbish"] * 50)
            time.sleep(0.01)
        send(told.port, sent[1])
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
    kept = "--out", folder / "s.jsonl", "--save-state", folder / "belief.json", "--json"
    seen = "--detections", f"127.0.0.1:{port}", "--camera", street / "lens.json", *kept, "--duration", 8
    words = played(street, *seen, *(["--key", folder / "key"] if keyed else []))
    process = subprocess.Popen([sys.executable, "-m", "worldstate", *words], stdout=subprocess.PIPE)
    attack = [subprocess.Popen([sys.executable, "-c", FLOOD, str(port), *map(str, flood)])] if flood else []
    look = LOOK | {"age_s": 0.02}
    signing = partial(live_sensors.signed, look, SECRET, "detections")
    with sending(port, signing if keyed else json.dumps(look).encode()):
        told = json.loads(process.communicate(timeout=90)[0])
    for one in attack:
        one.kill()
        one.wait()
    assert told["detections_dropped"] <= 64  # before the first state
    if flood:
        assert told["detections_refused"] > 100
        assert ("HMAC-SHA256" if keyed else "sender: expected 127.0.0.1") in told["last_refusal"]
    if keyed:
        assert read_checkpoint(folder / "belief.json").ports.last["detections"] > 0
    states = [state for _, state in read_log(folder / "s.jsonl") if state.stamp_ns > 2_000_000_000]
    ages_ns = [min(state.stamp_ns - look.stamp_ns for look in state.searched) for state in states]
    return sum(age_ns <= 150_000_000 for age_ns in ages_ns) / len(ages_ns)


@pytest.mark.slow
@pytest.mark.parametrize("size", [7, 1_000])
@pytest.mark.parametrize("keyed", [True, False])
def test_a_flood_costs_at_most_a_tenth_of_the_looks(street, tmp_path, size, keyed):
    without, under = (fresh_looks(street, tmp_path, keyed, *flood) for flood in ((), (5_000, size)))
    print(f"keyed {keyed}, {size} bytes: {without:.3f} without, {under:.3f} under the flood")
    assert under >= 0.9 * without
