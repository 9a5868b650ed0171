"""A real browser without a window, steered through the DevTools protocol (with ``websockets``, which viser brings)."""

import base64
import io
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy import ndarray
from numpy.linalg import norm
from PIL import Image

from mereo.geometry.conventions import Pair

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

needs_browser = pytest.mark.skipif(
    BROWSER is None, reason="no chromium or chrome in PATH: install one (Debian: apt-get install chromium)"
)

OPTIONS = (
    *("--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run"),
    *("--hide-scrollbars", "--remote-debugging-port=0", "--remote-allow-origins=*"),
)


class Page:
    """One page in a browser of its own; a context manager."""

    def __init__(self, folder: Path, address: str, size: Pair = (1200, 800)) -> None:
        assert BROWSER
        from websockets.sync.client import connect

        profile = folder / "profile"
        command = [BROWSER, *OPTIONS, f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}", address]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        port_file = profile / "DevToolsActivePort"
        until(lambda: port_file.is_file() and port_file.read_text().count("\n") > 0)
        with urllib.request.urlopen(f"http://127.0.0.1:{port_file.read_text().split()[0]}/json/list") as answer:
            target = next(t for t in json.load(answer) if t["type"] == "page")
        self._socket = connect(target["webSocketDebuggerUrl"], max_size=None)
        self._sent = 0
        # the window's title bar takes part of its size; screenshots are to have exactly this one
        self.call(
            "Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=False
        )

    def __enter__(self) -> "Page":
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait(timeout=20)

    def call(self, method: str, **parameters: Any) -> Any:
        self._sent += 1
        self._socket.send(json.dumps({"id": self._sent, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=240))
            if answer.get("id") == self._sent:
                assert "error" not in answer, answer
                return answer["result"]

    def evaluate(self, script: str) -> Any:
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def still(self) -> None:
        """No transitions: viser fades a scene in, which takes long where frames are drawn in software."""
        style = "* { transition: none !important; animation: none !important } canvas { opacity: 1 !important }"
        self.evaluate(f"document.head.insertAdjacentHTML('beforeend', '<style>{style}</style>')")

    def text(self) -> str:
        return str(self.evaluate("document.body.innerText"))

    def screenshot(self) -> ndarray:
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def click(self, x: float, y: float) -> None:
        where = {"x": x, "y": y, "button": "left", "clickCount": 1}
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        self.call("Input.dispatchMouseEvent", type="mousePressed", **where)
        self.call("Input.dispatchMouseEvent", type="mouseReleased", **where)


def until(condition: Callable[[], Any], timeout_s: float = 120.0) -> Any:
    """Wait for something to be true and return it; fails after ``timeout_s``, which a busy machine may need."""
    end = time.monotonic() + timeout_s
    while not (found := condition()):
        if time.monotonic() > end:
            raise TimeoutError(f"it did not happen within {timeout_s:g} s")
        time.sleep(0.2)
    return found


def pixels_of(picture: ndarray, color: tuple[int, int, int], cosine: float = 0.99) -> int:
    """How many pixels have this hue, whatever the light."""
    wanted = np.asarray(color, float)
    shown = picture.astype(float)
    length = norm(shown, axis=-1)
    same = shown @ wanted / (np.maximum(length, 1e-9) * norm(wanted)) > cosine
    return int((same & (length > 60)).sum())
