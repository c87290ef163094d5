"""Pages in the system's Chromium by playwright; tests reach it by the fixture `new_page`."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from playwright.sync_api import Browser

PROGRAM = shutil.which("chromium") or shutil.which("chromium-browser")
IS_HERE = PROGRAM is not None and find_spec("playwright") is not None
# Long enough for a machine on which everything else runs, too.
PATIENCE_S = 240.0
_SWITCHES = (
    "--no-sandbox",  # containers run as root
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
)


class Page:
    """One page of a running browser.

    Attributes:
        tab: playwright's page, for mouse and keyboard.
        complaints: errors and warnings that its console showed, and uncaught exceptions.
        requests: addresses of everything that was asked for.
    """

    def __init__(self, browser: Browser) -> None:
        self.tab = browser.new_page()
        self.tab.set_default_timeout(PATIENCE_S * 1000)
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.tab.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.tab.on(
            "console",
            lambda message: (
                self.complaints.append(message.text)
                if message.type in ("error", "warning", "assert")
                else None
            ),
        )
        self.tab.on("request", lambda request: self.requests.append(request.url[:200]))

    def open(self, path: Path) -> None:
        """Open a file and wait until all of it is there."""
        self.visit(path.as_uri())

    def visit(self, address: str) -> None:
        """Open an address and wait until all of it is there."""
        self.tab.goto(address, wait_until="load")
        # Data URIs are decoded after the page has loaded.
        self.evaluate(
            "Promise.all([...document.images].map(image => image.decode().catch(() => 0)))"
        )

    def show_as(self, width: int, height: int = 900, *, theme: str = "light") -> None:
        """Set the size of the window and whether the system prefers light or dark."""
        self.tab.set_viewport_size({"width": width, "height": height})
        self.tab.emulate_media(color_scheme="dark" if theme == "dark" else "light")

    def evaluate(self, script: str) -> Any:
        """Return the value of an expression, awaited when it is a promise."""
        return self.tab.evaluate(script)

    def press(self, key: str) -> None:
        """Press and release a key, e.g. `Tab`, `Enter`, `ArrowRight`."""
        self.tab.keyboard.press(key)

    def screenshot(self, *, whole: bool = False) -> bytes:
        """Return a PNG of what the window shows, or of the whole page."""
        return self.tab.screenshot(full_page=whole)


@contextmanager
def started() -> Iterator[Browser]:
    """Start Chromium, and end it."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=PROGRAM, args=[*_SWITCHES])
        try:
            yield browser
        finally:
            browser.close()
