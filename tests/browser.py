"""Driving a headless Chromium through its own pipe: the DevTools protocol without a library."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

PROGRAM = shutil.which("chromium")
# Long enough for a machine on which everything else runs, too.
PATIENCE_S = 240.0
_SWITCHES = (
    "--headless=new",
    "--no-sandbox",  # containers run as root
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-extensions",
    "--disable-background-networking",
    "--no-first-run",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
)


class BrowserError(Exception):
    """The browser does not answer, or says no."""


class Page:
    """One page of a running browser.

    Attributes:
        complaints: errors and warnings that its console showed, and exceptions nobody caught.
        requests: addresses of everything that was asked for beside the page's own file.
    """

    def __init__(self, sending: int, receiving: int) -> None:
        self._sending, self._receiving = sending, receiving
        self._waiting = b""
        self._count = 0
        self._session = ""
        self.complaints: list[str] = []
        self.requests: list[str] = []

    def attach(self) -> None:
        """Make the page and listen to it."""
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        answer = self.ask("Target.attachToTarget", targetId=target, flatten=True)
        self._session = answer["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{domain}.enable")

    def open(self, path: Path) -> None:
        """Open a file and wait until all of it is there."""
        self.visit(path.as_uri())

    def visit(self, address: str) -> None:
        """Open an address and wait until all of it is there."""
        self.ask("Page.navigate", url=address)
        self.evaluate(
            "new Promise(done => document.readyState === 'complete' ? done()"
            " : addEventListener('load', () => done()))"
        )
        # Data URIs are decoded after the page has loaded.
        self.evaluate(
            "Promise.all([...document.images].map(image => image.decode().catch(() => 0)))"
        )

    def show_as(self, width: int, height: int = 900, *, theme: str = "light") -> None:
        """Set the size of the window and whether the system likes it light or dark."""
        self.ask(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )
        self.ask(
            "Emulation.setEmulatedMedia",
            features=[{"name": "prefers-color-scheme", "value": theme}],
        )

    def evaluate(self, script: str) -> Any:
        """Give the value of an expression, awaited when it is a promise."""
        answer = self.ask(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in answer:
            raise BrowserError(f"{script}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def press(self, key: str) -> None:
        """Press and release a key, e.g. `Tab`, `Enter`, `ArrowRight`."""
        codes = {"Tab": 9, "Enter": 13, "ArrowLeft": 37, "ArrowRight": 39}
        described = {"key": key, "code": key, "windowsVirtualKeyCode": codes[key]}
        text = {"text": "\r"} if key == "Enter" else {}
        self.ask("Input.dispatchKeyEvent", type="keyDown", **described, **text)
        self.ask("Input.dispatchKeyEvent", type="keyUp", **described)

    def screenshot(self, *, whole: bool = False) -> bytes:
        """Give a PNG of what the window shows, or of the whole page."""
        answer = self.ask("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        return base64.b64decode(answer["data"])

    def ask(self, method: str, **params: object) -> Mapping[str, Any]:
        """Send a command and wait for its answer; what happens meanwhile is noted."""
        self._count += 1
        number = self._count
        message: dict[str, object] = {"id": number, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        # Buffers of a pipe are small: os.write may take a part only.
        rest = json.dumps(message).encode() + b"\0"
        try:
            while rest:
                rest = rest[os.write(self._sending, rest) :]
        except BrokenPipeError as error:
            raise BrowserError("the browser ended") from error
        while True:
            answer = self._receive()
            if answer.get("id") == number:
                if "error" in answer:
                    raise BrowserError(f"{method}: {answer['error']}")
                return answer["result"]  # type: ignore[no-any-return]
            self._note(answer)

    def _receive(self) -> dict[str, Any]:
        deadline = time.monotonic() + PATIENCE_S
        while b"\0" not in self._waiting:
            ready, _, _ = select.select(
                [self._receiving], [], [], max(0.0, deadline - time.monotonic())
            )
            part = os.read(self._receiving, 1 << 20) if ready else b""
            if not part:
                raise BrowserError("the browser ended or did not answer in time")
            self._waiting += part
        first, _, self._waiting = self._waiting.partition(b"\0")
        found: dict[str, Any] = json.loads(first)
        return found

    def _note(self, event: Mapping[str, Any]) -> None:
        params = event.get("params", {})
        match event.get("method"):
            case "Runtime.exceptionThrown":
                self.complaints.append(json.dumps(params["exceptionDetails"]))
            case "Runtime.consoleAPICalled" if params["type"] in ("error", "warning", "assert"):
                self.complaints.append(json.dumps(params["args"]))
            case "Log.entryAdded" if params["entry"]["level"] in ("error", "warning"):
                self.complaints.append(params["entry"]["text"])
            case "Network.requestWillBeSent":
                self.requests.append(params["request"]["url"][:200])


@contextmanager
def browser(folder: Path) -> Iterator[Page]:
    """Start Chromium with a profile of its own in a folder, and end it.

    Raises:
        BrowserError: it does not start here.
    """
    if PROGRAM is None:
        raise BrowserError("no chromium is installed")
    to_read, to_send = os.pipe()
    to_receive, to_write = os.pipe()
    # Chromium reads commands from descriptor 3 and answers on 4.
    process = subprocess.Popen(
        [
            "bash",  # dash keeps descriptors above 9 for itself
            "-c",
            f'exec "$@" 3<&{to_read} 4>&{to_write}',
            "bash",
            PROGRAM,
            *_SWITCHES,
            f"--user-data-dir={folder}",
        ],
        pass_fds=(to_read, to_write),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(to_read)
    os.close(to_write)
    page = Page(to_send, to_receive)
    try:
        page.attach()
        yield page
    finally:
        process.kill()
        process.wait()
        os.close(to_send)
        os.close(to_receive)
