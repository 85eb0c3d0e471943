"""``graphvio slam``, as it is typed: the SLAM in its own process makes a map, and finds its way in one that is kept."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from ros2_loopback import URI, free_domain

from graphvio import Trajectory, open_source
from graphvio.geometry import se3_inverse

pytest.importorskip("pycolmap")
pytest.importorskip("grpc")
pytest.importorskip("cyclonedds")
pytestmark = pytest.mark.heavy

SOON_S = 200.0


def slam(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from graphvio.cli import main; main()", "slam", *map(str, arguments)]
    env = {**os.environ, "CYCLONEDDS_URI": URI}
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=SOON_S, env=env)


@pytest.fixture(scope="module")
def made(room_walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of the walk, made with all that can run beside."""
    out = tmp_path_factory.mktemp("slam") / "map"
    beside = ("--save-rrd", out.parent / "shown.rrd", "--health-port", 0, "--ros2", free_domain())
    done = slam(f"replay:{room_walk}?speed=0.5", "--out", out, *beside)
    assert done.returncode == 0, done.stderr
    assert "health: http://127.0.0.1:" in done.stderr
    assert "ROS 2: topics below /graphvio" in done.stderr
    return out


def test_a_map_is_made_and_its_paths_are_those_of_the_odometry_until_a_loop_is_closed(
    made: Path, room_walk: Path
) -> None:
    odom, online, kept = (Trajectory.read(made / f"{name}.txt") for name in ("odometry", "online", "trajectory"))
    source = open_source(room_walk)
    assert len(odom) > 0.8 * source.frameset_count
    assert len(online) > 0.5 * len(odom)  # the map is where odom is, from the first place on
    same, known = odom.at(online.stamps_ns, 0.1)
    np.testing.assert_allclose(online.select(known).positions, same.positions, atol=1e-3)
    assert len(kept) > 3
    assert (made.parent / "shown.rrd").stat().st_size > 10_000


def test_the_way_is_found_in_a_saved_map(made: Path, room_walk: Path, tmp_path: Path) -> None:
    """From the middle of the walk, where the new odom frame has nothing to do with the map's."""
    done = slam(f"replay:{room_walk}?from_s=1.5&speed=0.3", "--map", made, "--out", tmp_path / "again")
    assert done.returncode == 0, done.stderr
    online = Trajectory.read(tmp_path / "again/online.txt")
    before, known = Trajectory.read(made / "odometry.txt").at(online.stamps_ns, 0.1)
    apart = [
        se3_inverse(np.ascontiguousarray(a)) @ b
        for a, b in zip(before.nav_T_body, online.select(known).nav_T_body, strict=True)
    ]
    assert len(apart) >= 3
    assert np.median([np.linalg.norm(each[:3, 3]) for each in apart]) < 0.05
    start = Trajectory.read(tmp_path / "again/odometry.txt").positions[0]
    assert np.linalg.norm(online.positions[0] - start) > 0.2


def test_a_map_that_is_none_ends_it_at_once(room_walk: Path, tmp_path: Path) -> None:
    done = slam(f"replay:{room_walk}", "--map", tmp_path / "nowhere")
    assert done.returncode == 2
    assert "nowhere" in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.rstrip().splitlines()[-1].startswith("graphvio: ")


def test_a_signal_to_both_processes_ends_it_with_the_map_saved(room_walk: Path, tmp_path: Path) -> None:
    """As service managers send it."""
    command = [sys.executable, "-c", "from graphvio.cli import main; main()", "slam", f"replay:{room_walk}?speed=0.2"]
    process = subprocess.Popen(
        [*command, "--out", str(tmp_path / "map")], stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        assert process.stderr is not None
        for line in process.stderr:
            if line.startswith("tracking"):
                os.killpg(process.pid, signal.SIGTERM)
                break
        rest = process.stderr.read()
        assert process.wait(SOON_S) == 0, rest
    finally:
        process.kill()
    assert (tmp_path / "map/map.json").is_file()
    assert len(Trajectory.read(tmp_path / "map/odometry.txt")) > 3
