"""Options of the program itself."""

import json
import os
import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from command_line import graphvio

from graphvio.cli.doctor import REQUIRED
from graphvio.rig_files import save_rig
from graphvio.simulation import default_rig
from graphvio.version import __version__


def test_version() -> None:
    ran = graphvio("--version")
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, f"graphvio {__version__}\n", "")


def test_no_command_shows_the_help() -> None:
    ran = graphvio()
    assert ran.returncode == 2
    assert "calibrate-trajectories" in ran.stdout + ran.stderr


@pytest.mark.parametrize(
    ("typed", "hint"),
    [
        (["run"], "graphvio run --help"),
        (["fleet", "optimize", "walk"], "graphvio fleet optimize --help"),
        (["nothing"], "graphvio --help"),
    ],
)
def test_a_wrong_command_line_names_the_help_of_its_command(typed: list[str], hint: str) -> None:
    ran = graphvio(*typed)
    assert ran.returncode == 2
    assert ran.stderr.count("\n") == 1
    assert f"({hint}" in ran.stderr


@pytest.mark.parametrize(
    ("typed", "found"),
    [
        ("graphvio cal", {"calibrate", "calibrate-trajectories"}),
        ("graphvio run --cam", {"--cameras"}),
        ("graphvio run --config ", {"default", "fast", "paper"}),
        ("graphvio benchmark ", {"euroc", "tum-vi", "uzh-fpv", "kitti", "hilti-2022", "monado"}),
        ("graphvio simulate c", {"calibration", "corridor"}),
        ("graphvio simulate --rig st", {"stereo", "stereo+back"}),
        ("graphvio simulate --calibration-component imu-", {"imu-scale", "imu-misalignment", "imu-noise"}),
        ("graphvio simulate --rig-change ", {"thermal", "knock"}),
        ("graphvio calibrate --what ", {"pairs", "stereo", "cameras", "imu", "all"}),
        ("graphvio calibrate --scale ", {"auto", "estimate", "fixed"}),
        ("graphvio convert --format ros", {"rosbag1", "rosbag2"}),
        ("graphvio live r", {"realsense", "ros2", "replay"}),
        ("graphvio serve v", {"v4l2"}),
    ],
)
def test_the_shell_completes(typed: str, found: set[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in completing(typed).items():
        monkeypatch.setenv(name, value)
    ran = graphvio()
    assert set(ran.stdout.split()) == found, ran.stderr


def completing(typed: str) -> dict[str, str]:
    """What a shell sets where it asks for completions."""
    return {"_GRAPHVIO_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": str(typed.count(" "))}


def test_the_shell_completes_by_a_process_of_its_own() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "graphvio"],
        env=os.environ | completing("graphvio cal"),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert set(done.stdout.split()) == {"calibrate", "calibrate-trajectories"}, done.stderr


def _without_matplotlib(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    code = "import sys; sys.modules['matplotlib'] = None; from graphvio.cli import main; main()"
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=60, check=False)


@pytest.mark.parametrize("command", ["optimize", "run"])
def test_a_missing_package_is_named_before_anything_is_done(command: str, tmp_path: Path) -> None:
    done = _without_matplotlib(command, "walk", folder=tmp_path)
    assert done.returncode == 2
    assert done.stderr == (
        "graphvio: needs matplotlib, which this Python lacks: install with  pip install matplotlib\n"
    )


def test_doctor_runs_without_a_package_and_shows_it(tmp_path: Path) -> None:
    done = _without_matplotlib("doctor", "--json", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    versions = json.loads(done.stdout)["versions"]
    assert versions["matplotlib"] is None
    assert all(version for name, version in versions.items() if name != "matplotlib")


def test_required_packages_are_those_of_the_project() -> None:
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    names = {re.split("[<>=]", each)[0] for each in project["dependencies"]}
    assert set(REQUIRED.values()) == names - {"typer"}  # without which there is no command line


@pytest.mark.parametrize("value", ["-1", "nan"])
@pytest.mark.parametrize(
    ("command", "option"),
    [
        ("run", "--from"),
        ("run", "--to"),
        ("record --out a.mcap", "--from"),
        ("convert --out a.mcap", "--to"),
        ("calibrate", "--from"),
        ("optimize --out a", "--to"),
        ("fleet optimize --out a", "--from"),
        ("benchmark euroc", "--to"),
        ("live", "--for"),
        ("serve", "--for"),
        ("slam", "--for"),
        ("evaluate truth", "--max-gap"),
        ("compare", "--max-ate"),
        ("simulate --out a", "--duration"),
        ("simulate --out a", "--rate"),
        ("simulate --out a", "--trigger-offset-ms"),
    ],
)
def test_an_impossible_number_is_refused(command: str, option: str, value: str, tmp_path: Path) -> None:
    ran = graphvio(*command.split(), "room" if "simulate" in command else "walk", option, value, folder=tmp_path)
    assert ran.returncode == 2
    assert ran.stderr.count("\n") == 1
    assert value in ran.stderr
    assert option.strip("-").split("-")[0] in ran.stderr
    assert list(tmp_path.iterdir()) == []


CAMERA = {
    "camera_model": "pinhole",
    "intrinsics": [400.0, 400.0, 320.0, 240.0],
    "distortion_model": "none",
    "distortion_coeffs": [],
    "resolution": [640, 480],
    "T_cam_imu": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
}


WRONG = """\
run nothing.txt
run .
run empty
run room
run walk --topics imu=/imu
run walk --rig camchain.yaml
run walk --rig rig.yaml
run walk --config config.yaml
run walk --config quick
run walk --cameras 9
run walk --from 1000
live webcam
live v4l2:?colour=1
live replay:walk?speed=fast
rig nothing.txt
compare walk walk
evaluate walk walk
simulate hall --out a
simulate room --out a --rig truck
simulate room --out a --rig named.yaml
simulate room --out a --calibration-error 9
simulate room --out a --rig-change fall
simulate room --out a --calibration-error 1 --calibration-component lens
calibrate walk --what lens
convert walk --out a --format avi
benchmark moon .
optimize walk --out a --scale 2
"""


def test_refusals_are_short(room_walk: Path, tmp_path: Path) -> None:
    """What is wrong, where, and what to do, in a line that is read at a glance."""
    rig = "graphvio_rig: 1\nimu: {time_offset_s: 0.0}\npairs: []"
    camchain = yaml.safe_dump({f"cam{k}": CAMERA for k in (0, 1)})
    files = {"camchain.yaml": camchain, "rig.yaml": rig, "nothing.txt": "", "config.yaml": "motion: {colour: 1}"}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    named = default_rig().with_cameras(lambda camera: replace(camera, name=f"{camera.name}-links"))
    save_rig(named, tmp_path / "named.yaml")
    (tmp_path / "empty").mkdir()
    (tmp_path / "walk").symlink_to(room_walk)
    for typed in WRONG.splitlines():
        ran = graphvio(*typed.split(), folder=tmp_path)
        assert ran.returncode == 2, typed
        assert ran.stderr.count("\n") == 1, typed
        assert len(ran.stderr) <= 300, f"{typed}: {ran.stderr}"
