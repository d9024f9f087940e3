"""A run with a fault every second: an hour in `make slow`, or WORLDSTATE_SOAK_S seconds."""

import json
import os
import socket
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from snapshot_laws import broken_laws

from worldstate.adapters.files.checkpoint_file import read_checkpoint
from worldstate.adapters.live.live_sound import SoundBlock
from worldstate.adapters.state_log import read_log
from worldstate.cli.main import main

RATE, BLOCK = 8_000, 200
LONG_S = float(os.environ.get("WORLDSTATE_SOAK_S", "3600"))
WELL = {"boxes": [[300, 200, 360, 260]], "scores": [0.9], "classes_str": ["car"]}
NONSENSE = (
    b"", b"\xff\xfe", b"[" * 60_000, b"{}", b"null", json.dumps(WELL | {"age_s": 1e308}).encode(),
    json.dumps(WELL | {"age_s": 5.0}).encode(), json.dumps(WELL | {"boxes": [[600, 0, 900, 9]]}).encode(),
    json.dumps(WELL | {"scores": [2]}).encode(), b'{"speed_mps": 1e30}', b'{"speed_mps": 1, "x_m": 3}',
    json.dumps({key: value * 900 for key, value in WELL.items()}).encode(),
)  # fmt: skip


class Faulty:
    """Microphones in real time, in which every second something else goes wrong, and the programs beside."""

    channels, sample_rate_hz, speed, overflows, name = 4, RATE, 1.0, 0, "faulty"

    def __init__(self, ports: tuple[int, int], websocket: int) -> None:
        self.ports, self.websocket, self.faults, self.bytes = ports, websocket, 0, []
        self._rng, self._stopped = np.random.default_rng(5), threading.Event()
        self._dripping: list[socket.socket] = []

    def start(self, into) -> None:
        self._thread = threading.Thread(target=self._run, args=(into,), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stopped.set()
        self._thread.join()
        for one in self._dripping:
            one.close()

    def _run(self, into) -> None:
        begun_s, number, sender = time.monotonic(), 0, socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        while not self._stopped.wait(max(begun_s + number / 40 - time.monotonic(), 0.0)):
            samples = self._rng.normal(0.0, 0.1, (BLOCK, 4)).astype(np.float32)
            blocks = [SoundBlock(samples, BLOCK * number, begun_s + (number + 1) / 40)]
            if number % 40 == 39:
                blocks = self._spoilt(blocks[0])
            for block in blocks:
                into.put(block)
            if number % 4 == 0:
                for port, told in zip(self.ports, (WELL | {"age_s": 0.02}, {"speed_mps": 0.0}), strict=True):
                    sender.sendto(json.dumps(told).encode(), ("127.0.0.1", port))
            number += 1

    def _spoilt(self, block: SoundBlock) -> list[SoundBlock]:
        """Return what comes in place of a block."""
        self.faults += 1
        self._disturb()
        kind, samples, first, at_s = self.faults % 9, block.samples, block.first, block.captured_s
        samples[kind, kind % 4] = (np.nan, np.inf, -1e30, 1e6, 0.5, 0.1, 0.2, 0.3, 0.4)[kind]
        if kind == 7:
            self._stopped.wait(0.7)
        return {
            4: [],  # lost
            5: [block, block],
            6: [SoundBlock(samples, first - 1_000_000, at_s)],
            7: [block],  # after a stall
            8: [SoundBlock(samples[:, :2], first, at_s), SoundBlock(samples, first + 10**9, at_s)],
        }.get(kind, [block])

    def _disturb(self) -> None:
        """Send nonsense and a flood, ask the websocket as a page and never to the end, and take the log."""
        self.bytes.append(int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE"))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            for port in self.ports:
                stranger.sendto(NONSENSE[self.faults % len(NONSENSE)], ("127.0.0.1", port))
                for _ in range(200):
                    stranger.sendto(b"rubbish", ("127.0.0.1", port))
        if self.faults % 50 == 3:
            Path("s.jsonl").unlink()
        # The server is closed before the microphones.
        with suppress(OSError):
            self._dripping.append(socket.create_connection(("127.0.0.1", self.websocket), 5.0))
            self._dripping[-1].sendall(b"GET / HTTP/1.1\r\n")
        while len(self._dripping) > 20:
            self._dripping.pop(0).close()
        with suppress(OSError), socket.create_connection(("127.0.0.1", self.websocket), 5.0) as page:
            page.sendall(b"GET / HTTP/1.1\r\nOrigin: https://evil.example\r\n\r\n"[: 7 * self.faults])


def free_port(kind=socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


@pytest.mark.parametrize("length_s", [8.0, pytest.param(LONG_S, marks=pytest.mark.slow)])
def test_a_run_with_a_fault_every_second_goes_on(length_s, tmp_path, capsys, monkeypatch):
    ports, websocket = (free_port(), free_port()), free_port(socket.SOCK_STREAM)
    feed = Faulty(ports, websocket)
    monkeypatch.setattr("worldstate.adapters.live.live_sound.PortAudioInput", lambda *given: feed)
    (tmp_path / "mics.csv").write_text("0,0.1,0\n0,0.02,0.05\n0,-0.04,0\n0,-0.1,0.03\n")
    lens = {"width_px": 640, "height_px": 480, "horizontal_fov_deg": 70, "position_m": [0, 0, 0]}
    (tmp_path / "lens.json").write_text(json.dumps(lens))
    told = ["--detections", f"127.0.0.1:{ports[0]}", "--odometry", f"127.0.0.1:{ports[1]}"]
    given = ["--array", "mics.csv", "--camera", "lens.json", "--rate", str(RATE), "--uncalibrated", *told]
    kept = ["--out", "s.jsonl", "--export", "mcap=s.mcap", "--save-state", "belief.json"]
    ends = ["--export", f"foxglove={websocket}", "--duration", str(length_s), "--json"]
    monkeypatch.chdir(tmp_path)
    assert main(["live", *given, *kept, *ends]) == 0
    report = json.loads(capsys.readouterr().out)
    assert feed.faults >= 0.9 * length_s - 1
    assert report["detections_refused"] + report["odometry_refused"] > 100 * feed.faults
    assert report["detections_dropped"] <= 64  # of the first second
    assert report["states"] == pytest.approx(10 * length_s, abs=0.02 * 10 * length_s + 12)
    before = None
    assert (tmp_path / "s.jsonl").exists()  # begun again each time
    for _, state in read_log(tmp_path / "s.jsonl"):
        assert before is None or state.stamp_ns - before.stamp_ns == 100_000_000
        assert broken_laws(state, before) == []
        before = state
    assert before.delivery.refused > 0.5 * feed.faults
    for name in ("s.jsonl", "s.mcap"):
        *_, (_, last) = read_log(tmp_path / name)
        assert last == before
    assert read_checkpoint(tmp_path / "belief.json").world.stamp_ns == before.stamp_ns
    # Buffers are full after a minute.
    assert max(feed.bytes[60:], default=0) < max(feed.bytes[:60]) + (64 << 20)
