"""The view in a browser: ports and processes of the server, and the page in a real browser."""

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import CHROMIUM, Browser, free_options
from test_viewer import estimate, frameset, rows_of, some_rig

from graphvio.arrays import AnyArray
from graphvio.errors import GraphvioError
from graphvio.measurements.estimate import Status
from graphvio.viewer import Viewer, WebOptions
from graphvio.viewer.layout import STATUS_COLOURS
from graphvio.viewer.processes import WebHost, window_command

pytest.importorskip("rerun")

ROOT = Path(__file__).parents[1]


def listening_hosts(port: int) -> set[str]:
    """Addresses in hexadecimal, as in /proc/net, at which a process listens."""
    hosts = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            local, state = line.split()[1], line.split()[3]
            if state == "0A" and int(local.rpartition(":")[2], 16) == port:
                hosts.add(local.rpartition(":")[0])
    return hosts


def until(condition: Callable[[], object], what: str, seconds: float = 20.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.05)


@pytest.fixture(scope="module")
def served() -> Iterator[WebOptions]:
    options = free_options()
    with Viewer(some_rig(), web=options) as viewer:
        for k in range(40):
            viewer.show(frameset(k), estimate(k))
        yield options


def test_web_view_listens_on_loopback_only(served: WebOptions) -> None:
    with urllib.request.urlopen(served.url, timeout=10.0) as page:
        assert page.status == 200
        assert b"<canvas" in page.read()
    for port in (served.port, served.data_port):
        assert listening_hosts(port) == {"0100007F"}  # 127.0.0.1


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
def test_web_view_in_browser_shows_path(served: WebOptions, tmp_path: Path) -> None:
    with Browser(tmp_path, (800, 600)) as browser:
        browser.open(served.url)
        shown: AnyArray = np.zeros((0, 0, 3), dtype=np.uint8)

        def has_path() -> bool:
            nonlocal shown
            shown = np.asarray(cv2.imdecode(np.frombuffer(browser.screenshot(), np.uint8), cv2.IMREAD_COLOR))
            colour = np.array(STATUS_COLOURS[Status.TRACKING])[::-1]
            world = shown[60:540, :470]  # the left part of the page
            return bool((np.abs(world.astype(int) - colour).max(axis=2) < 12).sum() > 30)

        # Rendered by the processor, a frame takes seconds.
        until(has_path, "the path is not on the page", 180.0)
        assert browser.value("document.querySelectorAll('canvas').length") == 1
        assert len(np.unique(shown.reshape(-1, 3), axis=0)) > 100


def test_close_frees_both_ports() -> None:
    options = free_options()
    for _ in range(2):
        with Viewer(some_rig(), web=options) as viewer:
            viewer.show(None, estimate(0))
        assert not listening_hosts(options.port)
        assert not listening_hosts(options.data_port)


def test_web_host_of_killed_process_ends() -> None:
    options = free_options()
    code = f"""
import time
from graphvio.viewer.processes import WebHost, WebOptions
host = WebHost(WebOptions({options.port}))
print("serves", flush=True)
time.sleep(60)
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None
    assert process.stdout.readline() == "serves\n"
    assert listening_hosts(options.port)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    until(lambda: not listening_hosts(options.port) and not listening_hosts(options.data_port), "it is still served")


def test_viewer_after_end_of_web_host_still_saves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hosts = []

    class Host(WebHost):
        def __init__(self, options: WebOptions) -> None:
            super().__init__(options)
            hosts.append(self)

    monkeypatch.setattr("graphvio.viewer.recording.WebHost", Host)
    with Viewer(some_rig(), web=free_options(), save=tmp_path / "run.rrd") as viewer:
        viewer.show(None, estimate(0))
        hosts[0].close()
        for k in range(1, 20):
            viewer.show(frameset(k), estimate(k))
    assert rows_of(tmp_path / "run.rrd")["/world/rig"] == 20


def test_window_listens_on_this_machine_only() -> None:
    """Without a window, as there is no display; where nothing can be rendered it ends soon after."""
    port = free_options().port
    process = subprocess.Popen(
        [*window_command(port), "--headless"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        until = time.monotonic() + 60.0
        while not (hosts := listening_hosts(port)) and process.poll() is None and time.monotonic() < until:
            time.sleep(0.005)
    finally:
        process.kill()
        process.wait()
    assert hosts == {"0100007F"}  # 127.0.0.1


def test_web_options_with_unusable_values_raise() -> None:
    options = free_options()
    with socket.socket() as other:
        other.bind(("127.0.0.1", options.data_port))
        other.listen()
        with pytest.raises(GraphvioError, match=f"port {options.data_port} of 127.0.0.1 cannot be used"):
            Viewer(some_rig(), web=options)
    for wrong in (0, 65535):
        with pytest.raises(GraphvioError, match="choose one from 1 to 65534"):
            WebOptions(wrong)
    with pytest.raises(GraphvioError, match="memory_mb is 0"):
        WebOptions(memory_mb=0)
