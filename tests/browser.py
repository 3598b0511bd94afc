"""A headless Chromium that tests drive over its DevTools protocol: evaluate, click, type, look."""

from __future__ import annotations

import base64
import io
import json
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from websockets.sync.client import connect

PROGRAM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
_FLAGS = (
    "--headless=new --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --disable-quic --no-first-run"
    " --disable-background-networking --disable-component-update --disable-sync --mute-audio --disable-gpu-watchdog"
    " --disable-backgrounding-occluded-windows --disable-renderer-backgrounding --disable-background-timer-throttling"
    " --remote-debugging-port=0 --window-size=1280,800 --disable-features=BackForwardCache"
).split()


class Browser:
    """One page."""

    def __init__(self, folder: Path) -> None:
        assert PROGRAM is not None
        self._program = subprocess.Popen(
            [PROGRAM, *_FLAGS, f"--user-data-dir={folder}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        told = folder / "DevToolsActivePort"
        end = time.monotonic() + 60
        while not (told.is_file() and len(told.read_text().split()) == 2):
            assert time.monotonic() < end and self._program.poll() is None, "the browser does not start"
            time.sleep(0.1)
        port, path = told.read_text().split()
        self._socket = connect(f"ws://127.0.0.1:{port}{path}", max_size=2**28, compression=None)
        self._count = 0
        self._session: str | None = None
        self.errors: list[str] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The result of one command; errors of the page that come meanwhile are kept."""
        self._count += 1
        asked: dict[str, Any] = {"id": self._count, "method": method, "params": parameters}
        self._socket.send(json.dumps(asked | ({"sessionId": self._session} if self._session else {})))
        while True:
            told = json.loads(self._socket.recv(timeout=120))
            self._note(told)
            if told.get("id") == self._count:
                assert "error" not in told, told["error"]
                return dict(told["result"])

    def _note(self, told: dict[str, Any]) -> None:
        if told.get("method") == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(told["params"]["exceptionDetails"])[:500])
        if told.get("method") == "Log.entryAdded" and told["params"]["entry"]["level"] == "error":
            self.errors.append(told["params"]["entry"]["text"])
        if told.get("method") == "Runtime.consoleAPICalled" and told["params"]["type"] == "error":
            self.errors.append(json.dumps(told["params"]["args"])[:500])

    def open(self, address: str) -> None:
        """Go to a page; errors of the one before are forgotten."""
        self.call("Page.navigate", url="about:blank")
        self.text()
        self.errors.clear()
        self.call("Page.navigate", url=address)

    def run(self, script: str) -> Any:
        """The value of a piece of JavaScript."""
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def text(self) -> str:
        """What the page says."""
        return str(self.run("document.body.innerText"))

    def wait(self, met: Callable[[], object], seconds: float = 60.0) -> None:
        """Wait until something holds; fails after so many seconds."""
        end = time.monotonic() + seconds
        while not met():
            assert time.monotonic() < end, f"the page says: {self.text()[:2000]}"
            time.sleep(0.2)

    def says(self, words: str) -> None:
        """Wait until the page says something."""
        self.wait(lambda: words in self.text())

    def click(self, x: float, y: float) -> None:
        """Press and release the left button at a place of the page."""
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        time.sleep(0.2)
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def press(self, words: str) -> None:
        """Click the button that says some words."""
        found = f"[...document.querySelectorAll('button')].find(b => b.innerText.trim() === {json.dumps(words)})"
        self.wait(lambda: self.run(f"!!{found}"))
        self.run(f"{found}.click()")

    def fill(self, label: str, text: str) -> None:
        """Put text into the field of a label, as by hand."""
        found = self.run(
            "(() => { const l = [...document.querySelectorAll('label')].find(l => l.innerText.trim() === "
            f"{json.dumps(label)}); let a = l; while (a && !a.querySelector('input')) a = a.parentElement; "
            "if (!a) return false; const i = a.querySelector('input'); i.focus(); i.select(); return true; })()"
        )
        assert found, f"there is no field {label}"
        self.call("Input.insertText", text=text)

    def key(self, letter: str) -> None:
        """Press a key with the focus on the scene."""
        self.run("document.activeElement && document.activeElement.blur()")
        for kind in ("keyDown", "keyUp"):
            code = ord(letter.upper())
            self.call(
                "Input.dispatchKeyEvent", type=kind, key=letter, code=f"Key{letter.upper()}", windowsVirtualKeyCode=code
            )

    def enter(self) -> None:
        """Press Enter where the focus is."""
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter", windowsVirtualKeyCode=13, text="\r"
            )

    def picture(self) -> np.ndarray:
        """What the page looks like. RGB, shape (H, W, 3)."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def close(self) -> None:
        """End the program."""
        self._socket.close()
        self._program.terminate()
        self._program.wait(timeout=30)
