"""The command as it is typed: in this process, where kernels are loaded already, or in one of its own."""

from __future__ import annotations

import io
import subprocess
import sys
import traceback
from contextlib import chdir, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

from graphvio.cli import main

_SOON_S = 300.0


@dataclass(frozen=True)
class Ran:
    """How a command ended, and what it said."""

    returncode: int
    stdout: str
    stderr: str


def graphvio(*arguments: object, folder: Path = Path()) -> Ran:
    """Run a command in a folder."""
    out, err, code = io.StringIO(), io.StringIO(), 1
    typed = ["graphvio", *map(str, arguments)]
    with redirect_stdout(out), redirect_stderr(err), chdir(folder), patch.object(sys, "argv", typed):
        try:
            main()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        except Exception:  # as the interpreter does
            traceback.print_exc()
    return Ran(code, out.getvalue(), err.getvalue())


def graphvio_alone(*arguments: object, folder: Path = Path()) -> Ran:
    """Run a command in a folder, in a process of its own."""
    command = [sys.executable, "-c", "from graphvio.cli import main; main()", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=_SOON_S, check=False)
    return Ran(done.returncode, done.stdout, done.stderr)
