"""A headless Chromium for tests of pages."""

import json
import os
import shutil
import subprocess
from contextlib import contextmanager
from pathlib import Path

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


class Browser:
    """A headless Chromium controlled through a pipe of JSON messages that end with a zero byte."""

    def __init__(self, write: int, read: int) -> None:
        self.write, self.read, self.buffer, self.session = write, read, b"", {}
        self.events: list[dict] = []
        pages = self.call("Target.getTargets")["targetInfos"]
        page = next(one["targetId"] for one in pages if one["type"] == "page")
        attached = self.call("Target.attachToTarget", targetId=page, flatten=True)
        self.session = {"sessionId": attached["sessionId"]}

    def message(self) -> dict:
        while b"\0" not in self.buffer:
            got = os.read(self.read, 1 << 20)
            assert got, "the browser ended"
            self.buffer += got
        first, self.buffer = self.buffer.split(b"\0", 1)
        return json.loads(first)

    def call(self, method: str, **params) -> dict:
        asked = {"id": 1, "method": method, "params": params, **self.session}
        os.write(self.write, json.dumps(asked).encode() + b"\0")
        while "id" not in (answer := self.message()):
            self.events.append(answer)
        return answer["result"]

    def open(self, url: str) -> None:
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.call("Page.navigate", url=url)
        while not any(one["method"] == "Page.loadEventFired" for one in self.events):
            self.events.append(self.message())

    def value(self, expression: str):
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        return answer["result"].get("value")

    def until(self, expression: str) -> None:
        """Wait until an expression is true."""
        poll = f"new Promise(done => setInterval(() => ({expression}) && done(), 50))"
        self.call("Runtime.evaluate", expression=poll, awaitPromise=True)

    def faults(self) -> list[dict]:
        """Return what the page wrote to its console, and exceptions."""
        kinds = "Runtime.exceptionThrown", "Log.entryAdded", "Runtime.consoleAPICalled"
        return [one for one in self.events if one["method"] in kinds]

    def asked(self) -> list[str]:
        """Return the addresses that the page asked for."""
        sent = [one["params"] for one in self.events if one["method"] == "Network.requestWillBeSent"]
        return [one["request"]["url"] for one in sent]

    def press(self, key: str) -> None:
        event = f"new KeyboardEvent('keydown', {{key: '{key}', bubbles: true}})"
        self.value(f"document.body.dispatchEvent({event})")


@contextmanager
def browser(folder: Path):
    """Yield a browser with descriptors 3 and 4 of this process."""
    (theirs_in, ours_out), (ours_in, theirs_out) = os.pipe(), os.pipe()
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--remote-debugging-pipe"]
    shell = f'exec "$@" 3<&{theirs_in} 4>&{theirs_out}'
    call = ["bash", "-c", shell, "-", CHROMIUM, *options, f"--user-data-dir={folder}", "about:blank"]
    process = subprocess.Popen(call, pass_fds=(theirs_in, theirs_out), stderr=subprocess.DEVNULL)
    try:
        os.close(theirs_in)
        os.close(theirs_out)
        yield Browser(ours_out, ours_in)
    finally:
        process.terminate()
        process.wait(20)
        os.close(ours_in)
        os.close(ours_out)


needs_browser = pytest.mark.skipif(
    CHROMIUM is None or shutil.which("bash") is None, reason="there is no Chromium here"
)
