"""A headless Chromium that opens a page and tells what became of it, over its debugging pipe."""

from __future__ import annotations

import base64
import fcntl
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
DEADLINE_S = 120.0
FREE_FD = 10  # the pipe is at 3 and 4 in the browser
LOOK = """(() => {
  const sizes = (selector) => [...document.querySelectorAll(selector)].map((element) => {
    const box = element.getBoundingClientRect();
    return {width: box.width, height: box.height, decoded: element.naturalWidth || 0};
  });
  return {images: sizes("img"), tables: sizes("table"), wide: document.documentElement.scrollWidth,
          title: document.title};
})()"""


@dataclass(frozen=True)
class Page:
    """What a page looks like: sizes of its images and tables in CSS pixels (``decoded``: width of the image
    itself), its scroll width, its title, and what it wrote to the console."""

    images: list[dict[str, float]]
    tables: list[dict[str, float]]
    wide: float
    title: str
    console: list[str]


def open_page(path: Path, width: int, screenshot: Path, folder: Path) -> Page:
    """Load a file in a window so wide and photograph all of it; ``folder`` holds the browser's profile.

    Skips the test where there is no Chromium.
    """
    found = next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip(f"none of {', '.join(NAMES)} is installed")
    with _browser(found, width, folder) as browser:
        target = browser.call("Target.createTarget", url="about:blank")["targetId"]
        session = browser.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            browser.call(f"{domain}.enable", session)
        browser.call("Page.navigate", session, url=path.resolve().as_uri())
        browser.wait_for("Page.loadEventFired")
        seen = browser.call("Runtime.evaluate", session, expression=LOOK, returnByValue=True)
        shot = browser.call("Page.captureScreenshot", session, captureBeyondViewport=True)
        screenshot.write_bytes(base64.b64decode(shot["data"]))
        told = ("Log.entryAdded", "Runtime.consoleAPICalled", "Runtime.exceptionThrown")
        console = [json.dumps(event["params"]) for event in browser.events if event["method"] in told]
    return Page(**seen["result"]["value"], console=console)


class _Pipe:
    """Commands to a browser and its answers, JSON that ends with a zero byte; ``events`` are what came
    besides."""

    def __init__(self, read: int, write: int) -> None:
        self._read, self._write, self._buffer, self._sent = read, write, b"", 0
        self.events: list[dict[str, Any]] = []

    def call(self, method: str, session: str = "", **params: Any) -> dict[str, Any]:
        self._sent += 1
        message = {"id": self._sent, "method": method, "params": params}
        data = json.dumps(message | ({"sessionId": session} if session else {})).encode() + b"\0"
        os.write(self._write, data)
        while True:
            answer = self._next()
            if answer.get("id") == self._sent:
                assert "error" not in answer, answer
                return dict(answer["result"])
            self.events.append(answer)

    def wait_for(self, method: str) -> None:
        while all(event.get("method") != method for event in self.events):
            self.events.append(self._next())

    def _next(self) -> dict[str, Any]:
        deadline = time.monotonic() + DEADLINE_S
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._read], [], [], max(0.0, deadline - time.monotonic()))
            part = os.read(self._read, 1 << 20) if ready else b""
            assert part, "the browser does not answer"
            self._buffer += part
        message, _, self._buffer = self._buffer.partition(b"\0")
        return dict(json.loads(message))


@contextmanager
def _browser(program: str, width: int, folder: Path) -> Iterator[_Pipe]:
    commands, answers = os.pipe(), os.pipe()
    theirs = [fcntl.fcntl(fd, fcntl.F_DUPFD_CLOEXEC, FREE_FD) for fd in (commands[0], answers[1])]

    def place() -> None:
        for number, fd in enumerate(theirs, start=3):
            os.dup2(fd, number)

    options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run"]
    options += [f"--window-size={width},900", f"--user-data-dir={folder}", "--remote-debugging-pipe"]
    process = subprocess.Popen(
        [program, *options], preexec_fn=place, close_fds=False, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    for fd in (*theirs, commands[0], answers[1]):
        os.close(fd)
    try:
        pipe = _Pipe(answers[0], commands[1])
        yield pipe
        pipe.call("Browser.close")
    finally:
        os.close(commands[1])
        try:
            process.wait(10.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        os.close(answers[0])
