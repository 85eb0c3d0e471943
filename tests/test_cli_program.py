"""Options of the program itself."""

import os
import subprocess
import sys

import pytest
from command_line import graphvio

from graphvio.version import __version__


def test_version() -> None:
    ran = graphvio("--version")
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, f"graphvio {__version__}\n", "")


def test_no_command_shows_the_help() -> None:
    ran = graphvio()
    assert ran.returncode == 2
    assert "calibrate-trajectories" in ran.stdout + ran.stderr


@pytest.mark.parametrize(("typed", "found"), [("graphvio cal", "calibrate-trajectories"), ("graphvio ru", "run")])
def test_the_shell_completes_commands(typed: str, found: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "graphvio"],
        env=os.environ | {"_GRAPHVIO_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": "1"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert found in done.stdout.split(), done.stderr
