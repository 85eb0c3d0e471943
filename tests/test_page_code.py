"""The code of the how-to and reference pages runs as it is typed, on short recordings in place of the reader's.

Tutorials, the README and two more pages are run by `test_tutorials`, `test_docs` and `test_slam_docs`; a test finds
for code that none of them runs.
"""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import served
from calibration_walks import recorded
from command_line import Ran, graphvio, python
from other_systems import write_openvins, write_orb_slam3, write_vins_fusion
from pages import PAGES, ROOT, python_blocks, typed
from rendered import copy_part
from ros2_loopback import URI, free_domain

from graphvio import Trajectory, load_rig, load_trajectory, save_trajectory

ELSEWHERE = {
    "README.md": "test_docs",
    "docs/how-to/self-calibration.md": "test_docs",
    "docs/tutorials/first-trajectory.md": "test_tutorials",
    "docs/tutorials/before-your-slam.md": "test_tutorials",
    "docs/tutorials/calibrate-your-rig.md": "test_tutorials",
    "docs/tutorials/session-to-colmap.md": "test_tutorials",
}
HERE = (
    "docs/how-to/calibration.md",
    "docs/how-to/fleet.md",
    "docs/how-to/live.md",
    "docs/how-to/optimization.md",
    "docs/how-to/other-systems.md",
    "docs/how-to/public-data-sets.md",
    "docs/how-to/sensors/ros2.md",
    "docs/how-to/single-cameras.md",
    "docs/how-to/slam-interface.md",
    "docs/how-to/slam.md",
    "docs/reference/data-contract.md",
    "docs/reference/results.md",
    "docs/reference/simulation.md",
    "docs/tutorials/two-realsense.md",
)
NEED = {
    r"realsense|oak|v4l2|--list": "sensors",
    r"^calibrate walk\.mcap": "a recording of such a sensor; test_two_realsense has the command with another one",
    r"tcp://": "a scheduler: test_fleet_s3 has one",
    r"--host 0\.0\.0\.0": "certificates: test_slam_security makes them",
    r"^simulate corridor": "minutes of rendering; the walk is in the corridor's place",
    r"^benchmark kitti": "a data set: test_benchmark writes one",
    r"--install-completion": "the user's own shell",
    r"^fleet optimize RECORDINGS": "minutes: test_fleet runs it",
}
"""What keeps commands from being run here."""


def commands_of(page: str) -> list[list[str]]:
    """The commands of a page that need nothing else."""
    found = typed((ROOT / page).read_text())
    return [arguments for arguments in found if not any(re.search(each, " ".join(arguments)) for each in NEED)]


def run_commands(
    page: str, folder: Path, more: Callable[[list[str]], list[str]] = lambda arguments: arguments
) -> list[Ran]:
    """Run the commands of a page in a folder, each with ``more`` of what a test needs; none may fail."""
    every = []
    for arguments in commands_of(page):
        every.append(graphvio(*more(arguments), folder=folder))
        assert every[-1].returncode == 0, f"{arguments}: {every[-1].stderr}"
    return every


def run_python(page: str, folder: Path, before: str = "") -> str:
    """Run all Python of a page as one program in a folder, after what the page takes for granted."""
    blocks = python_blocks((ROOT / page).read_text())
    assert blocks
    (folder / "typed.py").write_text("\n".join([before, *blocks]))
    done = python(folder / "typed.py", folder=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def session(room_walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two seconds of the walk: as a folder and as a session."""
    folder = tmp_path_factory.mktemp("typed")
    copy_part(room_walk, folder / "walk", 2.0)
    assert graphvio("convert", folder / "walk", "--out", folder / "walk.mcap").returncode == 0
    return folder


def test_all_code_is_run_somewhere() -> None:
    names = [str(page.relative_to(ROOT)) for page in PAGES if page.name != "commands.md"]
    with_code = {name for name in names if python_blocks((ROOT / name).read_text()) or commands_of(name)}
    assert with_code == {*ELSEWHERE, *HERE}
    for name, test in ELSEWHERE.items():
        assert Path(name).stem.replace("README", "README.md") in (ROOT / f"tests/{test}.py").read_text()
    own = Path(__file__).read_text()
    assert all(own.count(f'"{name}"') > 1 for name in HERE)


def test_python_is_in_blocks_of_its_own() -> None:
    """Where it is run, and coloured."""
    for page in PAGES:
        text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
        assert re.findall(r"^ {4}(?:import \w+|from \S+ import |with \w+\().*$", text, re.MULTILINE) == [], page


@pytest.mark.usefixtures("without_plots")
def test_calibration(tmp_path: Path) -> None:
    recorded(tmp_path / "recording", 5.3)
    (tmp_path / "RECORDING").symlink_to("recording")
    truth = load_trajectory(tmp_path / "recording/mav0/state_groundtruth_estimate0/data.csv")
    for name, pair in zip(("FRONT.txt", "BACK.txt"), load_rig(tmp_path / "recording").pairs, strict=True):
        save_trajectory(Trajectory(truth.stamps_ns, truth.nav_T_body @ pair.left.body_T_cam), tmp_path / name)

    def apart(arguments: list[str]) -> list[str]:  # the page has the same name for two ways to calibrate a rig
        is_whole = "--what" in arguments
        names = {"calibration": "whole", "rig-calibrated.yaml": "whole.yaml"} if is_whole else {}
        return [names.get(each, each) for each in arguments]

    run_commands("docs/how-to/calibration.md", tmp_path, apart)
    run_python("docs/how-to/calibration.md", tmp_path)
    for name in ("rig-calibrated.yaml", "calibration/report.html", "whole/report.html", "cameras/report.html"):
        assert (tmp_path / name).exists(), name
    assert load_rig(tmp_path / "rig-from-pairs.yaml").imu is not None
    (pair,) = load_rig(tmp_path / "front.yaml").pairs
    np.testing.assert_allclose(pair.right.body_T_cam[:3, 3], [0.11, 0.0, 0.0])  # right of the left one


@pytest.mark.usefixtures("without_plots")
def test_other_systems(session: Path, tmp_path: Path) -> None:
    (tmp_path / "MH_01_easy").symlink_to(session / "walk")
    rig = load_rig(tmp_path / "MH_01_easy").with_pairs([0])
    write_openvins(tmp_path, rig, {})
    write_vins_fusion(tmp_path, rig).rename(tmp_path / "euroc_stereo_imu_config.yaml")
    write_orb_slam3(tmp_path, rig)
    truth = load_trajectory(tmp_path / "MH_01_easy/mav0/state_groundtruth_estimate0/data.csv")
    save_trajectory(truth, tmp_path / "traj_estimate.txt")
    lines = [line.split() for line in (tmp_path / "traj_estimate.txt").read_text().splitlines()]
    (tmp_path / "output").mkdir()
    in_ns = zip(truth.stamps_ns.tolist(), lines, strict=True)
    orb_slam3, vins_fusion = [], []
    for stamp_ns, (_, x, y, z, *xyz, w) in in_ns:
        orb_slam3.append(" ".join([f"{stamp_ns}.000000", x, y, z, *xyz, w]))
        vins_fusion.append(",".join([str(stamp_ns), x, y, z, w, *xyz, "0.0", "0.0", "0.0", ""]))
    (tmp_path / "f_dataset-MH01_stereoi.txt").write_text("\n".join(orb_slam3))
    (tmp_path / "output/vio.csv").write_text("\n".join(vins_fusion))
    run_commands("docs/how-to/other-systems.md", tmp_path)
    assert len(load_rig(tmp_path / "rig.yaml").pairs) == 1
    assert len(load_trajectory(tmp_path / "results/mh01/trajectory.txt")) > 30


@pytest.mark.usefixtures("without_plots")
def test_optimization(room_walk: Path, session: Path, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    copy_part(room_walk, tmp_path / "RECORDING", 3.5)  # one camera by itself needs its time to know the scale
    for name in ("MONDAY", "TUESDAY"):
        shutil.copy(session / "walk.mcap", tmp_path / f"{name}.mcap")
    run_commands("docs/how-to/optimization.md", tmp_path)
    run_python("docs/how-to/optimization.md", tmp_path)
    for name in ("walk-optimized", "both", "optimized"):
        assert (tmp_path / name / "report.html").exists(), name


@pytest.mark.usefixtures("without_plots")
def test_fleet(session: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    (tmp_path / "list.txt").write_text(f"# a comment\n{session / 'walk'}\n")
    (tmp_path / "my.yaml").write_text("smoother: {lag_s: 2.0}\n")
    shutil.copy(session / "walk/rig.yaml", tmp_path)
    run_commands("docs/how-to/fleet.md", tmp_path, with_one_worker)
    assert len((tmp_path / "RESULTS/summary.csv").read_text().splitlines()) == 2


def with_one_worker(arguments: list[str]) -> list[str]:
    """Take one worker for the page's four: there is one session."""
    if "--workers" not in arguments:
        return arguments
    at = arguments.index("--workers") + 1
    return [*arguments[:at], "1", *arguments[at + 1 :]]


@pytest.mark.usefixtures("without_plots")
def test_public_data_sets(session: Path, tmp_path: Path) -> None:
    (tmp_path / "EuRoC").mkdir()
    (tmp_path / "EuRoC/MH_01_easy").symlink_to(session / "walk")
    run_commands("docs/how-to/public-data-sets.md", tmp_path)
    assert "MH_01" in next((tmp_path / "results").rglob("report.html")).read_text()


@pytest.mark.usefixtures("without_plots")
def test_single_cameras(stereo_and_back_walk: Path, tmp_path: Path) -> None:
    copy_part(stereo_and_back_walk, tmp_path / "walk", 3.5)
    (tmp_path / "MH_01_easy").symlink_to("walk")
    run_commands("docs/how-to/single-cameras.md", tmp_path, for_a_second)
    both, same = (load_trajectory(tmp_path / name / "trajectory.txt") for name in ("both", "the-same-as-both"))
    assert len(both) == len(same) == 70
    assert (tmp_path / "one-camera/summary.json").exists()


def for_a_second(arguments: list[str]) -> list[str]:
    """Let a live command end, with no more of a scene than that, and take any port."""
    if arguments[0] not in ("live", "slam", "serve"):
        return arguments
    if arguments[1].startswith("simulator"):
        arguments = [arguments[0], f"{arguments[1]}{'&' if '?' in arguments[1] else '?'}duration_s=2", *arguments[2:]]
    return [*arguments, "--for", "1"] + (["--health-port", "0"] if "--health-port" in arguments else [])


def test_live(session: Path, tmp_path: Path) -> None:
    shutil.copy(session / "walk.mcap", tmp_path)
    for ran in run_commands("docs/how-to/live.md", tmp_path, for_a_second):
        assert re.search(r"^[1-9]\d* estimates of", ran.stdout, re.MULTILINE)


@pytest.mark.usefixtures("without_plots")
def test_two_realsense(session: Path, tmp_path: Path) -> None:
    """The commands after the cameras have recorded."""
    shutil.copy(session / "walk.mcap", tmp_path)
    turns = recorded(tmp_path / "turns", 4.0)
    assert graphvio("convert", turns, "--out", tmp_path / "turns.mcap").returncode == 0
    run_commands("docs/tutorials/two-realsense.md", tmp_path)
    assert (tmp_path / "calibration/report.html").exists()


FAST = "replay:walk.mcap?speed=2&to_s=3"  # less to wait for than for a sensor


def test_slam(room_walk: Path, tmp_path: Path) -> None:
    """The commands with a recording in the sensor's place, and the Python on the map that they made."""
    pytest.importorskip("pycolmap")
    pytest.importorskip("grpc")
    pytest.importorskip("rerun")
    assert graphvio("convert", room_walk, "--out", tmp_path / "walk.mcap").returncode == 0
    for arguments in typed((ROOT / "docs/how-to/slam.md").read_text()):
        fast = [FAST if each in ("realsense", "oak", "replay:walk.mcap") else each for each in arguments]
        ran = graphvio(*fast, folder=tmp_path)
        assert ran.returncode == 0, f"{arguments}: {ran.stderr}"
    before = """
import graphvio
from graphvio.slam import FrontEnd

source = graphvio.open_source("walk.mcap")
config = graphvio.Config.from_yaml("keyframes: {images: true}")
odometry = graphvio.Odometry(source.rig, config)
front_end = FrontEnd(odometry)
keyframes = front_end.keyframes()
for measurement in source:
    odometry.process(measurement)
odometry.finish()
"""
    run_python("docs/how-to/slam.md", tmp_path, before)
    assert len(load_trajectory(tmp_path / "map_trajectory.txt")) >= 5
    assert (tmp_path / "walk.rrd").exists()
    for name in ("office", "workshop"):
        assert json.loads((tmp_path / name / "map.json").read_text())["places"] > 0, name


SERVED = f"""
import sys
import numpy as np
sys.path.insert(0, {str(Path(served.__file__).parent)!r})
from served import SyntheticOdometry
served, base_T_body = SyntheticOdometry(), np.eye(4)
"""


def test_ros2(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cyclonedds")
    monkeypatch.setenv("CYCLONEDDS_URI", URI)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_domain()))
    assert not run_python("docs/how-to/sensors/ros2.md", tmp_path, SERVED)  # it publishes, and prints nothing


def test_server_of_the_slam_interface(tmp_path: Path) -> None:
    pytest.importorskip("grpc")
    blocks = python_blocks((ROOT / "docs/how-to/slam-interface.md").read_text())
    (block,) = (block for block in blocks if "build_map" not in block)  # which test_slam_docs runs
    (tmp_path / "typed.py").write_text(SERVED + block.replace("50551", "0"))
    done = python(tmp_path / "typed.py", folder=tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.usefixtures("without_plots")
def test_data_contract(session: Path, tmp_path: Path) -> None:
    (tmp_path / "SOURCE").symlink_to(session / "walk")

    def made_again(arguments: list[str]) -> list[str]:  # several ways to make the same name
        made = tmp_path / arguments[arguments.index("--out") + 1] if arguments[0] == "convert" else None
        if made is not None and made.is_dir():
            shutil.rmtree(made)
        elif made is not None:
            made.unlink(missing_ok=True)
        return [*arguments, "--duration", "0.5"] if arguments[0] == "simulate" else arguments

    for page in ("docs/reference/data-contract.md", "docs/reference/results.md", "docs/reference/simulation.md"):
        run_commands(page, tmp_path, made_again)
    assert (tmp_path / "room/rig-true.yaml").exists()
    assert (tmp_path / "S/mav0/cam3/data.csv").exists()
