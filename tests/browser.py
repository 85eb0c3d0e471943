"""A headless Chromium, driven by the DevTools protocol over pipes, and free ports for a web view."""

import base64
import json
import os
import select
import shutil
import socket
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from graphvio.viewer import WebOptions

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
_ANSWER_S = 60.0


def free_options() -> WebOptions:
    """Options with two free consecutive ports."""
    while True:
        with socket.socket() as one, socket.socket() as other, suppress(OSError):
            one.bind(("127.0.0.1", 0))
            other.bind(("127.0.0.1", one.getsockname()[1] + 1))
            return WebOptions(one.getsockname()[1], memory_mb=64)


class Browser:
    """One page; a context manager.

    Args:
        profile: an empty folder.
        size_px: of the page.
    """

    def __init__(self, profile: Path, size_px: tuple[int, int] = (1280, 800)) -> None:
        assert CHROMIUM is not None
        theirs_in, self._to = os.pipe()
        self._from, theirs_out = os.pipe()
        self._process = subprocess.Popen(
            [
                *("bash", "-c", f'exec "$@" 3<&{theirs_in} 4>&{theirs_out}', "bash", CHROMIUM, "--headless=new"),
                *("--no-sandbox", "--remote-debugging-pipe", f"--user-data-dir={profile}", "--no-first-run"),
                *("--enable-unsafe-swiftshader", "--use-angle=swiftshader", "--disable-gpu-watchdog"),
                f"--window-size={size_px[0]},{size_px[1]}",
            ],
            pass_fds=(theirs_in, theirs_out),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self._number = 0
        self._received = b""
        self._is_loaded = True
        target = self._ask("Target.createTarget", {"url": "about:blank"})["targetId"]
        attached = self._ask("Target.attachToTarget", {"targetId": target, "flatten": True})
        self._session = str(attached["sessionId"])
        for domain in ("Page", "Runtime"):
            self.ask(f"{domain}.enable")
        width, height = size_px
        self.ask(
            "Emulation.setDeviceMetricsOverride",
            {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False},
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._to)
        os.close(self._from)

    def open(self, url: str) -> None:
        """Navigate to an address and wait until the page is loaded."""
        self._is_loaded = False
        self.ask("Page.navigate", {"url": url})
        while not self._is_loaded:
            self._read()

    def screenshot(self) -> bytes:
        """Take a screenshot as PNG."""
        return base64.b64decode(self.ask("Page.captureScreenshot", {"format": "png"})["data"])

    def value(self, expression: str) -> Any:
        """Evaluate JavaScript in the page."""
        return self.ask("Runtime.evaluate", {"expression": expression, "returnByValue": True})["result"].get("value")

    def ask(self, method: str, parameters: dict[str, Any] | None = None) -> Any:
        return self._ask(method, parameters or {}, self._session)

    def _ask(self, method: str, parameters: dict[str, Any], session: str | None = None) -> Any:
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._read()
            if answer.get("id") == self._number:
                assert "result" in answer, answer
                return answer["result"]

    def _read(self) -> Any:
        until = time.monotonic() + _ANSWER_S
        while b"\0" not in self._received:
            ready, _, _ = select.select([self._from], [], [], max(0.0, until - time.monotonic()))
            assert ready, "the browser does not answer"
            chunk = os.read(self._from, 2**20)
            assert chunk, "the browser has ended"
            self._received += chunk
        text, _, self._received = self._received.partition(b"\0")
        message = json.loads(text)
        self._is_loaded = self._is_loaded or message.get("method") == "Page.loadEventFired"
        return message
