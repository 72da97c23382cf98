"""Headless Chromium for tests that need a browser, driven through its DevTools protocol."""

import base64
import io
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

PATIENCE = 90
"""Longest time that a test waits for the page, s. WebGL without a GPU is slow."""


class Page:
    """One page of the browser. `requests` are the addresses that it requested."""

    def __init__(self, socket: Any):
        self._socket, self._last, self.requests = socket, 0, []
        self.log: list[str] = []
        self.loaded = False
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command, and return its result."""
        self._last += 1
        self._socket.send(json.dumps({"id": self._last, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(PATIENCE))
            if message.get("method") == "Network.requestWillBeSent":
                self.requests.append(message["params"]["request"]["url"])
            self.loaded |= message.get("method") == "Page.loadEventFired"
            if message.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded", "Runtime.consoleAPICalled"):
                self.log.append(json.dumps(message["params"])[:2000])
            if message.get("id") == self._last:
                assert "error" not in message, message["error"]
                return message["result"]

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def screenshot(self) -> np.ndarray:
        """Picture of the page, (H, W, 3) uint8."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def open_tab(self, name: str) -> None:
        """Open a tab of the panel."""
        find = f"[...document.querySelectorAll('[role=tab]')].find(t => t.innerText.trim() == {name!r})"
        wait_for(lambda: self.evaluate(f"Boolean({find})"), f"the tab {name}")
        box = f"(() => {{ const b = {find}.getBoundingClientRect(); return [b.x + b.width / 2, b.y + 9]; }})()"

        def opened() -> bool:
            if self.evaluate(f"{find}.ariaSelected") != "true":
                self.click(*self.evaluate(box))  # again, in case the page was busy
                time.sleep(1)
            return self.evaluate(f"{find}.ariaSelected") == "true"

        wait_for(opened, f"the open tab {name}")

    def press(self, label: str) -> None:
        """Click the button with a label."""
        find = f"[...document.querySelectorAll('button')].find(b => b.innerText.trim() == {label!r})"
        wait_for(lambda: self.evaluate(f"Boolean({find})"), f"the button {label}")
        self.evaluate(f"{find}.click()")

    def drag(self, start: tuple[float, float], end: tuple[float, float], *, shift: bool = False) -> None:
        """Drag with the left button from one place to another."""
        held = {"modifiers": 8 if shift else 0, "button": "left"}
        points = np.linspace(start, end, 6).tolist()
        events = [("mouseMoved", start), ("mousePressed", start), *(("mouseMoved", p) for p in points)]
        for kind, (x, y) in [*events, ("mouseReleased", end)]:
            pressed = {"buttons": 1, "clickCount": 1} if kind != "mouseReleased" else {"clickCount": 1}
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **held, **pressed)
            time.sleep(0.1)  # the page follows the pointer from frame to frame

    def click(self, x: float, y: float) -> None:
        """Press and release the left button."""
        where = {"x": x, "y": y, "button": "left", "clickCount": 1}
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        time.sleep(0.3)  # the page determines what is under the pointer between two frames
        self.call("Input.dispatchMouseEvent", type="mousePressed", **where)
        self.call("Input.dispatchMouseEvent", type="mouseReleased", **where)


@contextmanager
def browser(profile: Path, url: str, width: int, height: int) -> Iterator[Page]:
    """A page in a new headless Chromium that can only reach this machine."""
    connect = pytest.importorskip("websockets.sync.client", reason="websockets, which comes with viser").connect
    if CHROMIUM is None:
        pytest.skip("chromium is missing: install it to run the tests with a browser")
    flags = ["--headless", "--no-sandbox", "--remote-debugging-port=0", "--hide-scrollbars", "--mute-audio"]
    flags += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage"]
    flags += ["--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1", "--disable-quic", "--no-first-run"]
    flags += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]
    flags += [f"--user-data-dir={profile}", f"--window-size={width},{height}", "about:blank"]
    process = subprocess.Popen([CHROMIUM, *flags], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        started = profile / "DevToolsActivePort"
        wait_for(lambda: started.is_file() and started.read_text().count("\n") == 1, "the browser's start")
        port, path = started.read_text().split("\n")
        with connect(f"ws://127.0.0.1:{port}{path}", max_size=None) as top:
            top.send(json.dumps({"id": 1, "method": "Target.getTargets"}))
            targets = json.loads(top.recv(PATIENCE))["result"]["targetInfos"]
        target = next(t["targetId"] for t in targets if t["type"] == "page")
        with connect(f"ws://127.0.0.1:{port}/devtools/page/{target}", max_size=None) as socket:
            page = Page(socket)
            size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
            page.call("Emulation.setDeviceMetricsOverride", **size)
            page.loaded = False
            page.call("Page.navigate", url=url)
            # A screenshot needs a loaded page. Any call receives the pending events.
            wait_for(lambda: page.call("Browser.getVersion") and page.loaded, "the page")
            yield page
    finally:
        process.terminate()
        process.wait()


def wait_for(condition: Any, what: str) -> None:
    """Wait until the condition holds."""
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, f"waited {PATIENCE} s for {what}"
        time.sleep(0.2)
