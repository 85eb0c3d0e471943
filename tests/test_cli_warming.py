"""The bar that a command shows in a terminal while kernels are compiled."""

import os
import pty
import select
import shutil
import subprocess
import sys
from pathlib import Path

from graphvio.kernel_cache import cache_root


def read_terminal(terminal: int, process: subprocess.Popen[bytes]) -> bytes:
    """What a process writes to a terminal until it ends."""
    text = b""
    while process.poll() is None or select.select([terminal], [], [], 0.1)[0]:
        try:
            text += os.read(terminal, 65536)
        except OSError:  # the other side is closed
            break
    return text


def test_warmup_in_a_terminal_shows_a_bar_while_it_compiles(tmp_path: Path) -> None:
    shutil.copytree(cache_root(), tmp_path / "kernels")
    for folder in (tmp_path / "kernels").glob("graphvio.frontend.depth.prediction-*"):
        shutil.rmtree(folder)
    for expected in (True, False):  # the second time there is nothing to compile
        terminal, theirs = pty.openpty()
        process = subprocess.Popen(
            [sys.executable, "-m", "graphvio", "warmup"],
            env={**os.environ, "GRAPHVIO_CACHE_DIR": str(tmp_path / "kernels"), "TERM": "xterm"},
            stdout=subprocess.DEVNULL,
            stderr=theirs,
        )
        os.close(theirs)
        text = read_terminal(terminal, process)
        os.close(terminal)
        assert process.wait() == 0
        assert (b"kernels: " in text) == expected
