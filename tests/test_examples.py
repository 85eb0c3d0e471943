"""The examples run as they are typed."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
import undrawn_run
from calibration_walks import recorded
from command_line import python

from graphvio import load_trajectory, open_source

EXAMPLES = Path(__file__).parents[1] / "examples"


def _run(name: str, *arguments: object, folder: Path) -> str:
    """Run a program of the examples in a folder, and return what it prints."""
    done = python(EXAMPLES / name, *arguments, folder=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


def _run_alone(module: str, *arguments: object, folder: Path, search: Path) -> None:
    """Run a module in a process of its own that finds what is installed in a folder."""
    environment = dict(os.environ) | {"PYTHONPATH": os.pathsep.join([str(search), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-m", module, *map(str, arguments)]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=400, check=False
    )
    assert done.returncode == 0, done.stderr


def _numbers(pattern: str, text: str) -> list[float]:
    found = re.search(pattern, text)
    assert found, text
    return [float(each) for each in found.groups()]


def test_own_sensors(room_walk: Path, tmp_path: Path) -> None:
    tracked = re.findall(
        r"^\d+ tracking (\S+) (\S+) (\S+) m$", _run("own_sensors.py", room_walk, folder=tmp_path), re.MULTILINE
    )
    assert len(tracked) >= 60
    assert max(abs(float(x)) for x, _, _ in tracked) > 0.05


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.py")), ids=lambda file: file.stem)
def test_an_example_without_arguments_says_what_it_takes(file: Path, tmp_path: Path) -> None:
    done = python(file, folder=tmp_path)
    assert done.returncode == 1
    assert file.name in done.stderr
    assert "Traceback" not in done.stderr


def test_notebook_runs_from_top_to_bottom(room_walk: Path, tmp_path: Path) -> None:
    """Its cells of code in one process, as a kernel runs them; the recording is there already."""
    notebook = json.loads((EXAMPLES / "first_look.ipynb").read_text())
    assert (notebook["nbformat"], notebook["metadata"]["kernelspec"]["language"]) == (4, "python")
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(not cell["outputs"] for cell in notebook["cells"] if cell["cell_type"] == "code")
    (tmp_path / "first_look.py").write_text("\n\n".join(cells))
    (tmp_path / "room").symlink_to(room_walk)
    said = _run(str(tmp_path / "first_look.py"), folder=tmp_path)
    assert "100 estimates, 100 with a pose; the last one is tracking" in said
    (path_m, ate_mm) = _numbers(r"path (\S+) m, ATE rmse (\S+) mm", said)
    assert path_m > 0.5
    assert ate_mm < 5.0
    plot = cv2.imread(str(tmp_path / "first_look.png"))
    assert plot is not None
    assert plot.shape[0] > 200


def test_evaluate_with_evo(room_walk: Path, tmp_path: Path) -> None:
    own, evo = (
        float(value)
        for value in re.findall(r"ATE rmse (\S+) mm", _run("evaluate_with_evo.py", room_walk, folder=tmp_path))
    )
    assert 0.0 < own < 5.0
    assert evo == pytest.approx(own, abs=0.2)


def test_slam_front_end(room_walk: Path, tmp_path: Path) -> None:
    said = _run("slam_front_end.py", room_walk, folder=tmp_path)
    assert said.count("keyframe ") >= 5
    odom, in_map = (
        [float(value) for value in found.split(",")]
        for found in re.findall(r"^(?:odom|map) \[(.*)\]$", said, re.MULTILINE)
    )
    assert in_map == pytest.approx([10.0 - odom[1], odom[0], odom[2]], abs=0.03)


def test_slam_client(room_walk: Path, tmp_path: Path) -> None:
    """Of a service in another process, which replays the walk at its own pace."""
    pytest.importorskip("grpc", reason="grpcio is not installed: the extra serve")
    command = [sys.executable, "-m", "graphvio", "serve", str(room_walk), "--port", "0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as service:
        try:
            assert service.stderr is not None
            address = next(line for line in service.stderr if line.startswith("gRPC: ")).removeprefix("gRPC: ").strip()
            said = _run("slam_client.py", address, folder=tmp_path)
            assert service.wait(60.0) == 0
        finally:
            service.kill()
    assert said.splitlines()[:2] == ["pairs ['front', 'back']", "corrected"]
    ends = re.findall(r"^keyframe \d+ at (\S+) (\S+) (\S+) m, \d+ landmarks$", said, re.MULTILINE)
    assert ends[0] == ("10.00", "0.00", "0.00")
    in_map = load_trajectory(tmp_path / "map.txt")
    assert len(in_map) == len(ends) >= 5
    truth, _ = load_trajectory(room_walk / "mav0/state_groundtruth_estimate0/data.csv").at(in_map.stamps_ns, 0.1)
    moved = np.linalg.inv(in_map.nav_T_body[0]) @ in_map.nav_T_body[-1]
    np.testing.assert_allclose(moved, np.linalg.inv(truth.nav_T_body[0]) @ truth.nav_T_body[-1], atol=0.02)


def test_slam_client_without_a_service_ends_with_one_line(tmp_path: Path) -> None:
    pytest.importorskip("grpc", reason="grpcio is not installed: the extra serve")
    done = python(EXAMPLES / "slam_client.py", "127.0.0.1:9", folder=tmp_path)
    assert done.returncode == 1
    assert not (tmp_path / "map.txt").exists()


def test_every_example_is_run_and_described() -> None:
    scripts = {file.name for file in EXAMPLES.glob("*.py")}
    assert scripts == set(re.findall(r"\]\((\w+\.py)\)", (EXAMPLES / "README.md").read_text()))
    assert scripts == set(re.findall(r'_run\("(\w+\.py)"', Path(__file__).read_text()))


def test_plot_while_running(room_walk: Path, tmp_path: Path) -> None:
    source = f"simulator:room?recording={room_walk}&legs=1"
    printed = _run("plot_while_running.py", "path.png", source, folder=tmp_path)
    plots, poses = _numbers(r"(\d+) plots, the last with (\d+) poses", printed)
    assert plots >= 5  # replaced on the way: the walk lasts 5 s
    assert poses > 50
    picture = cv2.imread(str(tmp_path / "path.png"))
    assert picture is not None
    assert np.std(picture) > 10
    assert [file.name for file in tmp_path.iterdir()] == ["path.png"]


def test_calibrate_two_odometries(tmp_path: Path) -> None:
    turns = recorded(tmp_path / "turns", 8.0)
    printed = _run("calibrate_two_odometries.py", turns, folder=tmp_path)
    (ahead,) = _numbers(r"clock is ([\d.]+) s ahead", printed)
    assert ahead == pytest.approx(12.345, abs=2e-3)
    angle_deg, distance_mm = _numbers(r"rig file: ([\d.]+) deg, ([\d.]+) mm", printed)
    assert angle_deg < 0.3
    assert distance_mm < 20.0


@pytest.mark.usefixtures("without_plots")
def test_batch_to_colmap(room_walk: Path, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap", reason="pycolmap is not installed: the extra maps")
    printed = _run("batch_to_colmap.py", room_walk, "optimized", folder=tmp_path)
    frames, images, points = _numbers(r"(\d+) frames, (\d+) images, (\d+) points", printed)
    assert images == 4 * frames
    assert points > 100
    assert _numbers(r"error: ([\d.]+) px", printed) < [2.0]


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A folder with the plug-in and its metadata, as pip leaves them; scripts/check_wheel uses pip."""
    package = EXAMPLES / "custom_source"
    project = tomllib.loads((package / "pyproject.toml").read_text())["project"]
    site = tmp_path / "site"
    metadata = site / f"graphvio_npz-{project['version']}.dist-info"
    metadata.mkdir(parents=True)
    shutil.copy(package / "graphvio_npz.py", site)
    (metadata / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    points = project["entry-points"]["graphvio.sources"]
    lines = [f"{name} = {value}\n" for name, value in points.items()]
    (metadata / "entry_points.txt").write_text("".join(["[graphvio.sources]\n", *lines]))
    return site


def test_custom_source(room_walk: Path, installed: Path, tmp_path: Path) -> None:
    _run_alone("write_npz", room_walk, "room-npz", folder=tmp_path, search=EXAMPLES / "custom_source")
    assert len(list((tmp_path / "room-npz/frames").glob("*.npz"))) == 100
    shutil.copy(undrawn_run.__file__, installed)
    _run_alone("undrawn_run", "run", "room-npz", "--out", "results", "--to", "2", folder=tmp_path, search=installed)
    poses = load_trajectory(tmp_path / "results/trajectory.txt")
    truth = open_source(room_walk)
    assert len(poses) == 41
    assert poses.stamps_ns[0] == truth.start_ns
