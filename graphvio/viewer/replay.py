"""Shows a result folder in the viewer."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import GraphvioError
from graphvio.measurements.estimate import Estimate, Status
from graphvio.measurements.events import Event
from graphvio.rig_files import load_rig
from graphvio.trajectory_files import load_trajectory
from graphvio.viewer import Viewer

_SMOOTHED_COLOUR = (40, 190, 90)
_UPPER = np.triu_indices(6)


def replay(folder: Path, *, spawn: bool = False, save: Path | None = None) -> None:
    """Show poses, covariances, biases, events and the smoothed trajectory of a result folder, in a window or a file.

    Only ``trajectory.txt`` and ``rig.yaml`` are required; other files may be missing.

    Raises:
        GraphvioError: if the folder holds no results, a file is damaged, or the viewer cannot be opened.
    """
    if not (folder / "trajectory.txt").is_file():
        raise GraphvioError(f"{folder}: holds no trajectory.txt; give a folder that  graphvio run  has written")
    rig = load_rig(folder / "rig.yaml")
    estimates, events = list(read_estimates(folder)), list(_read_events(folder / "events.jsonl"))
    smoothed = folder / "trajectory_smoothed.txt"
    with Viewer(rig, spawn=spawn, save=save) as viewer:
        for estimate in estimates:
            viewer.show(None, estimate)
        for event in events:
            viewer.show_event(event)
        if smoothed.is_file() and smoothed.stat().st_size:
            viewer.show_path("smoothed", load_trajectory(smoothed), _SMOOTHED_COLOUR)


def read_estimates(folder: Path) -> Iterator[Estimate]:
    """Read the estimates with a pose from a result folder; their status, which is not saved, is set to tracking."""
    trajectory = load_trajectory(folder / "trajectory.txt")
    covariances = {stamp: _symmetric(upper) for stamp, upper in _read_rows(folder / "covariance.csv", 21)}
    biases = dict(_read_rows(folder / "imu_bias.csv", 6))
    epochs = _read_epochs(folder / "summary.json")
    for stamp, pose in zip(trajectory.stamps_ns.tolist(), trajectory.nav_T_body, strict=True):
        bias = biases.get(stamp)
        yield Estimate(
            stamp,
            Status.TRACKING,
            pose,
            covariances.get(stamp),
            epoch=next((e["epoch"] for e in epochs if e["first_stamp_ns"] <= stamp <= e["last_stamp_ns"]), 0),
            gyro_bias=None if bias is None else bias[:3],
            accel_bias=None if bias is None else bias[3:],
        )


def _read_rows(path: Path, columns: int) -> Iterator[tuple[int, Float]]:
    if not path.is_file():
        return
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines()[1:], start=2):
        fields = line.split(",")
        try:
            if len(fields) != columns + 1:
                raise ValueError(f"{len(fields)} columns, not {columns + 1}")
            yield int(fields[0]), np.array([float(field) for field in fields[1:]])
        except ValueError as error:
            raise GraphvioError(f"{path}, line {number}: is damaged ({error}); remove the line") from None


def _read_events(path: Path) -> Iterator[Event]:
    if not path.is_file():
        return
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            yield Event(**json.loads(line))
        except (ValueError, TypeError) as error:
            raise GraphvioError(f"{path}, line {number}: is damaged ({error}); remove the line") from None


def _read_epochs(path: Path) -> list[dict[str, Any]]:
    try:
        return list(json.loads(path.read_text(encoding="utf-8"))["epochs"])
    except (OSError, ValueError, KeyError, TypeError):
        return []  # an interrupted run has no summary


def _symmetric(upper: Float) -> Float:
    covariance = np.zeros((6, 6))
    covariance[_UPPER] = upper
    return covariance + np.triu(covariance, 1).T
