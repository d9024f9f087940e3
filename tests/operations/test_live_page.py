"""The page of a live run: messages, viewers and a browser."""

import json
import socket
import threading
import time
from dataclasses import replace
from types import SimpleNamespace
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest
from chromium import browser, needs_browser
from hypothesis import given
from hypothesis import strategies as st
from scripted_states import scripted_states
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from worldstate.abduction.co_evidence import Absent
from worldstate.cli.main import main
from worldstate.ground import extras
from worldstate.measurement import Look, Sighting
from worldstate.measurement.measurement import Bearing, CameraLook
from worldstate.operations.recordings.evidence_report import WHY_NOT
from worldstate.operations.viewing import live_page
from worldstate.operations.viewing.live_page import STATES, LivePage
from worldstate.operations.viewing.log_page import headline, is_reflected

BOXES = Sighting(0.2, 0.02, "car", 0.9, 0.1), Sighting(-0.3, 0.02, "</script><b>", 0.5, 0.05, moving=False)


@pytest.fixture(scope="module")
def states():
    return [replace(one, calibrated=True) for one in scripted_states()]


def hop(state, **more):
    """Return a hop of `live` with two boxes of a camera."""
    looks = (CameraLook(Look("camera", state.stamp_ns, Absent(0.1)), BOXES),)
    step = SimpleNamespace(state=state, measurement=SimpleNamespace(looks=looks))
    return SimpleNamespace(**{"step": step, "latency_s": 0.04, "overruns": 0, "lost_s": 0.0} | more)


def address(page):
    return page.url.replace("http", "ws").rstrip("/") + STATES


class Viewer(threading.Thread):
    """Reads messages until the run ends."""

    def __init__(self, page):
        super().__init__()
        self.address, self.rows, self.connected = address(page), [], threading.Event()
        self.start()
        assert self.connected.wait(20.0)

    def run(self):
        with connect(self.address) as viewer:
            self.connected.set()
            while True:
                try:
                    self.rows += json.loads(viewer.recv(timeout=20.0))
                except ConnectionClosed:
                    return


def until(holds):
    until_s = time.monotonic() + 20.0
    while not holds():
        assert time.monotonic() < until_s
        time.sleep(0.01)


def test_each_viewer_receives_every_hop_once(states):
    with LivePage(0) as page:
        viewers = [Viewer(page)]
        for state in states[:3]:
            page.show(hop(state))
        viewers.append(Viewer(page))
        until(lambda: len(viewers[1].rows) == 3)  # earlier states come at once
        for state in states[3:]:
            page.show(hop(state))
    for viewer in viewers:
        viewer.join()
        assert [row["t"] for row in viewer.rows] == pytest.approx([one.stamp_ns / 1e9 for one in states])


def test_a_late_viewer_receives_the_last_minute(states, monkeypatch):
    monkeypatch.setattr(live_page, "MOST_ROWS", 4)
    with LivePage(0) as page:
        for k in range(9):
            page.show(hop(replace(states[0], stamp_ns=k * 10**8)))
        with connect(address(page)) as viewer:
            assert [row["t"] for row in json.loads(viewer.recv(timeout=20.0))] == [0.5, 0.6, 0.7, 0.8]


def test_other_origins_receive_no_states(states):
    with LivePage(0) as page:
        page.show(hop(states[0]))
        for origin in (page.url.rstrip("/"), page.url.rstrip("/").replace("127.0.0.1", "localhost"), None):
            with connect(address(page), origin=origin) as viewer:
                assert json.loads(viewer.recv(timeout=20.0))
        port = page.url.split(":")[-1].rstrip("/")
        for origin in ("https://example.org", f"http://example.org:{port}", "null", "http://127.0.0.1:1"):
            with pytest.raises(InvalidStatus, match="403"):
                connect(address(page), origin=origin)
        with pytest.raises(HTTPError, match="404"):
            urlopen(page.url + "states.jsonl")


def test_a_stalled_viewer_delays_neither_hops_nor_the_end(states, monkeypatch):
    monkeypatch.setattr(live_page, "_PATIENCE_S", 1.0)
    monkeypatch.setattr(live_page, "MOST_ROWS", 5000)
    with LivePage(0) as page:
        stalled = socket.create_connection(("127.0.0.1", int(page.url.split(":")[-1].rstrip("/"))))
        stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        key = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: "
        stalled.sendall(f"GET {STATES} HTTP/1.1\r\nHost: x\r\n{key}{'A' * 22}==\r\n\r\n".encode())
        longest_s = 0.0
        for k in range(4000):  # more than the system's buffers hold
            before_s = time.monotonic()
            page.show(hop(replace(states[0], stamp_ns=k)))
            longest_s = max(longest_s, time.monotonic() - before_s)
        ended_s = time.monotonic()
    assert longest_s < 0.9
    assert time.monotonic() - ended_s < 10.0
    stalled.close()


def test_viewers_beyond_the_limit_receive_nothing(states, monkeypatch):
    monkeypatch.setattr(live_page, "MOST_VIEWERS", 1)
    with LivePage(0) as page:
        page.show(hop(states[0]))
        first = Viewer(page)
        until(lambda: first.rows)
        second = Viewer(page)
        second.join(20.0)
        assert second.rows == []
        assert first.is_alive()
    first.join()


def test_the_page_of_live_has_the_written_states(street, tmp_path, monkeypatch, capsys):
    viewers = []

    class Watched(LivePage):
        def __enter__(self):
            super().__enter__()
            viewers.append(Viewer(self))
            return self

    monkeypatch.setattr(live_page, "LivePage", Watched)
    play = "--play", str(street / "street.wav"), "--array", str(street / "mics.csv"), "--uncalibrated"
    out = tmp_path / "states.jsonl"
    assert main(["live", *play, "--speed", "20", "--web", "0", "--out", str(out)]) == 0
    viewers[0].join()
    got = viewers[0].rows
    assert "open http://127.0.0.1:" in capsys.readouterr().err
    written = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["t"] for row in got] == pytest.approx([one["stamp_ns"] / 1e9 for one in written], abs=1e-3)
    assert {row["sensors"][0][0] for row in got} == {"acoustic"}
    assert all(row["live"]["latency_s"] >= 0.0 for row in got)


def test_a_taken_port_and_a_missing_package_raise_an_error_before_the_run(street, capsys, monkeypatch):
    play = "--play", str(street / "street.wav"), "--array", str(street / "mics.csv"), "--uncalibrated"
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert main(["live", *play, "--web", port]) == 2
        assert f"--web: expected a free port, got {port}" in capsys.readouterr().err
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    assert main(["live", *play, "--web"]) == 2
    assert "worldstate[web]" in capsys.readouterr().err


STATED = scripted_states()


@given(st.sampled_from(STATED), st.booleans(), st.lists(st.sampled_from(sorted(WHY_NOT)), unique=True))
def test_the_sentence_has_every_advisory_and_reason(state, advised, reasons):
    given = {"usable": not reasons, "why_not": tuple(reasons)} | ({} if advised else {"advisory": None})
    cues = tuple(replace(one, **given) for one in state.cues)
    said = headline(replace(state, cues=cues))
    for cue in cues:
        told = f"{cue.direction}: a vehicle is hidden, {100 * cue.within['3']:.0f} % to appear within 3 s"
        assert (told in said.lower()) == (cue.advisory is not None)
    assert said.startswith("No advisory: ") == (not any(one.advisory for one in cues))
    assert all(WHY_NOT[one] in said for one in reasons)
    assert ("Do not act on it" in said) == bool(reasons)


def test_without_a_model_the_sentence_has_no_risk(states):
    cue = replace(states[-1].cues[0], direction=None, risk=None, advisory=None, within=None, evidence=None)
    bearing = SimpleNamespace(azimuth_rad=-0.5)
    said = headline(replace(states[-1], cues=(cue,), bearing=bearing))
    assert said == "A sound comes from 29 degrees right; no risk can be stated."


def test_sound_without_a_visible_vehicle_is_a_reflection(states):
    hidden, in_view = states[0], states[-1]
    assert hidden.left.advisory and in_view.left.advisory
    sound = {"bearing": Bearing(-1.0, 0.1, 2.0)}
    assert is_reflected(replace(hidden, **sound))
    assert is_reflected(replace(in_view, **sound))
    there = replace(in_view, bearing=Bearing(in_view.entities[0].azimuth_rad + 0.1, 0.1, 2.0))
    assert not is_reflected(there)
    quiet = replace(hidden, cues=tuple(replace(one, advisory=None, risk=0.1) for one in hidden.cues))
    assert not is_reflected(replace(quiet, **sound))
    assert not is_reflected(replace(hidden, bearing=None))


@pytest.mark.long
@needs_browser
def test_a_browser_shows_the_run_without_an_error(states, tmp_path):
    shown = "[...document.querySelectorAll('#health span')].map(one => one.textContent)"
    width = "document.documentElement.scrollWidth <= innerWidth"
    with browser(tmp_path / "profile") as seen:
        with LivePage(0) as page:
            seen.open(page.url)
            for k, state in enumerate(states):
                page.show(hop(state, overruns=k, lost_s=0.1 * k))
            seen.until(f"rows?.length === {len(states)}")
            for pixels in (1300, 420):
                for scheme in ("light", "dark"):
                    screen = {"width": pixels, "height": 900, "deviceScaleFactor": 1, "mobile": False}
                    seen.call("Emulation.setDeviceMetricsOverride", **screen)
                    media = [{"name": "prefers-color-scheme", "value": scheme}]
                    seen.call("Emulation.setEmulatedMedia", features=media)
                    page.show(hop(replace(states[-1], stamp_ns=states[-1].stamp_ns + 10**8)))
                    assert seen.value("innerWidth") == pixels
                    assert seen.value(width)
                    ground = seen.value("getComputedStyle(document.body).backgroundColor")
                    assert ground == {"light": "rgb(255, 255, 255)", "dark": "rgb(20, 23, 26)"}[scheme]
            assert seen.value("at('sentence').textContent") == headline(states[-1])
            seen.until(f"rows.length === {len(states) + 4}")
            assert "40 ms behind the sound" in seen.value(shown)
            texts = "[...document.querySelectorAll('#cameras svg text:not(.muted)')]"
            boxes = seen.value(f"{texts}.map(one => one.textContent)")
            assert boxes == ["car 0.90", "</script><b> 0.50, parked"]
            assert "camera: 2 boxes" in seen.value("at('cameras').textContent")
            # The view to the left is on the left.
            drawn = "[...document.querySelectorAll('#cameras rect')].slice(1)"
            lefts = seen.value(f"{drawn}.map(one => +one.getAttribute('x'))")
            assert lefts[0] < lefts[1]
            # The selected time stays while hops continue, until the page follows again.
            seen.press("Home")
            page.show(hop(replace(states[-1], stamp_ns=states[-1].stamp_ns + 2 * 10**8)))
            seen.until(f"rows.length === {len(states) + 5}")
            assert seen.value("at('time').textContent") == f"{states[0].stamp_ns / 1e9:.2f} s"
            seen.press(" ")
            assert seen.value("+at('slider').value") == len(states) + 4
            assert [url for url in seen.asked() if not url.startswith("data:")] == [page.url]
        seen.until("at('remarks').textContent.includes('The run has ended')")
        assert not seen.faults()
