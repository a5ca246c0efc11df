"""Headless Chromium, controlled by the DevTools protocol over a pipe, for pages in a browser's layout."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

#: The first name is the Chromium that `scripts/setup --test` unpacks.
NAMES = (
    str(Path(__file__).resolve().parents[2] / ".cache" / "bin" / "chromium"),
    "chromium", "chromium-headless-shell", "chromium-browser", "google-chrome", "google-chrome-stable",
)  # fmt: skip
SWITCHES = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--disable-dev-shm-usage", "--hide-scrollbars",
    "--remote-debugging-pipe",
)  # fmt: skip
#: Seconds after which a silent browser counts as broken.
PATIENCE = 60.0


def find_chromium() -> str | None:
    """Return the path of a Chromium, or None if there is none."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Chromium:
    """Browser with one page, which `close` ends."""

    def __init__(self, executable: str, profile: Path) -> None:
        to_browser, self._write = os.pipe()
        self._read, from_browser = os.pipe()

        def as_the_browser_has_them() -> None:
            # The descriptors move through numbers that neither pipe has. The pipes themselves may have 3 and 4.
            inward, outward = os.dup(to_browser), os.dup(from_browser)
            high = os.dup2(inward, 90), os.dup2(outward, 91)
            os.dup2(high[0], 3)
            os.dup2(high[1], 4)

        self._process = subprocess.Popen(
            [executable, *SWITCHES, f"--user-data-dir={profile}", "about:blank"],
            preexec_fn=as_the_browser_has_them, close_fds=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(to_browser)
        os.close(from_browser)
        os.set_blocking(self._read, False)
        self._buffer, self._number = b"", 0
        self.events: list[dict[str, Any]] = []
        self._session: str | None = None
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Network", "Log"):
            self._call(f"{domain}.enable")

    def open(self, path: Path | str, width: int, scripts: bool = True, dark: bool = False) -> None:
        """Open the page at a path or an address with a width in pixels, and wait until the page is fully loaded."""
        self._call("Emulation.setScriptExecutionDisabled", value=not scripts)
        self.show(width, dark)
        self.events.clear()
        self._call("Page.navigate", url=path if isinstance(path, str) else path.absolute().as_uri())
        self._wait(lambda: any(event["method"] == "Page.loadEventFired" for event in self.events))

    def show(self, width: int, dark: bool = False) -> None:
        """Show the page with another width, in light or dark mode, without loading it again."""
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self._call("Emulation.setEmulatedMedia", features=[scheme])
        self._call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=True)

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression in the page. Scripts of the page itself may be disabled."""
        result = self._call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def wait_for(self, expression: str, seconds: float) -> bool:
        """Wait until a JavaScript expression is true. Return whether it became true within `seconds`."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if self.evaluate(expression):
                return True
            time.sleep(0.02)
        return False

    def screenshot(self, path: Path) -> None:
        """Write the whole page as a PNG."""
        size = self._call("Page.getLayoutMetrics")["cssContentSize"]
        clip = {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}
        data = self._call("Page.captureScreenshot", captureBeyondViewport=True, clip=clip)["data"]
        path.write_bytes(base64.b64decode(data))

    def requests(self) -> list[str]:
        """Return the addresses that the page requested since it was opened."""
        return [
            event["params"]["request"]["url"] for event in self.events if event["method"] == "Network.requestWillBeSent"
        ]

    def close(self) -> None:
        """End the browser."""
        os.close(self._write)
        os.close(self._read)
        try:
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        number = self._number
        message: dict[str, Any] = {"id": number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        answers: list[dict[str, Any]] = []

        def answered() -> bool:
            answers.extend(event for event in self.events if event.get("id") == number)
            return bool(answers)

        self._wait(answered)
        self.events = [event for event in self.events if "method" in event]
        assert "error" not in answers[0], (method, answers[0])
        return dict(answers[0]["result"])

    def _wait(self, done: Any) -> None:
        deadline = time.monotonic() + PATIENCE
        while not done():
            if time.monotonic() > deadline or self._process.poll() is not None:
                raise TimeoutError("the browser does not answer")
            try:
                chunk = os.read(self._read, 1 << 20)
            except BlockingIOError:
                time.sleep(0.01)
                continue
            *messages, self._buffer = (self._buffer + chunk).split(b"\0")
            self.events.extend(json.loads(message) for message in messages)
