"""``--json`` of every command: one document on stdout, and nothing else there."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from calibration_walks import recorded
from command_line import graphvio
from dataset_layouts import rendered_walk, write_euroc
from recordings import write_euroc as write_noise
from undrawn import undrawn

from graphvio.cli import app
from graphvio.cli.json_output import plain
from graphvio.geometry import se3, so3_exp
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory, save_trajectory

WITHOUT = {"view"}  # opens a window


def names_of(group: Any, before: str = "") -> Iterator[str]:
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from names_of(command, f"{before}{name} ")
        else:
            yield f"{before}{name}"


COMMANDS = sorted(set(names_of(typer.main.get_command(app))) - WITHOUT)


@pytest.fixture(scope="module")
def walk() -> Path:
    return rendered_walk()


@pytest.fixture(scope="module")
def results(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("json") / "results"
    with undrawn():
        assert graphvio("run", walk, "--out", folder).returncode == 0
    return folder


def turned(folder: Path) -> list[object]:
    poses = load_trajectory(rendered_walk() / "mav0/state_groundtruth_estimate0/data.csv")
    front_T_back = se3(so3_exp(np.array([0.1, -0.2, 2.0])), np.array([0.3, 0.1, -0.1]))
    save_trajectory(poses, folder / "front.txt")
    save_trajectory(Trajectory(poses.stamps_ns, poses.nav_T_body @ front_T_back), folder / "back.txt")
    return [folder / "front.txt", folder / "back.txt", "--same-clock"]


def fleet_of(folder: Path) -> list[object]:
    pytest.importorskip("distributed")
    write_noise(folder / "recordings/walk", pairs=1, frames=6)
    return [folder / "recordings", "--out", folder / "out", "--no-loops", "--workers", 1]


def session(folder: Path) -> list[object]:
    pytest.importorskip("mcap")
    assert graphvio("convert", rendered_walk(), "--to", 0.5, "--out", folder / "walk.mcap").returncode == 0
    return [folder / "walk.mcap"]


def public(folder: Path) -> list[object]:
    write_euroc(folder / "data")
    return ["euroc", folder / "data", "--to", 1, "--out", folder / "out"]


ARGUMENTS: dict[str, Callable[[Path, Path, Path], list[object]]] = {
    "benchmark": lambda folder, walk, results: public(folder),
    "calibrate": lambda folder, walk, results: [recorded(folder / "walk", 3.0)],
    "calibrate-trajectories": lambda folder, walk, results: turned(folder),
    "compare": lambda folder, walk, results: [results, "--truth", walk],
    "convert": lambda folder, walk, results: [walk, "--to", 0.5, "--out", folder / "again", "--format", "euroc"],
    "doctor": lambda folder, walk, results: [],
    "dump-config": lambda folder, walk, results: ["fast"],
    "evaluate": lambda folder, walk, results: [results / "trajectory.txt", walk],
    "fleet optimize": lambda folder, walk, results: fleet_of(folder),
    "info": lambda folder, walk, results: session(folder),
    "live": lambda folder, walk, results: [f"replay:{walk}?speed=5", "--for", 1],
    "optimize": lambda folder, walk, results: [walk, "--to", 1, "--no-loops", "--out", folder / "out"],
    "record": lambda folder, walk, results: [walk, "--to", 0.5, "--out", folder / "walk.mcap"],
    "rig": lambda folder, walk, results: [walk],
    "run": lambda folder, walk, results: [walk, "--to", 0.5, "--out", folder / "out"],
    "serve": lambda folder, walk, results: [f"replay:{walk}?speed=5", "--for", 1, "--port", 0],
    "simulate": lambda folder, walk, results: ["room", "--out", folder / "room", "--duration", 0.2, "--rig", "stereo"],
    "slam": lambda folder, walk, results: [f"replay:{walk}?speed=5", "--for", 1],
    "warmup": lambda folder, walk, results: [],
}
KEYS = {
    "benchmark": "sequences",
    "calibrate": "left_T_left1",
    "calibrate-trajectories": "left_T_left1",
    "compare": "results",
    "convert": "format",
    "doctor": "versions",
    "dump-config": "smoother",
    "evaluate": "ate_position_m",
    "fleet optimize": "sessions",
    "info": "topics",
    "live": "framesets",
    "optimize": "sessions",
    "record": "poses",
    "rig": "groups",
    "run": "completion",
    "serve": "framesets",
    "simulate": "framesets",
    "slam": "framesets",
    "warmup": "folder",
}
NEEDS = {"serve": "grpc", "slam": "grpc", "record": "mcap"}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.usefixtures("without_plots")
def test_every_command_prints_one_document(command: str, walk: Path, results: Path, tmp_path: Path) -> None:
    if command in NEEDS:
        pytest.importorskip(NEEDS[command])
    ran = graphvio(*command.split(), *ARGUMENTS[command](tmp_path, walk, results), "--json", folder=tmp_path)
    assert ran.returncode in (0, 3), ran.stderr
    document = json.loads(ran.stdout)
    assert KEYS[command] in document


def test_list_of_live_devices_is_one_document() -> None:
    ran = graphvio("live", "--list", "--json")
    assert ran.returncode == 0, ran.stderr
    listed = json.loads(ran.stdout)
    assert {"v4l2", "realsense", "oak", "ros2"} <= {each["kind"] for each in listed}


@pytest.mark.parametrize(
    ("typed", "kind"),
    [
        ("run none", "SourceError"),
        ("info none", "SourceError"),
        ("rig none", "RigError"),
        ("evaluate none none", "TrajectoryError"),
        ("dump-config none", "ConfigError"),
        ("run none --from -1", "UsageError"),
        ("rig", "UsageError"),
    ],
)
def test_json_command_fails_prints_its_error(typed: str, kind: str, tmp_path: Path) -> None:
    ran = graphvio(*typed.split(), "--json", folder=tmp_path)
    assert ran.returncode == 2
    error = json.loads(ran.stdout)["error"]
    assert set(error) == {"kind", "message"}
    assert error["kind"] == kind
    assert ran.stderr.startswith(f"graphvio: {error['message']}")
    assert ran.stderr == graphvio(*typed.split(), folder=tmp_path).stderr


def test_json_command_interrupted_prints_its_error(walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("graphvio.warmup.warm_up", lambda *_, **__: None)
    monkeypatch.setattr("graphvio.pipeline.run", interrupted)
    ran = graphvio("run", walk, "--out", tmp_path / "out", "--json")
    assert ran.returncode == 130
    assert json.loads(ran.stdout)["error"]["kind"] == "Interrupted"


def test_json_command_crashes_prints_its_error(walk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def crash(*_: object) -> None:
        raise ZeroDivisionError("an error of the program")

    monkeypatch.setattr("graphvio.sources.contents.describe_folder", crash)
    ran = graphvio("info", walk, "--json")
    assert ran.returncode == 1
    assert json.loads(ran.stdout) == {"error": {"kind": "ZeroDivisionError", "message": "an error of the program"}}


def test_numbers_agree_with_the_files(results: Path, walk: Path, tmp_path: Path) -> None:
    saved = tmp_path / "figures.json"
    ran = graphvio("evaluate", results / "trajectory.txt", walk, "--json", "--save-json", saved)
    assert json.loads(ran.stdout) == json.loads(saved.read_text())


def test_values_that_json_lacks_become_null() -> None:
    assert plain({"a": float("nan"), 2: [float("inf"), (1, True)]}) == {"a": None, "2": [None, [1, True]]}
