"""Commands and programs as they are typed: in this process, where kernels are loaded already, or in one of its own."""

from __future__ import annotations

import io
import runpy
import subprocess
import sys
import traceback
from collections.abc import Callable
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
    return _ran(main, ["graphvio", *map(str, arguments)], folder)


def python(file: Path, *arguments: object, folder: Path) -> Ran:
    """Run a program of Python in a folder."""
    return _ran(lambda: runpy.run_path(str(file), run_name="__main__"), [str(file), *map(str, arguments)], folder)


def _ran(call: Callable[[], object], typed: list[str], folder: Path) -> Ran:
    out, err, code = io.StringIO(), io.StringIO(), 0
    with redirect_stdout(out), redirect_stderr(err), chdir(folder), patch.object(sys, "argv", typed):
        try:
            call()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
            if isinstance(end.code, str):  # the interpreter prints it
                print(end.code, file=sys.stderr)
        except Exception:  # as the interpreter does
            traceback.print_exc()
            code = 1
    return Ran(code, out.getvalue(), err.getvalue())


def python_alone(file: Path, *arguments: object, folder: Path = Path()) -> Ran:
    """Run a program of Python in a folder, in a process of its own."""
    command = [sys.executable, str(file), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=_SOON_S, check=False)
    return Ran(done.returncode, done.stdout, done.stderr)
