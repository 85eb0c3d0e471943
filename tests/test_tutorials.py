"""The tutorials are followed as they are typed, on short recordings; of all pages the commands' options exist."""

import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import typer
from calibration_walks import recorded
from command_line import graphvio, python
from pages import PAGES, ROOT, python_blocks, typed

from graphvio.cli import app

TUTORIALS = ROOT / "docs/tutorials"
PROGRAM = typer.main.get_command(app)


def follow(name: str, recording: Path, folder: Path) -> str:
    """Run all commands and the Python of a tutorial in a folder; what it simulates is there already."""
    text = (TUTORIALS / f"{name}.md").read_text()
    shutil.copytree(recording, folder / "walk")
    for arguments in typed(text):
        if arguments[0] != "simulate":
            ran = graphvio(*arguments, folder=folder)
            assert ran.returncode == 0, f"{arguments}: {ran.stderr}"
    if "```python" not in text:
        return ""
    (block,) = python_blocks(text)
    (folder / "typed.py").write_text(block)
    done = python(folder / "typed.py", folder=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.usefixtures("without_plots")
def test_first_trajectory_as_typed(room_walk: Path, tmp_path: Path) -> None:
    printed = follow("first-trajectory", room_walk, tmp_path)
    assert printed.count("tracking") >= 95
    text = (TUTORIALS / "first-trajectory.md").read_text()
    for name in re.findall(r"^\| `([\w.-]+)` \|", text, re.MULTILINE):
        assert (tmp_path / "result" / name).exists(), name
    assert (tmp_path / "error.png").exists()


@pytest.mark.usefixtures("without_plots")
def test_calibrate_your_rig_as_typed(tmp_path: Path) -> None:
    follow("calibrate-your-rig", recorded(tmp_path / "turns", 4.0), tmp_path)
    for name in ("rig-pairs.yaml", "pairs/report.html", "rig-calibrated.yaml", "all/report.html"):
        assert (tmp_path / name).exists(), name


@pytest.mark.usefixtures("without_plots")
def test_before_your_slam_as_typed(room_walk: Path, tmp_path: Path) -> None:
    printed = follow("before-your-slam", room_walk, tmp_path)
    assert "accepted" in printed
    odom, in_map = (
        [float(value) for value in found.split()]
        for found in re.findall(r"^(?:odom|map ) \[(.*)\]$", printed, re.MULTILINE)
    )
    assert in_map == pytest.approx([10.0 - odom[1], odom[0], odom[2]], abs=0.05)


@pytest.mark.usefixtures("without_plots")
def test_session_to_colmap_as_typed(room_walk: Path, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    printed = follow("session-to-colmap", room_walk, tmp_path)
    frames, images, points = map(int, re.findall(r"(\d+) frames, (\d+) images, (\d+) points", printed)[0])
    assert images == 4 * frames > 0
    assert points > 100


def documented() -> list[tuple[str, list[str]]]:
    """Return (page, arguments) of each command in the documentation."""
    return [
        (str(page.relative_to(ROOT)), arguments)
        for page in PAGES
        if page.name != "commands.md"
        for arguments in typed(page.read_text())
        if arguments
    ]


def test_every_command_in_the_documentation_has_its_options() -> None:
    found = documented()
    assert len(found) > 60
    for page, arguments in found:
        command: Any = PROGRAM
        while arguments and arguments[0] in getattr(command, "commands", {}):
            command = command.commands[arguments.pop(0)]
        options = {option for param in command.params for option in (*param.opts, *param.secondary_opts)}
        options |= {"--help", "--install-completion", "--show-completion"}
        for argument in arguments:
            if argument.startswith("--"):
                assert argument.split("=")[0] in options, f"{page}: {command.name} has no {argument}"
