"""``graphvio calibrate-trajectories`` on files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from hand_eye import LEFT2_T_LEFT1
from test_calibration_trajectories import OFFSET_S, first, second, trajectory
from typer.testing import CliRunner, Result

from graphvio.cli import app
from graphvio.geometry import se3_exp, se3_inverse, se3_log
from graphvio.trajectory_files import load_trajectory, save_trajectory


def command(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["calibrate-trajectories", *map(str, arguments)], env={"COLUMNS": "160"})


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three cameras, the last one's file with commas and with lines written twice."""
    folder = tmp_path_factory.mktemp("trajectories")
    third = trajectory(3, 40.0, se3_exp(np.array([0.2, -0.5, 0.1, 0.3, 0.0, -0.2])), offset_s=-7.0)
    paths = [folder / name for name in ("front.txt", "back.txt", "side.csv")]
    save_trajectory(first(), paths[0])
    save_trajectory(second(offset_s=OFFSET_S), paths[1])
    save_trajectory(third, folder / "side.txt")
    lines = (folder / "side.txt").read_text().replace(" ", ", ").splitlines()
    paths[2].write_text("\n".join(line for i, line in enumerate(lines) for _ in range(1 + (i % 5 == 0))) + "\n")
    return paths


def test_command_three_cameras_writes_report(files: list[Path], tmp_path: Path) -> None:
    out, report = tmp_path / "numbers.yaml", tmp_path / "report"
    done = command(*files, "--out", out, "--report", report)
    assert done.exit_code == 0, done.output
    assert "around front, back, side: two at a time miss by" in done.stdout
    assert "front to back: add 123.45" in done.stdout
    assert "back to side: add -130.4" in done.stdout
    numbers = yaml.safe_load(out.read_text())
    found = np.array(numbers["left_T_left1"]["back"])
    off = se3_log(se3_inverse(found) @ LEFT2_T_LEFT1)
    assert np.linalg.norm(off[:3]) < 4e-3
    assert np.linalg.norm(off[3:]) < 0.01
    assert len(numbers["covariance"]) == 12
    assert [(each["first"], each["second"]) for each in numbers["two_at_a_time"]] == [
        ("front", "back"),
        ("front", "side"),
        ("back", "side"),
    ]
    page = (report / "report.html").read_text()
    for words in ("All cameras together", "Clocks", "back and side"):
        assert words in page
    assert len(list(report.glob("*.png"))) == 12


def test_command_nan_in_file_names_line(files: list[Path], tmp_path: Path) -> None:
    lines = files[0].read_text().splitlines()
    lines[99] = lines[99].replace(lines[99].split()[2], "nan")
    broken = tmp_path / "broken.txt"
    broken.write_text("\n".join(lines) + "\n")
    done = command(broken, files[1])
    assert done.exit_code != 0
    assert "broken.txt, line 100: holds NaN or infinity" in str(done.exception)


def test_command_short_trajectory_is_refused(files: list[Path], tmp_path: Path) -> None:
    piece = tmp_path / "piece.txt"
    save_trajectory(load_trajectory(files[0]).select(slice(0, 100)), piece)
    done = command(piece, files[1])
    assert "takes 5 s or more" in str(done.exception)
    assert done.exit_code != 0


def test_command_unwritable_output_is_refused(files: list[Path], tmp_path: Path) -> None:
    done = command(files[0], files[1], "--out", tmp_path / "missing" / "numbers.yaml")
    assert "name a file in a folder that exists" in str(done.exception)


def test_command_output_over_input_is_refused(files: list[Path], tmp_path: Path) -> None:
    copy = tmp_path / "front.yaml"
    copy.write_bytes(files[0].read_bytes())
    done = command(copy, files[1], "--out", copy)
    assert "is what is read; name another file" in str(done.exception)
    assert copy.read_bytes() == files[0].read_bytes()
