"""A run with at least one fault per second: an hour in `make slow`, or WORLDSTATE_SOAK_S seconds."""

import json
import os
import re
import resource
import socket
import threading
import time
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from snapshot_laws import broken_laws
from stand_ins import free_port, send

from worldstate.adapters.files.checkpoint_file import read_checkpoint
from worldstate.adapters.live import live_listening
from worldstate.adapters.live.live_sensors import _code, signed
from worldstate.adapters.live.live_sound import SoundBlock
from worldstate.adapters.state_log import read_log
from worldstate.cli.main import main

RATE, BLOCK, HOP_NS = 8_000, 200, 100_000_000
LONG_S = float(os.environ.get("WORLDSTATE_SOAK_S", "3600"))
SECRET = b"sixteen bytes or more"
LOOK = {"boxes": [[300, 200, 360, 260]], "scores": [0.9], "classes_str": ["car"]}
MANY = {
    "boxes": np.random.default_rng(0).integers([0, 0, 300, 200], [290, 190, 640, 480], (1000, 4)).tolist(),
    "scores": [0.9] * 1000,
    "classes_str": ["car"] * 1000,
}
ODOMETRY = {"speed_mps": 0.0}
NONSENSE = (b"", b"\xff\xfe", b"[" * 60_000, b"{}", b"null", b'{"number": 1e999}', b"\0" * 9)
RANGES = (
    LOOK | {"age_s": 1e308}, LOOK | {"age_s": 5.0}, LOOK | {"boxes": [[600, 0, 900, 9]]},
    LOOK | {"boxes": [[1e308, -1e308, 3, float("inf")]]}, LOOK | {"scores": [2]},
    LOOK | {"scores": [float("nan")]},
)  # fmt: skip
SPEEDS = ({"speed_mps": 1e30}, {"speed_mps": float("nan")}, {"speed_mps": 1, "x_m": 3}, {"speed_mps": None})
SAMPLES = np.nan, np.inf, -1e30, 1e6, 0.5


# Blocks that are given in place of one.
REPLACED = {
    "block_lost": lambda block: [],
    "block_repeated": lambda block: [block, block],
    "count_jumps_back": lambda block: [replace(block, first=block.first - 1_000_000)],
    "count_jumps_ahead": lambda block: [replace(block, first=block.first + 10**9)],
    "channels_missing": lambda block: [replace(block, samples=block.samples[:, :2])],
    "clock_jumps_ahead": lambda block: [replace(block, captured_s=block.captured_s + 3600.0)],
    "clock_jumps_back": lambda block: [replace(block, captured_s=block.captured_s - 3600.0)],
}


class Faulty:
    """Microphones in real time with a different fault per second, and the programs beside."""

    channels, sample_rate_hz, speed, overflows, name = 4, RATE, 1.0, 0, "faulty"

    def __init__(self, ports: tuple[int, int], key: bytes | None, length_s: float) -> None:
        self.ports, self._key, self._length_s = ports, key, length_s
        # Blocks between two faults: one second of a long run
        self.every = 40 if length_s > 60.0 else 14
        own = {name[7:]: fault for name, fault in vars(Faulty).items() if name.startswith("_fault_")}
        self.kinds = REPLACED | {name: partial(fault, self) for name, fault in own.items()}
        self.faults, self.bytes = Counter[str](), list[int]()
        self._rng, self._stopped = np.random.default_rng(5), threading.Event()
        self._sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._last, self._incoherent = b"", False

    def start(self, into) -> None:
        self._thread = threading.Thread(target=self._run, args=(into,), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stopped.set()
        self._thread.join()
        self._restore()
        self._sender.close()

    def _run(self, into) -> None:
        begun_s, number = time.monotonic(), 0
        while not self._stopped.wait(max(begun_s + number / 40 - time.monotonic(), 0.0)):
            noise = self._rng.normal(0.0, 0.1, (BLOCK, 4))
            samples = noise if self._incoherent else 0.1 * noise + self._rng.normal(0.0, 0.1, (BLOCK, 1))
            blocks = [SoundBlock(samples.astype(np.float32), BLOCK * number, begun_s + (number + 1) / 40)]
            if number % self.every == self.every - 1:
                self._disturb()
            if number % self.every == self.every - 1 and number < 40 * (self._length_s - 3.0):
                kind = [*self.kinds][self.faults.total() % len(self.kinds)]
                self.faults[kind] += 1
                given = self.kinds[kind](blocks[0])
                blocks = blocks if given is None else given
            for block in blocks:
                into.put(block)
            if number % 4 == 0:
                self._last = self._tell(0, LOOK | {"age_s": 0.02})
                self._tell(1, ODOMETRY)
            number += 1

    def _tell(self, port: int, record) -> bytes:
        """Send a record as the detector or the car does; return the datagram."""
        name = ("detections", "odometry")[port]
        text = json.dumps(record).encode() if self._key is None else signed(record, self._key, name)
        self._sender.sendto(text, ("127.0.0.1", self.ports[port]))
        return text

    def _coded(self, text: bytes) -> bytes:
        return text if self._key is None else text + b"\n" + _code(self._key, text)

    def _disturb(self) -> None:
        """Undo the last fault, and send rubbish."""
        self.bytes.append(int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE"))
        self._incoherent = False
        self._restore()
        self._rubbish(200)

    def _restore(self) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))

    def _rubbish(self, datagrams: int) -> None:
        for port in self.ports:
            send(port, *[b"rubbish"] * datagrams)

    def _fault_samples_out_of_range(self, block):
        block.samples[7, self.faults.total() % 4] = SAMPLES[self.faults.total() % len(SAMPLES)]

    def _fault_stall_and_burst(self, block):
        self._stopped.wait(0.7)  # the delayed blocks arrive at once

    def _fault_incoherent_noise(self, block):
        self._incoherent = True

    def _fault_class_names(self, block):
        for names in (["Voiture"], ["CAR "], ["\x1b[2J"], [""], ["car\0"]):
            self._tell(0, LOOK | {"classes_str": names})

    def _fault_many_boxes(self, block):
        for _ in range(10):
            self._tell(0, MANY)

    def _fault_datagrams_out_of_range(self, block):
        for record in RANGES:
            self._tell(0, record)
        for record in SPEEDS:
            self._tell(1, record)
        for text in NONSENSE:
            for port in self.ports:
                self._sender.sendto(self._coded(text), ("127.0.0.1", port))

    def _fault_datagrams_again(self, block):
        for _ in range(20):
            self._sender.sendto(self._last, ("127.0.0.1", self.ports[0]))

    def _fault_flood(self, block):
        self._rubbish(5_000)

    def _fault_log_unwritable(self, block):
        resource.setrlimit(resource.RLIMIT_FSIZE, (1, resource.RLIM_INFINITY))

    def _fault_log_deleted(self, block):
        number = self.faults["log_deleted"]
        os.link("s.jsonl", f"kept/{number}.jsonl")  # so that all of its states can be read at the end
        for name in ("s.jsonl", "s.mcap"):
            Path(name).unlink()


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize(
    ("length_s", "key"),
    [
        (12.0, SECRET),
        pytest.param(12.0, None, marks=pytest.mark.long),
        pytest.param(LONG_S, SECRET, marks=pytest.mark.slow),
    ],
)
def test_a_run_with_a_fault_every_second_continues(
    length_s, key, street, tmp_path, capsys, caplog, monkeypatch
):
    ports = free_port(), free_port()
    feed = Faulty(ports, key, length_s)
    monkeypatch.setattr("worldstate.adapters.live.live_sound.PortAudioInput", lambda *given: feed)
    sounds, live_steps = [], live_listening.live_steps

    def steps_of(source, *hand_in):
        sounds.append(source.sound)
        return live_steps(source, *hand_in)

    monkeypatch.setattr(live_listening, "live_steps", steps_of)
    (tmp_path / "key").write_bytes(SECRET)
    (tmp_path / "kept").mkdir()
    given = f"--array {street}/mics.csv --camera {street}/lens.json --rate {RATE} --uncalibrated"
    told = f"--detections 127.0.0.1:{ports[0]} --odometry 127.0.0.1:{ports[1]} {'--key key' if key else ''}"
    kept = "--out s.jsonl --export mcap=s.mcap --save-state belief.json"
    ends = f"--duration {length_s} --json"
    monkeypatch.chdir(tmp_path)
    assert main(["live", *given.split(), *told.split(), *kept.split(), *ends.split()]) == 0
    printed = capsys.readouterr()
    report, faults = json.loads(printed.out), feed.faults.total()
    lost = sum(int(one) for one in re.findall(r"s\.jsonl: (\d+) records were lost", caplog.text))
    left_out = sounds[0].start_ns // HOP_NS
    used_mib = [used >> 20 for used in feed.bytes]
    figures = {"faults": feed.faults, "records lost": lost, "hops left out": left_out}
    figures["MiB every tenth of the time"] = [*used_mib[:: len(used_mib) // 10], max(used_mib)]
    with capsys.disabled():
        print(json.dumps(report | figures, indent=1) if length_s > 60.0 else "", end="")
    assert "Traceback" not in printed.err
    assert set(feed.faults) == set(feed.kinds)
    assert faults >= 0.9 * 40 / feed.every * (length_s - 3.0) - 1
    assert report["detections_refused"] + report["odometry_refused"] > 100 * faults
    # A machine with more work than cores is too slow, and its losses are counted.
    if report["load"] < os.cpu_count():
        assert report["detections_dropped"] <= 64  # of the first second
        assert left_out <= 0.02 * 10 * length_s
    assert report["states"] + left_out == pytest.approx(10 * length_s, abs=12)
    logs = [*(f"kept/{number}.jsonl" for number in range(1, feed.faults["log_deleted"] + 1)), "s.jsonl"]
    logged, before = 0, None
    for log in logs:
        for _, state in read_log(Path(log)):
            logged, follows = logged + 1, before and state.stamp_ns - before.stamp_ns == HOP_NS
            assert broken_laws(state, before if follows else None) == []
            before = state
    # All missing time was counted as lost or omitted in a gap of the sound.
    assert logged + lost == report["states"]
    assert (before.stamp_ns - 1_000_000_000) // HOP_NS + 1 == logged + lost + left_out
    assert before.delivery.refused > 0.5 * faults
    assert {view.sensor for view in before.searched} == {"camera"}
    # An MCAP file that could not be written ends there, until it restarts.
    *_, (_, last) = read_log(tmp_path / "s.mcap")
    assert before.stamp_ns - last.stamp_ns <= 6_000_000_000
    assert read_checkpoint(tmp_path / "belief.json").world.stamp_ns == before.stamp_ns
    # Buffers are full after a minute.
    assert max(used_mib[60:], default=0) < max(used_mib[:60]) + 64
