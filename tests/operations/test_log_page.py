"""A log as one page: content, independence of other files and display in a browser."""

import base64
import io
import json
import re
import wave
from dataclasses import replace
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
from chromium import browser, needs_browser
from scripted_states import scripted_states

from worldstate import WorldState
from worldstate.adapters.datasets.ovad import TrueTrack
from worldstate.adapters.export.log_messages import image_message, mcap_file, sound_message, state_messages
from worldstate.cli.main import main
from worldstate.ground.errors import InvalidArgumentError
from worldstate.measurement.measurement import Bearing
from worldstate.operations.viewing import log_page
from worldstate.operations.viewing.log_page import page_data, write_log_page

TIME_S = 0.1 * np.arange(40)
TRUE = TrueTrack(TIME_S, 0.02 * np.arange(40), TIME_S > 2.0, np.zeros((40, 2)))
# Two images of one pixel, black and white.
JPEGS = [cv2.imencode(".jpg", np.full((1, 1), grey, np.uint8))[1].tobytes() for grey in (0, 255)]
HOSTILE = "</script><script src='https://example.org/x.js'></script><!--"


@pytest.fixture(scope="module")
def states():
    return [replace(state, calibrated=True) for state in scripted_states()]


class Elements(HTMLParser):
    """Collects the elements of a page and the text of its data."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found, self.data = list[tuple[str, dict]](), ""
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data):
        if self.found and self.found[-1][1].get("id") == "data":
            self.data += data


def written(states, tmp_path, **parts):
    write_log_page(tmp_path / "log.html", page_data(states, **parts))
    return (tmp_path / "log.html").read_text("utf-8")


def test_the_page_has_the_values_of_the_states(states, tmp_path):
    rows = json.loads(Elements(written(states, tmp_path)).data)["states"]
    assert [row["t"] for row in rows] == [pytest.approx(one.stamp_ns / 1e9, abs=1e-3) for one in states]
    for row, state in zip(rows, states, strict=True):
        for cue, true in zip(row["cues"], state.cues, strict=True):
            evidence = true.evidence
            assert cue["risk"] == pytest.approx(true.risk, abs=1e-3)
            assert cue["evidence"]["compared"] == pytest.approx(evidence.compared_nats, abs=0.01)
            assert cue["evidence"]["terms"] == pytest.approx(dict(evidence.terms_nats), abs=0.01)
            assert row["thresholds"][cue["side"]] == pytest.approx(evidence.threshold_nats, abs=0.01)
            since_ns = true.advisory and true.advisory.since_ns
            assert cue["since"] == (since_ns and pytest.approx(since_ns / 1e9, abs=1e-3))
        parts = [part for one in state.entities for part in one.on_each_side()]
        drawn = {one["id"]: one for one in row["entities"]}
        assert set(drawn) == {one.id[:8] for one in parts}
        for one in parts:
            shown = drawn[one.id[:8]]
            assert shown["hidden"] == (one.status == "hidden")
            assert shown["azimuth"] == pytest.approx(np.degrees(one.azimuth_rad), abs=0.06)
            assert shown["existence"] == pytest.approx(one.existence_probability, abs=1e-3)
        searched = [(one["sensor"], one["found"]) for one in row["searched"]]
        assert searched == [(one.sensor, one.found) for one in state.searched]
        assert row["heard"] == pytest.approx({one.sensor: one.share for one in state.heard or ()}, abs=0.01)
    assert rows[-1]["entities"][0]["place"] == [8.0, 4.4]


def test_text_of_a_log_is_escaped(states, tmp_path):
    plain = Elements(written(states, tmp_path))
    named = [replace(state, entities=(replace(state.entities[0], id=HOSTILE),)) for state in states]
    hostile = Elements(written(named, tmp_path, title=HOSTILE))
    assert hostile.found == plain.found
    assert json.loads(hostile.data)["title"] == HOSTILE


def test_the_page_has_no_external_requests(states, tmp_path):
    page = written(states, tmp_path)
    links = [one[key] for _, one in Elements(page).found for key in ("src", "href") if key in one]
    assert links == ["data:,"]
    assert not re.search(r"https?:|//\w+\.|url\(|@import|fetch\(|XMLHttp|WebSocket|import\(", page)
    policy = next(one["content"] for _, one in Elements(page).found if "http-equiv" in one)
    assert policy.startswith("default-src 'none';")


def test_an_uncalibrated_run_is_marked_and_has_no_threshold(states):
    data = page_data(replace(state, calibrated=False) for state in states)
    assert "Not calibrated" in data["remarks"][0]
    assert not any(row["thresholds"] for row in data["states"])
    partly = page_data([states[0], *(replace(state, calibrated=False) for state in states[1:])])
    assert f"{len(states) - 1} of {len(states)} snapshots are not calibrated" in partly["remarks"][0]
    assert all(row["thresholds"] for row in partly["states"])
    assert page_data(states)["remarks"] == []


def test_a_long_log_is_thinned_with_a_note(states, monkeypatch):
    monkeypatch.setattr(log_page, "MOST_STATES", 10)
    many = [replace(states[0], stamp_ns=10**8 * k) for k in range(90)]
    data = page_data(many)
    assert [row["t"] for row in data["states"]] == pytest.approx(np.arange(0.0, 9.0, 0.8))
    assert "One of 8 snapshots is shown of 90" in data["remarks"][-1]


def test_the_view_command_writes_a_part_of_a_log(states, tmp_path, capsys):
    log = tmp_path / "states.jsonl"
    log.write_text("".join(state.to_json() + "\n" for state in states))
    assert main(["log", "view", str(log), "--between", "0.25", "0.45", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["states"] == 2
    assert (tmp_path / "states.html").is_file()
    assert main(["log", "view", str(log), "--between", "50", "60"]) == 2
    assert "expected times of its snapshots, 0.2 to 0.7 s, got 50 to 60 s" in capsys.readouterr().err
    assert main(["log", "view", str(log), "--out", str(tmp_path / "a.png")]) == 2
    assert "ending in .html" in capsys.readouterr().err


def logged_sound(samples, rate_hz, begins_ns=0):
    """Return logged sound in [-1, 1): blocks of 0.1 s with their stamps."""
    size = rate_hz // 10
    stamps_ns = [begins_ns + round(k * size * 1e9 / rate_hz) for k in range(-(-len(samples) // size))]
    blocks = np.split(samples, range(size, len(samples), size))
    return [
        (at, sound_message(at, block, rate_hz).value) for at, block in zip(stamps_ns, blocks, strict=True)
    ]


def logged_images(stamps_ns):
    """Return logged images, each with its own bytes."""
    return [(at, image_message(at, b"\xff\xd8\xff" + str(at).encode()).value) for at in stamps_ns]


def of_uri(uri, kind):
    head, text = uri.split(",")
    assert head == f"data:{kind};base64"
    return base64.b64decode(text, validate=True)


def of_wave(uri):
    """Return rate and samples of the page's sound by the standard library."""
    with wave.open(io.BytesIO(of_uri(uri, "audio/wav"))) as sound:
        assert (sound.getnchannels(), sound.getsampwidth()) == (1, 2)
        return sound.getframerate(), np.frombuffer(sound.readframes(sound.getnframes()), "<i2")


@pytest.mark.parametrize("since_ns", [0, 1_700_000_000 * 10**9 + 7])
@pytest.mark.parametrize("rate_hz", [8000, 15_999, 11_025])
def test_the_sound_of_the_page_starts_at_the_first_snapshot(states, since_ns, rate_hz):
    noise = np.random.default_rng(0).uniform(-1.0, 1.0, 2 * rate_hz).astype(np.float32)
    later = [replace(state, stamp_ns=state.stamp_ns + since_ns) for state in states]
    got_hz, got = of_wave(page_data(later, media=logged_sound(noise, rate_hz, since_ns))["sound"])
    first, last = (round(rate_hz * states[k].stamp_ns / 1e9) for k in (0, -1))
    assert got_hz == rate_hz
    assert len(got) == pytest.approx(last - first, abs=1)
    begins = min(range(first - 1, first + 2), key=lambda k: abs(got[0] / 32768 - noise[k]))
    expected = np.clip(noise, -1, 32767 / 32768)[begins:][: len(got)]
    assert got / 32768 == pytest.approx(expected, abs=0.51 / 32768)


def test_sound_is_resampled_and_gaps_are_silent(states):
    time_s = np.arange(48_000) / 48_000
    both = 0.4 * np.sin(2 * np.pi * 1000 * time_s) + 0.4 * np.sin(2 * np.pi * 12_000 * time_s)
    blocks = logged_sound(both.astype(np.float32), 48_000)
    rate_hz, samples = of_wave(page_data(states, media=[*blocks[:4], *blocks[5:]])["sound"])
    assert (rate_hz, len(samples)) == (16_000, 8000)
    whole = samples / 32768
    tones = 2 / 1600 * np.abs(np.fft.rfft(whole[4800:6400]))
    assert tones[100] == pytest.approx(0.4, abs=0.004)
    assert np.delete(tones, 100).max() < 0.004
    lost = whole[round(0.21 * 16_000) : round(0.29 * 16_000)]
    assert np.abs(lost).max() < 0.01


def test_a_long_sound_is_cut_with_a_note(states, monkeypatch):
    blocks = logged_sound(np.full(8000, 0.5, np.float32), 8000)
    assert page_data(states, media=blocks)["remarks"] == []
    monkeypatch.setattr(log_page, "MOST_SOUND_S", 0.2)
    data = page_data(states, media=blocks)
    assert len(of_wave(data["sound"])[1]) == 1600
    assert "sound is that of the first 0.2 s" in data["remarks"][-1]


def test_sound_in_another_format_raises_an_error(states):
    blocks = logged_sound(np.full(8000, 0.5, np.float32), 8000)
    problem = "sound: expected pcm-s16 of one channel at one rate"
    wrongs = ("number_of_channels", 2), ("format", "pcm-f32"), ("sample_rate", 0), ("sample_rate", 10**9)
    for name, wrong in wrongs:
        spoiled = replace(blocks[0][1], **{name: wrong})
        for media in ([(0, spoiled)], [*blocks[:2], (2, spoiled)]):
            with pytest.raises(InvalidArgumentError, match=problem):
                page_data(states, media=media)


def test_the_image_of_a_snapshot_is_the_last_one_at_or_before_it(states):
    stamps_ns = [one.stamp_ns for one in states]
    given = [stamps_ns[1], stamps_ns[2] + 1, stamps_ns[4] - 1, stamps_ns[4], stamps_ns[-1] + 1]
    for early in ([], [0, stamps_ns[0] - 5]):
        data = page_data(states, media=logged_images([*early, *given]))
        assert not data["remarks"]
        # Only the last image before the first snapshot is kept, and none after the last one.
        assert len(data["images"]) == 4 + bool(early)
        for row, at_ns in zip(data["states"], stamps_ns, strict=True):
            before = [str(one).encode() for one in [*early, *given] if one <= at_ns]
            shown = data["images"][row["image"]] if row["image"] >= 0 else None
            assert (shown is None) == (not before)
            if shown:
                assert of_uri(shown["src"], "image/jpeg") == b"\xff\xd8\xff" + before[-1]
                assert shown["t"] == pytest.approx(int(before[-1]) / 1e9, abs=1e-3)


@pytest.mark.parametrize(("bound", "value"), [("MOST_IMAGES", 20), ("MOST_CHARACTERS", 1000)])
def test_many_images_are_thinned_with_a_note(states, monkeypatch, bound, value):
    many = [replace(states[0], stamp_ns=10**8 * k) for k in range(90)]
    media = logged_images(range(0, 9 * 10**9, 10**8))
    monkeypatch.setattr(log_page, "MOST_CHARACTERS", 10)
    none = page_data(many, media=media)
    assert "images" not in none and "0 of 90 images" in none["remarks"][-1]
    monkeypatch.undo()
    monkeypatch.setattr(log_page, bound, value)
    data = page_data(many, media=media)
    times = [one["t"] for one in data["images"]]
    assert 10 <= len(times) <= 25
    assert np.ptp(np.diff(times)) == pytest.approx(0.0, abs=1e-9)
    assert sum(len(one["src"]) for one in data["images"]) <= log_page.MOST_CHARACTERS
    assert f"{len(times)} of 90 images of the camera are shown" in data["remarks"][-1]
    assert data["states"][-1]["image"] == len(times) - 1


@pytest.fixture
def log_with_media(states, tmp_path):
    """Write an MCAP file of states, noise at 16 kHz and one image per state."""
    noise = np.random.default_rng(0).uniform(-0.5, 0.5, 16_000).astype(np.float32)
    with mcap_file(tmp_path / "log.mcap") as write:
        for at_ns, _ in logged_sound(noise, 16_000):
            begins = 16_000 * at_ns // 10**9
            write(sound_message(at_ns, noise[begins : begins + 1600], 16_000))
        for number, state in enumerate(states):
            write(image_message(state.stamp_ns - 1, JPEGS[number % 2]))
            for message in state_messages(state):
                write(message)
    return tmp_path / "log.mcap", noise


def test_the_view_command_shows_images_and_sound_of_a_log(states, log_with_media, tmp_path):
    log, noise = log_with_media
    assert main(["log", "view", str(log)]) == 0
    data = json.loads(Elements(log.with_suffix(".html").read_text("utf-8")).data)
    rate_hz, samples = of_wave(data["sound"])
    begins = round(rate_hz * states[0].stamp_ns / 1e9)
    assert samples / 32768 == pytest.approx(noise[begins:][: len(samples)], abs=0.51 / 32768)
    assert [of_uri(one["src"], "image/jpeg") for one in data["images"][:2]] == JPEGS
    assert [row["image"] for row in data["states"]] == list(range(len(states)))
    lines = tmp_path / "states.jsonl"
    lines.write_text("".join(state.to_json() + "\n" for state in states))
    assert main(["log", "view", str(lines), "--out", str(tmp_path / "plain.html")]) == 0
    plain = Elements((tmp_path / "plain.html").read_text("utf-8"))
    assert not {"img", "audio"} & {tag for tag, _ in plain.found}
    assert not {"images", "sound"} & set(json.loads(plain.data))
    assert not any("image" in row for row in json.loads(plain.data)["states"])


def test_media_that_is_no_base64_gives_one_line(states, tmp_path, capsys):
    log, message = tmp_path / "log.mcap", image_message(0, b"image")
    with mcap_file(log) as write:
        for one in (*state_messages(states[0]), replace(message, value=replace(message.value, data='"><x'))):
            write(one)
    assert main(["log", "view", str(log)]) == 2
    assert "log.mcap: /camera/image.data: expected base64" in capsys.readouterr().err


@pytest.mark.long
@needs_browser
def test_the_page_explains_decisions_cuts_and_unusable_sound(states, tmp_path):
    heard = [replace(one, bearing=None if k == 2 else Bearing(0.3, 0.1, 2.0)) for k, one in enumerate(states)]
    low = replace(states[0].cues[0], evidence=replace(states[0].cues[0].evidence, compared_nats=-20.0))
    shown = [replace(heard[0], cues=(low, *heard[0].cues[1:])), *heard[1:]]
    write_log_page(tmp_path / "log.html", page_data(shown))
    with browser(tmp_path / "profile") as page:
        page.open((tmp_path / "log.html").as_uri())
        page.press("End")
        folded = page.value("[...document.querySelectorAll('h2')].map(one => one.textContent).join()")
        page.value("at('odds').open = true, drawCharts()")
        written_in = "document.querySelectorAll('h2, .legend, svg text')"
        texts = page.value(f"[...{written_in}].map(one => one.textContent)")
        paths = page.value(
            "Object.fromEntries([...document.querySelectorAll('.chart')].map(one => ["
            "one.firstChild.textContent.split(' ')[0],"
            "[...one.querySelectorAll('path')].map(path => path.getAttribute('d'))]))"
        )
    assert "Log-odds" not in folded
    nats = sum(states[-1].cues[0].evidence.terms_nats.values())
    assert texts[texts.index("sum") + 1] == f"{nats:+.2f}"
    decides = texts[texts.index("compared: mean over 0.3 s", texts.index("sum")) + 1]
    assert decides == f"{states[-1].cues[0].evidence.compared_nats:+.2f}"
    assert "below \u22128" in texts
    assert not [one for one in texts if re.search(r"window|sequence|looks", one)]
    assert len(paths["Risk:"]) == len(states[0].cues)
    assert [path.count("M") for path in paths["Prominence"]] == [2]


@pytest.mark.long
@needs_browser
@pytest.mark.parametrize("width", [1300, 420])
def test_a_browser_opens_the_page_without_errors_or_requests(states, tmp_path, width):
    since_1970 = [replace(state, stamp_ns=state.stamp_ns + 1_700_000_000 * 10**9) for state in states]
    pages = {
        "whole": (states, {"truth": (TRUE,), "t0_s": 0.4, "title": HOSTILE}),
        "uncalibrated": ([replace(state, calibrated=False) for state in states], {}),
        "since": (since_1970, {}),
        "empty": ([WorldState(0, 0)], {}),
    }
    unknown = dict.fromkeys(("status", "hidden_probability", "classification", "direction"))
    heard = replace(states[0].entities[0], **unknown)
    pages["without a model"] = [replace(states[0], entities=(heard,), cues=())], {}
    drawn_parts = "[...document.querySelectorAll('#street polygon, #charts path')]"
    colours = f"{drawn_parts}.map(one => one.getAttribute('fill'))"
    screen = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    with browser(tmp_path / "profile") as page:
        page.call("Emulation.setDeviceMetricsOverride", **screen)
        for name, (shown, parts) in pages.items():
            path = tmp_path / f"{name}.html"
            write_log_page(path, page_data(shown, **parts))
            page.events.clear()
            page.open(path.as_uri())
            page.value("at('odds').open = true")
            parts_shown = 2 if name == "whole" else 0
            page.until(f"at('odds').hidden || at('evidence').childElementCount >= {parts_shown}")
            drawn = {"var(--hidden)", "var(--view)", "var(--heard)"} & set(page.value(colours))
            assert (drawn == {"var(--heard)"}) == (name == "without a model")
            titles = page.value("[...document.querySelectorAll('.chart h2')].map(one => one.textContent)")
            assert any(one.startswith("Risk") for one in titles) == (name not in ("empty", "without a model"))
            assert page.value("innerWidth") == width
            assert page.value("document.documentElement.scrollWidth <= innerWidth")
            last = len(shown) - 1
            for key, at in (("Home", 0), ("ArrowRight", 1), ("End", last), ("ArrowLeft", last - 1)):
                page.press(key)
                assert page.value("+document.getElementById('slider').value") == min(max(at, 0), last)
            page.press(" ")
            assert not page.faults()
            assert page.asked() == [path.as_uri()]


@pytest.mark.long
@needs_browser
def test_sound_slider_and_image_are_synchronous(states, log_with_media, tmp_path):
    log, _ = log_with_media
    assert main(["log", "view", str(log)]) == 0
    path = log.with_suffix(".html")
    write_log_page(tmp_path / "plain.html", page_data(states))
    held = "[document.querySelector('audio').currentTime, +document.getElementById('slider').value]"
    with browser(tmp_path / "profile") as page:
        page.open(path.as_uri())
        assert "space: play or pause, with sound" in page.value("document.body.textContent")
        for key, at in (("Home", 0), ("ArrowRight", 1), ("End", 5)):
            page.press(key)
            since_s = (states[at].stamp_ns - states[0].stamp_ns) / 1e9
            assert page.value(held) == [pytest.approx(since_s, abs=1e-4), at]
            assert of_uri(page.value("document.querySelector('img').src"), "image/jpeg") == JPEGS[at % 2]
        page.value("at('slider').value = 2; at('slider').dispatchEvent(new Event('input'))")
        assert page.value(held) == [pytest.approx(0.2, abs=1e-4), 2]
        # The sound is slower than the clock and sets the pace; otherwise it would be paused halfway.
        page.value("document.querySelector('audio').playbackRate = 0.5")
        space = "document.body.dispatchEvent(new KeyboardEvent('keydown', {key: ' ', bubbles: true}))"
        page.call("Runtime.evaluate", expression=space, userGesture=True)
        assert page.value("document.querySelector('audio').paused") is False
        sound = "document.querySelector('audio')"
        once = f"new Promise(done => {sound}.addEventListener('pause', done, {{once: true}}))"
        page.call("Runtime.evaluate", expression=f"{sound}.paused || {once}", awaitPromise=True)
        assert page.value(held) == [pytest.approx(0.5, abs=0.05), pytest.approx(5, abs=1)]
        assert not page.faults()
        assert [url for url in page.asked() if not url.startswith("data:")] == [path.as_uri()]
        page.events.clear()
        page.open((tmp_path / "plain.html").as_uri())
        assert page.value("document.querySelectorAll('img, audio').length") == 0
