"""Opens rerun's window as a process of its own, which stays when this one ends.

By rerun's own function (0.41) the window would listen on all addresses, without a password.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import time

from graphvio.viewer.web import HOST, rerun_program

_PORT = 9876
_START_S, _SURE_S = 8.0, 1.0
URL = f"rerun+http://{HOST}:{_PORT}/proxy"
"""Address of the window's data."""


def open_window() -> None:
    """Open a window, unless one is open, and wait until it answers.

    Raises:
        RuntimeError: if it does not, as without a usable display.
        OSError: if rerun cannot be executed.
    """
    if not _answers():
        subprocess.run(
            [*window_command(_PORT), "--detach-process"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the odometry
            check=False,
            env=os.environ | {"RERUN_APP_ONLY": "true"},
        )
    start = time.monotonic()
    while (waited := time.monotonic() - start) < _START_S:
        time.sleep(0.1)
        if _answers() and waited > _SURE_S:  # without a usable display it ends at once
            return
    raise RuntimeError("rerun's window does not answer; is the display usable? --save-rrd FILE needs none")


def window_command(port: int) -> list[str]:
    """Return the command of a window that takes data on a port of this machine only."""
    return [
        *(*rerun_program(), "--bind", HOST, "--port", str(port), "--expect-data-soon"),
        *("--memory-limit", "75%", "--server-memory-limit", "1GiB"),
    ]


def _answers() -> bool:
    with contextlib.suppress(OSError), socket.create_connection((HOST, _PORT), timeout=1.0):
        return True
    return False
