"""``graphvio slam`` as it is typed: the SLAM in its own process makes a map, and localises in a saved one."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from browser import free_options
from command_line import Ran, graphvio
from ros2_loopback import URI, free_domain

from graphvio import load_trajectory, open_source

pytest.importorskip("pycolmap")
pytest.importorskip("grpc")
pytest.importorskip("cyclonedds")
SOON_S = 200.0


def slam(*arguments: object) -> Ran:
    """Run the odometry in this process, and the SLAM in one of its own."""
    with patch.dict(os.environ, {"CYCLONEDDS_URI": URI}):
        return graphvio("slam", *arguments)


@pytest.fixture(scope="module")
def made(room_walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of the walk, made while all services run."""
    out = tmp_path_factory.mktemp("slam") / "map"
    web = free_options()
    shown = ("--save-rrd", out.parent / "shown.rrd", "--web", web.port)
    done = slam(f"replay:{room_walk}?speed=0.5", "--out", out, *shown, "--health-port", 0, "--ros2", free_domain())
    assert done.returncode == 0, done.stderr
    assert f"browser: {web.url}" in done.stderr.splitlines()
    assert "health: http://127.0.0.1:" in done.stderr
    assert "ROS 2: node /graphvio" in done.stderr
    return out


def test_slam_makes_a_map_with_the_odometrys_path(made: Path, room_walk: Path) -> None:
    odom, online, kept = (load_trajectory(made / f"{name}.txt") for name in ("odometry", "online", "trajectory"))
    source = open_source(room_walk)
    assert len(odom) > 0.8 * source.frameset_count
    assert len(online) > 0.5 * len(odom)  # the map is where odom is, from the first place on
    same, known = odom.at(online.stamps_ns, 0.1)
    np.testing.assert_allclose(online.select(known).positions, same.positions, atol=1e-3)
    assert len(kept) > 3
    assert (made.parent / "shown.rrd").stat().st_size > 10_000


def test_slam_localises_in_a_saved_map(made: Path, room_walk: Path, tmp_path: Path) -> None:
    """From the middle of the walk, where the new odom frame has nothing to do with the map's.

    The places of the session, which the SLAM corrects until it has processed the last, are where the map has them.
    How soon the first correction comes, and so the path online, is a matter of the machine's load.
    """
    done = slam(f"{room_walk}?from_s=2.5&speed=0.4", "--map", made, "--out", tmp_path / "again")
    assert done.returncode == 0, done.stderr
    corrected, odometry = (load_trajectory(tmp_path / f"again/{name}.txt") for name in ("trajectory", "odometry"))
    expected, known = load_trajectory(made / "odometry.txt").at(corrected.stamps_ns, 0.1)
    apart = expected.positions - corrected.select(known).positions
    assert len(apart) >= 3, done.stderr
    assert np.median(np.linalg.norm(apart, axis=1)) < 0.05, done.stderr
    in_odom, known = odometry.at(corrected.stamps_ns, 0.1)
    assert np.linalg.norm(corrected.select(known).positions - in_odom.positions, axis=1).min() > 0.2


def test_slam_missing_map_is_refused_before_the_source_opens(tmp_path: Path) -> None:
    done = graphvio("slam", "replay:no-recording", "--map", tmp_path / "nowhere")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"graphvio: {tmp_path / 'nowhere'}: is no map")


_MAIN = """
import signal
from graphvio.cli import dashboard, main
if __name__ == "__main__":  # not in the SLAM's process
    signal.signal(signal.SIGINT, signal.default_int_handler)
    dashboard._PLAIN_S = 2.0  # of the lines that tests wait for
    main()
"""

_FAILING = """
import itertools
from graphvio.errors import SourceError
from graphvio.live.sources.replay import Replay
whole = Replay.readings
def readings(self):
    yield from itertools.islice(whole(self), 900)
    raise SourceError("the device is broken")
if __name__ == "__main__":
    Replay.readings = readings
    from graphvio.cli import main
    main()
"""


@contextmanager
def running(code: str, temporary: Path, *arguments: object) -> Iterator[subprocess.Popen[str]]:
    """Run a process that leads a group, with a folder of its own for temporary files."""
    temporary.mkdir()
    process = subprocess.Popen(
        [sys.executable, "-c", code, "slam", *map(str, arguments)],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "TMPDIR": str(temporary)},
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def slam_of(process: subprocess.Popen[str]) -> int | None:
    """Return the id of the process in which the SLAM runs."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return next((int(each) for each in children if "spawn_main" in Path(f"/proc/{each}/cmdline").read_text()), None)


def test_slam_killed_leaves_the_odometry_running(room_walk: Path, tmp_path: Path) -> None:
    out, temporary = tmp_path / "map", tmp_path / "temporary"
    web, to_s = free_options(), 3.0
    spec = f"replay:{room_walk}?speed=1&to_s={to_s}"
    with running(_MAIN, temporary, spec, "--out", out, "--web", web.port) as process:
        assert process.stderr is not None
        next(line for line in process.stderr if line.startswith("tracking"))
        killed = slam_of(process)
        assert killed is not None
        os.kill(killed, signal.SIGKILL)
        errors = process.stderr.read()
        assert process.wait(SOON_S) == 3, errors
    (line,) = [line for line in errors.splitlines() if line.startswith("graphvio: ")]
    assert "the SLAM failed (exit code -9)" in line
    assert "the odometry goes on" in line
    assert {path.name for path in out.iterdir()} == {"odometry.txt", "online.txt"}
    stamps_ns = load_trajectory(out / "odometry.txt").stamps_ns
    assert stamps_ns[-1] - stamps_ns[0] > 0.8e9 * to_s  # on a busy machine framesets in between are skipped
    assert not list(temporary.iterdir())
    with socket.socket() as probe:  # the page has gone with it
        assert probe.connect_ex(("127.0.0.1", web.port)) != 0


def test_slam_failing_source_saves_the_map(room_walk: Path, tmp_path: Path) -> None:
    out, temporary = tmp_path / "map", tmp_path / "temporary"
    with running(_FAILING, temporary, f"replay:{room_walk}?speed=1", "--out", out) as process:
        _, errors = process.communicate(timeout=SOON_S)
        assert process.returncode == 2, errors
    assert errors.splitlines()[-1] == "graphvio: the device is broken"
    assert "Traceback" not in errors
    assert json.loads((out / "map.json").read_text())["places"] > 0
    assert len(load_trajectory(out / "odometry.txt")) > 3
    assert not list(temporary.iterdir())


def test_slam_ctrl_c_at_initialisation_ends_both_silently(room_walk: Path, tmp_path: Path) -> None:
    out, temporary = tmp_path / "map", tmp_path / "temporary"
    with running(_MAIN, temporary, f"replay:{room_walk}", "--out", out) as process:
        end_s = time.monotonic() + SOON_S
        while slam_of(process) is None:
            assert process.poll() is None
            assert time.monotonic() < end_s
            time.sleep(0.01)
        os.killpg(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=SOON_S)
        assert process.returncode == 130, errors
    assert not errors
    assert not out.exists()
    assert not list(temporary.iterdir())


def test_slam_signal_to_both_processes_saves_the_map(room_walk: Path, tmp_path: Path) -> None:
    """Service managers send signals so."""
    out = tmp_path / "map"
    with running(_MAIN, tmp_path / "temporary", f"replay:{room_walk}?speed=1", "--out", out) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if line.startswith("tracking"):
                os.killpg(process.pid, signal.SIGTERM)
                break
        remaining = process.stderr.read()
        assert process.wait(SOON_S) == 0, remaining
    assert (out / "map.json").is_file()
    assert len(load_trajectory(out / "odometry.txt")) > 3
