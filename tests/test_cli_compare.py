"""``graphvio compare``."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from graphvio.cli import app
from graphvio.geometry import se3, so3_exp
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import save_trajectory


def walk(error_m: float, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = []
    for k in range(200):
        at = np.array([0.05 * k, np.sin(0.05 * k), 0.0]) + error_m * rng.standard_normal(3)
        poses.append(se3(so3_exp(np.array([0.0, 0.0, 0.01 * k])), at))
    return Trajectory(np.arange(200) * 50_000_000, np.array(poses))


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    made = {}
    for name, error_m in (("truth", 0.0), ("good", 0.01), ("bad", 0.03)):
        made[name] = tmp_path / f"{name}.txt"
        save_trajectory(walk(error_m), made[name])
    folder = tmp_path / "walk-1"
    folder.mkdir()
    save_trajectory(walk(0.02), folder / "trajectory.txt")
    save_trajectory(walk(0.005), folder / "trajectory_smoothed.txt")
    made["folder"] = folder
    return made


def command(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["compare", *map(str, arguments)], env={"COLUMNS": "160"})


def test_compare_several_results_with_one_truth(files: dict[str, Path], tmp_path: Path) -> None:
    plot = tmp_path / "compared.png"
    done = command(files["good"], files["bad"], files["folder"], "--truth", files["truth"], "--plot", plot)
    assert done.exit_code == 0, done.output
    rows = {row.split("│")[1].strip(): row.split("│") for row in done.stdout.splitlines() if row.count("│") > 5}
    assert float(rows["good"][2]) == pytest.approx(0.01 * np.sqrt(3.0), rel=0.15)
    assert float(rows["bad"][3]) == pytest.approx(3.0, rel=0.05)
    assert float(rows["walk-1"][3]) == pytest.approx(2.0, rel=0.05)
    picture = cv2.imread(str(plot))
    assert picture is not None
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50


def test_compare_smoothed_uses_smoothed_poses(files: dict[str, Path]) -> None:
    done = command(files["good"], files["folder"], "--truth", files["truth"], "--smoothed")
    (row,) = [row.split("│") for row in done.stdout.splitlines() if "walk-1" in row]
    assert float(row[3]) == pytest.approx(0.5, rel=0.05)


def test_compare_without_truth_takes_the_first_as_reference(files: dict[str, Path]) -> None:
    done = command(files["truth"], files["good"])
    assert done.exit_code == 0
    assert "truth" not in done.stdout
    assert "good" in done.stdout


def test_compare_max_ate_names_results_above(files: dict[str, Path]) -> None:
    done = command(files["good"], files["bad"], "--truth", files["truth"], "--max-ate", "0.03")
    assert done.exit_code == 4
    assert "ATE above 0.03 m: bad" in done.stderr
    assert command(files["good"], "--truth", files["truth"], "--max-ate", "0.03").exit_code == 0


def test_compare_unmatched_result_is_reported_and_others_compared(files: dict[str, Path], tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere.txt"
    other = walk(0.01)
    save_trajectory(Trajectory(other.stamps_ns + 10**15, other.nav_T_body), elsewhere)
    done = command(elsewhere, files["good"], "--truth", files["truth"])
    assert done.exit_code == 4
    assert "elsewhere: " in done.stderr
    assert "good" in done.stdout


def test_compare_one_result_is_refused(files: dict[str, Path]) -> None:
    assert "nothing to compare" in str(command(files["good"]).exception)


def test_what_is_no_result_is_refused_with_what_is_accepted(files: dict[str, Path], room_walk: Path) -> None:
    given = r"give a result folder, a trajectory file \(TUM, EuRoC or KITTI\), or BAG:TOPIC$"
    for wrong, why in (
        (room_walk, r"is a recording, which can only be the truth \(.*--truth of compare\)"),
        (files["truth"].parent, r"holds no trajectory\.txt"),
    ):
        error = command(files["good"], wrong).exception
        assert re.fullmatch(f"{wrong}: {why}.*; .*{given}", str(error)), error
    error = command(files["good"], files["bad"], "--truth", files["folder"]).exception
    assert "is no recording; as the truth give a recording that has one, a trajectory file" in str(error)
