"""The examples run as they are typed."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


def _run(name: str, recording: Path) -> str:
    command = [sys.executable, str(EXAMPLES / name), str(recording)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_own_sensors(room_walk: Path) -> None:
    tracked = re.findall(r"^\d+ tracking (\S+) (\S+) (\S+) m$", _run("own_sensors.py", room_walk), re.MULTILINE)
    assert len(tracked) >= 60
    assert max(abs(float(x)) for x, _, _ in tracked) > 0.05


def test_evaluate_with_evo(room_walk: Path) -> None:
    own, evo = (float(value) for value in re.findall(r"ATE rmse (\S+) mm", _run("evaluate_with_evo.py", room_walk)))
    assert 0.0 < own < 5.0
    assert evo == pytest.approx(own, abs=0.2)


def test_slam_front_end(room_walk: Path) -> None:
    said = _run("slam_front_end.py", room_walk)
    assert said.count("keyframe ") >= 5
    odom, in_map = (
        [float(value) for value in found.split(",")]
        for found in re.findall(r"^(?:odom|map) \[(.*)\]$", said, re.MULTILINE)
    )
    assert in_map == pytest.approx([10.0 - odom[1], odom[0], odom[2]], abs=0.03)


def test_every_example_is_run_and_described() -> None:
    scripts = {file.name for file in EXAMPLES.glob("*.py")}
    assert scripts == set(re.findall(r"\]\((\w+\.py)\)", (EXAMPLES / "README.md").read_text()))
    assert scripts == set(re.findall(r'_run\("(\w+\.py)"', Path(__file__).read_text()))
