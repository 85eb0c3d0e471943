"""Six sessions on two workers, one of which is killed; what is missing is done later; storage that is not local."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import sqlite3
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dask
import fsspec
import pytest
from calibration_walks import recorded
from distributed import LocalCluster
from typer.testing import CliRunner, Result

from graphvio.cli import app
from graphvio.config import Config
from graphvio.errors import FleetError
from graphvio.fleet import tasks
from graphvio.fleet.listing import Listed, list_sessions
from graphvio.fleet.run import FleetProgress, optimize_fleet
from graphvio.fleet.storage import Storage
from graphvio.fleet.table import COLUMNS, Outcome
from graphvio.optimization.loops.sift import SiftExtractor
from graphvio.optimization.pipeline import optimize_sessions
from graphvio.sources import open_source
from graphvio.warmup import warm_up

SESSIONS, FRAMES, CORRUPT = 6, 18, "walk-05"
PLACES_PER_TASK = 2
CONFIG = """
calibration: {online: false}  # a second shows nothing of it
optimization:
  features: 100
  place_distance_m: 0.1
  place_angle_deg: 5.0
  loop_interval_s: 0.3
  loop_min_inliers: 15
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sessions that begin one frame after the other; the images are those of one recording."""
    base = tmp_path_factory.mktemp("fleet")
    (base / "config.yaml").write_text(CONFIG)
    whole = recorded(base / "whole", 0.05 * (SESSIONS + FRAMES))
    for number in range(SESSIONS):
        copy_part(whole, base / "sessions" / f"walk-{number:02d}", number)
    shutil.copytree(base / "sessions" / CORRUPT, base / "sound")
    spoil(base / "sessions" / CORRUPT)
    (base / "sessions" / "notes").mkdir()
    (base / "sessions" / "notes.txt").write_text("no recording")
    return base


def copy_part(whole: Path, made: Path, first: int) -> None:
    shutil.copytree(whole, made, copy_function=os.link)
    for table in made.glob("mav0/cam?/data.csv"):
        lines = table.read_text().splitlines(keepends=True)
        table.unlink()  # it is the other's, too
        table.write_text("".join([lines[0], *lines[1 + first : 1 + first + FRAMES]]))


def spoil(recording: Path) -> None:
    """Cut its images and a table."""
    for image in recording.rglob("*.png"):
        data = image.read_bytes()[:500]
        image.unlink()
        image.write_bytes(data)
    table = recording / "mav0/cam1/data.csv"
    table.write_text(table.read_text()[: len(table.read_text()) // 2])


@pytest.fixture(scope="module")
def config(folder: Path) -> Config:
    return Config.load(str(folder / "config.yaml"))


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with local_cluster("extracting_here.py") as made:
        yield made


def local_cluster(*preloads: str) -> Any:
    """Two workers, whose short runs would mostly plot; on a busy machine a killed one is not back within 15 s."""
    dask.config.set({"distributed.deploy.lost-worker-timeout": "120 s"})
    preload = [str(Path(__file__).with_name(name)) for name in ("undrawn.py", *preloads)]
    return LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0", preload=preload
    )


class Killer:
    """Kills the worker that has work when some tasks are done and more are not."""

    def __init__(self, cluster: Any, after: int) -> None:
        self.cluster = cluster
        self.after = after
        self.interrupted: list[str] = []
        self.pid = 0

    def __call__(self, progress: FleetProgress) -> None:
        if progress.tasks < self.after or self.interrupted:
            return
        assert progress.optimized + progress.failed < progress.sessions
        nanny = self.cluster.workers[0]
        until = time.monotonic() + 10.0
        while not self.interrupted and time.monotonic() < until:
            state = self.cluster.scheduler.workers.get(nanny.worker_address)
            self.interrupted = [] if state is None else [str(task.key) for task in list(state.processing)]
        self.pid = nanny.pid
        os.kill(self.pid, signal.SIGKILL)


@dataclass(frozen=True)
class Done:
    out: Path
    outcomes: list[Outcome]
    killer: Killer


@pytest.fixture(scope="module")
def done(folder: Path, config: Config, cluster: Any) -> Done:
    warm_up(open_source(folder / "whole").rig, config)
    out, killer = folder / "out", Killer(cluster, after=9)
    outcomes = optimize_fleet(
        list_sessions(str(folder / "sessions")),
        str(out),
        config,
        scheduler=cluster.scheduler_address,
        places_per_task=PLACES_PER_TASK,
        on_progress=killer,
    )
    return Done(out, outcomes, killer)


@pytest.mark.usefixtures("without_plots")
def test_fleet_killed_worker_leaves_equal_results(
    done: Done, folder: Path, config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert done.killer.interrupted
    assert done.killer.pid != done.killer.cluster.workers[0].pid
    assert [each.name for each in done.outcomes] == [f"walk-{number:02d}" for number in range(SESSIONS)]
    assert [each.name for each in done.outcomes if each.error] == [CORRUPT]
    for drawing in ("write_report", "write_plan"):
        monkeypatch.setattr(f"graphvio.optimization.pipeline.{drawing}", lambda *_, **__: None)
    monkeypatch.setattr("graphvio.optimization.loops.features.SiftProcess", SiftExtractor)  # features are the same
    parts, loops = set(), 0
    for each in done.outcomes:
        if each.error:
            continue
        alone = folder / "alone" / each.name
        optimize_sessions([open_source(each.recording)], alone, config)
        for name in ("trajectory_optimized.txt", "covariance.csv", "graph.g2o", "loops.npz", f"{each.name}/record.npz"):
            assert (done.out / each.name / name).read_bytes() == (alone / name).read_bytes(), (each.name, name)
        assert rows(done.out / each.name / "database.db") == rows(alone / "database.db"), each.name
        assert not list((done.out / each.name / "parts").iterdir())
        parts.add(each.figures["parts"])
        loops += each.figures["loops_found"]
    assert max(parts) > 1
    assert loops > 0
    assert not list(done.out.rglob(".*"))


def rows(database: Path) -> dict[str, list[Any]]:
    with sqlite3.connect(database) as file:
        tables = [name for (name,) in file.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        return {name: sorted(map(repr, file.execute(f"SELECT * FROM {name}"))) for name in tables}


def test_fleet_table_has_every_session(done: Done) -> None:
    with (done.out / "summary.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert tuple(table[0]) == COLUMNS
    assert [row["name"] for row in table] == [f"walk-{number:02d}" for number in range(SESSIONS)]
    for row in table:
        if row["name"] == CORRUPT:
            assert (row["status"], row["failed_in"], row["ate_m"]) == ("failed", "odometry", "")
            assert "none of its" in row["error"]
            assert "image_undecodable" in row["error"]
        else:
            assert (row["status"], row["error"], row["framesets"]) == ("optimized", "", str(FRAMES))
            assert float(row["ate_m"]) < 0.01
            assert float(row["completion"]) == 1.0
            assert float(row["cost_after"]) <= float(row["cost_before"])
            assert all(float(row[f"{stage}_wall_s"]) > 0.0 for stage in ("odometry", "features", "loops", "graph"))
    page = (done.out / "summary.html").read_text()
    assert "6 sessions, 5 optimised, 1 failed" in page
    assert page.count("<tr") == 1 + SESSIONS
    assert "://" not in page


def command(folder: Path, *arguments: object) -> Result:
    common = ["--config", folder / "config.yaml"]
    return CliRunner().invoke(app, ["fleet", "optimize", *map(str, [*arguments, *common])], env={"COLUMNS": "160"})


def test_fleet_again_does_only_what_is_missing(done: Done, folder: Path, cluster: Any, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(done.out, out)
    shutil.copytree(folder / "sessions", tmp_path / "sessions", copy_function=os.link)
    moved = [Listed(each.name, each.recording) for each in done.outcomes]
    listed = tmp_path / "list.txt"
    listed.write_text("# all\n" + "".join(f"{each.recording}\n" for each in moved))
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    (out / "walk-03" / "trajectory_optimized.txt").unlink()
    (out / "walk-04" / "loops.npz").unlink()
    result = command(folder, listed, "--out", out, "--scheduler", cluster.scheduler_address)
    assert result.exit_code == 3, result.output
    assert f"{CORRUPT} failed in odometry: " in result.output
    assert "5 of 6 sessions optimised" in result.output
    changed = {str(path.relative_to(out)) for path, stamp in before.items() if path.stat().st_mtime_ns != stamp}
    assert {name.split("/")[0] for name in changed} == {"walk-03", "walk-04", "summary.csv", "summary.html"}
    marker = json.loads((out / "walk-03/stages/graph.json").read_text())
    made = {"database.db", "stages/graph.json", *marker["files"]}
    assert {"trajectory_optimized.txt", "covariance.csv", "graph.g2o", "report.html"} <= made
    assert {name for name in changed if name.startswith("walk-03")} == {f"walk-03/{name}" for name in made}
    assert not any(name.endswith(("record.npz", "odometry.json")) for name in changed)
    for name in ("walk-03/trajectory_optimized.txt", "walk-04/loops.npz", "walk-04/graph.g2o"):
        assert (out / name).read_bytes() == (done.out / name).read_bytes()
    for name in ("walk-03", "walk-04"):
        assert rows(out / name / "database.db") == rows(done.out / name / "database.db")


def test_fleet_other_input_is_refused(folder: Path, cluster: Any, tmp_path: Path) -> None:
    (tmp_path / "sessions").mkdir()
    shutil.copytree(folder / "sound", tmp_path / "sessions" / CORRUPT)
    arguments = (tmp_path / "sessions", "--out", tmp_path / "out")
    result = command(folder, *arguments, "--scheduler", cluster.scheduler_address)
    assert result.exit_code == 0, result.output
    assert "1 of 1 sessions optimised" in result.output
    other = command(folder, *arguments, "--no-loops", "--scheduler", cluster.scheduler_address)
    assert other.exit_code == 3
    assert "holds results of other input (different: loops)" in other.output


@pytest.mark.usefixtures("without_plots")
def test_fleet_remote_storage_has_equal_results(
    done: Done, folder: Path, config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = fsspec.filesystem("memory")
    memory.put(f"{folder}/sessions/walk-00/", "/recordings/walk-00/", recursive=True)
    assert list_sessions("memory://recordings") == [Listed("walk-00", "memory://recordings/walk-00")]
    job = tasks.Job("walk-00", "memory://recordings/walk-00", "memory://results/walk-00", config, None, True, 2)
    parts = tasks.odometry(job).figures["parts"]
    for part in range(parts):
        tasks.features(job, part, parts)
    tasks.loops(job, parts)
    assert tasks.graph(job).figures["ate_m"] < 0.01
    results = Storage("memory://results/walk-00")
    for name in ("trajectory_optimized.txt", "graph.g2o", "loops.npz"):
        assert results.read(name) == (done.out / "walk-00" / name).read_bytes()
    assert not any(name.endswith(".tmp") or name.startswith("parts/") for name in results.sizes())


@pytest.mark.parametrize("scheme", ["", "file://", "memory://"])
def test_storage_failed_write_keeps_the_old_file(scheme: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    storage = Storage(f"{scheme}{tmp_path}/results")
    storage.write("a/b.txt", b"old")
    source = tmp_path / "source"
    source.write_bytes(b"new")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(storage, "_move", full)
        with pytest.raises(FleetError, match=r"a/b.txt cannot be written \(No space left on device\)"):
            storage.put(source, "a/b.txt")
        assert storage.sizes() == {"a/b.txt": 3}
        assert storage.read("a/b.txt") == b"old"
    storage.put(source, "a/b.txt")
    assert storage.read("a/b.txt") == b"new"
    assert storage.read("absent") is None


def test_list_sessions_folders_and_lists(folder: Path, tmp_path: Path) -> None:
    names = [each.name for each in list_sessions(str(folder / "sessions"))]
    assert names == [f"walk-{number:02d}" for number in range(SESSIONS)]
    listed = tmp_path / "list.txt"
    listed.write_text("# two of one name\none/walk\n\n/two/walk\ns3://bucket/three.mcap\n")
    assert list_sessions(f"file://{listed}") == [
        Listed("walk", str(tmp_path / "one/walk")),
        Listed("walk-2", "/two/walk"),
        Listed("three", "s3://bucket/three.mcap"),
    ]
    for wrong in (tmp_path / "absent", tmp_path / "empty", tmp_path / "binary"):
        if wrong.name == "empty":
            wrong.mkdir()
        elif wrong.name == "binary":
            wrong.write_bytes(b"\xff\xfe\x80")
        with pytest.raises(FleetError, match=r"give a folder or a list|neither a folder nor a list"):
            list_sessions(str(wrong))
    with pytest.raises(FleetError, match="cannot be reached"):
        list_sessions("nonsense://bucket/list.txt")
