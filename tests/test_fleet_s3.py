"""Recordings and results in an S3 store, served on this machine; one of two workers is killed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("s3fs", reason="s3fs is not installed: the extra s3")
pytest.importorskip("moto.server")

from calibration_walks import recorded
from moto.server import ThreadedMotoServer
from test_fleet import CONFIG, Killer, local_cluster
from typer.testing import CliRunner

from graphvio.cli import app
from graphvio.config import Config
from graphvio.errors import FleetError
from graphvio.fleet.listing import list_sessions
from graphvio.fleet.run import optimize_fleet
from graphvio.fleet.storage import Storage, file_system
from graphvio.rig_files import load_rig
from graphvio.sources.reading import Reading


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    """The address of a store, to which all processes from now on connect."""
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        patch.setenv("AWS_ACCESS_KEY_ID", "test")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "test")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture(scope="module")
def recordings(endpoint: str, tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = recorded(tmp_path_factory.mktemp("s3") / "walk", 0.7)
    files, _ = file_system("s3://fleet")
    files.makedirs("fleet")
    for name in ("one", "two"):
        files.put(f"{folder}/", f"fleet/recordings/{name}/", recursive=True)
    return "s3://fleet/recordings"


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("config") / "config.yaml"
    path.write_text(CONFIG)
    return path


def test_fleet_in_s3_survives_a_killed_worker(recordings: str, config: Path, tmp_path: Path) -> None:
    listed = list_sessions(recordings)
    assert [each.name for each in listed] == ["one", "two"]
    with local_cluster("extracting_here.py") as cluster:
        killer = Killer(cluster, after=1)
        outcomes = optimize_fleet(
            listed, "s3://fleet/results", Config.load(config), scheduler=cluster.scheduler_address, on_progress=killer,
            calibrates=True, reading=Reading(pairs=(0,), with_imu=False),
        )  # fmt: skip
        command = ["fleet", "optimize", recordings, "--out", "s3://fleet/results", "--config", str(config)]
        command += ["--scheduler", cluster.scheduler_address, "--pairs", "0", "--refine-calibration"]
        again = CliRunner().invoke(app, [*command, "--no-imu"])
        assert (again.exit_code, "2 of 2 sessions optimised" in again.output) == (0, True)
        with_imu = CliRunner().invoke(app, command)
        assert with_imu.exit_code == 3
        assert with_imu.output.count("holds results of other input (different: reading)") == 2
    assert killer.interrupted
    assert [each.error for each in outcomes] == ["", ""]
    names = Storage("s3://fleet/results").sizes()
    for session in ("one", "two"):
        results = Storage(f"s3://fleet/results/{session}")
        assert len((results.read("trajectory_optimized.txt") or b"").splitlines()) > 10
        assert results.read("points.ply") is not None
        results.fetch(f"{session}/odometry/rig.yaml", tmp_path / session / "rig.yaml")
        rig = load_rig(tmp_path / session / "rig.yaml")
        assert (len(rig.pairs), rig.imu) == (1, None)
    assert not [name for name in names if name.endswith(".tmp")]
    one, two = (Storage(f"s3://fleet/results/{name}").read("trajectory_optimized.txt") for name in ("one", "two"))
    assert one == two  # of equal recordings; one was interrupted


def test_s3_errors_are_one_line(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FleetError, match="s3://absent/recordings: cannot be read"):
        list_sessions("s3://absent/recordings")
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    files, _ = file_system("s3://fleet")
    files.clear_instance_cache()
    with pytest.raises(FleetError, match="s3://fleet/other"):
        Storage("s3://fleet/other").sizes()
    files.clear_instance_cache()
