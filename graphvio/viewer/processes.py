"""Rerun's programs in their own processes: its window, which stays open when this process ends, and its web server.

When run inside this process, rerun (0.41) would listen on all addresses, without a password.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import quote

from graphvio.errors import GraphvioError

_HOST = "127.0.0.1"
_WINDOW_PORT = 9876
WINDOW_URL = f"rerun+http://{_HOST}:{_WINDOW_PORT}/proxy"
"""Address to which the window's data is sent."""

_WINDOW_S, _SURE_S = 8.0, 1.0
_START_S, _END_S = 20.0, 5.0
# Ends the server when its standard input is closed, which also happens when this process is killed.
_SCRIPT = 'trap : TERM; "$@" & read -r _; kill -TERM 0; wait'


@dataclass(frozen=True)
class WebOptions:
    """Ports and memory of the web server.

    The server listens on this machine only; from another one, use an SSH tunnel for both ports.

    Raises:
        GraphvioError: if a value is out of range.
    """

    port: int = 9090  # port of the page; the next one, ``data_port``, serves its data
    memory_mb: int = 512  # data kept for browsers that connect later; the oldest is dropped

    def __post_init__(self) -> None:
        if not 1 <= self.port <= 65534:
            raise GraphvioError(
                f"web view: port {self.port}: choose one from 1 to 65534, as the next one is used for its data"
            )
        if self.memory_mb < 1:
            raise GraphvioError(f"web view: memory_mb is {self.memory_mb}; choose at least 1")

    @property
    def data_port(self) -> int:
        """Port of the server's data."""
        return self.port + 1

    @property
    def data_url(self) -> str:
        """Address of the server's data."""
        return f"rerun+http://{_HOST}:{self.data_port}/proxy"

    @property
    def url(self) -> str:
        """Address of the page, for a browser."""
        return f"http://{_HOST}:{self.port}/?url={quote(self.data_url, safe='')}"


class WebHost:
    """The process of the web server; it ends at `close`, or when this process ends.

    Raises:
        GraphvioError: if a port is taken, or rerun does not start.
    """

    def __init__(self, options: WebOptions) -> None:
        for port in (options.port, options.data_port):
            _check_free(port)
        command = [
            *(*_rerun_program(), "--serve-web", "--bind", _HOST),
            *("--port", str(options.data_port), "--web-viewer-port", str(options.port)),
            *("--server-memory-limit", f"{options.memory_mb}MB"),
        ]
        self._process = subprocess.Popen(
            ["sh", "-c", _SCRIPT, "sh", *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the odometry, which then closes the server
        )
        try:
            for port in (options.port, options.data_port):
                self._wait_for(port)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the process; a second call does nothing."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()

    def _wait_for(self, port: int) -> None:
        until = time.monotonic() + _START_S
        while time.monotonic() < until:
            if _answers(port):
                return
            time.sleep(0.05)
        raise GraphvioError(f"web view: rerun does not serve on {_HOST}:{port}; does  rerun --serve-web  work here?")


def open_window() -> None:
    """Open rerun's window, unless one is open, and wait until it answers.

    Raises:
        RuntimeError: if it does not answer, as without a usable display.
        OSError: if rerun cannot be executed.
    """
    if not _answers(_WINDOW_PORT):
        subprocess.run(
            [*window_command(_WINDOW_PORT), "--detach-process"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the odometry
            check=False,
            env=os.environ | {"RERUN_APP_ONLY": "true"},
        )
    start = time.monotonic()
    while (waited := time.monotonic() - start) < _WINDOW_S:
        time.sleep(0.1)
        if _answers(_WINDOW_PORT) and waited > _SURE_S:  # without a usable display it ends at once
            return
    raise RuntimeError("rerun's window does not answer; is the display usable? --save-rrd FILE needs none")


def window_command(port: int) -> list[str]:
    """Return the command that opens a window, which receives data on a port of this machine only."""
    return [
        *(*_rerun_program(), "--bind", _HOST, "--port", str(port), "--expect-data-soon"),
        *("--memory-limit", "75%", "--server-memory-limit", "1GiB"),
    ]


def _rerun_program() -> list[str]:
    """Return the beginning of a command that runs rerun: its program, or if it is not found, its Python launcher.

    The program is preferred, since the launcher would end before it.
    """
    package = find_spec("rerun_cli")
    program = None if package is None or package.origin is None else Path(package.origin).with_name("rerun")
    return [str(program)] if program is not None and program.is_file() else [sys.executable, "-m", "rerun_cli"]


def _answers(port: int) -> bool:
    with suppress(OSError), socket.create_connection((_HOST, port), timeout=1.0):
        return True
    return False


def _check_free(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a port that was just closed is free
        try:
            probe.bind((_HOST, port))
        except OSError as error:
            raise GraphvioError(
                f"web view: port {port} of {_HOST} cannot be used ({error.strerror}); choose another one"
            ) from None
