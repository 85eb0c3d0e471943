"""``scripts/benchmark slam``: accuracy of the reference SLAM, and relocalisation in a saved map.

The command ``graphvio slam`` runs on the simulated loop in real time and saves a map. Then it runs again with this map,
from other places of the same walk, on the same images.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.command_line import Subparsers, add_command, add_report_options
from benchmarks.recordings import add_data_option, simulated
from benchmarks.report import Report, log_progress, machine
from graphvio.arrays import Float
from graphvio.errors import GraphvioError
from graphvio.evaluation import evaluate
from graphvio.evaluation.measures import align
from graphvio.geometry import se3_inverse
from graphvio.sources import open_source
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory

_SCENE = "loop"
_SESSION_BEGINS_S = (8.0, 30.0, 50.0)
_RELOCALISED_S = 15.0
_GAP_S = 0.1
_HEAD = ("error, mm", "odometry", "in the map as known then", "in the map as known at the end")


def add_parser(subparsers: Subparsers) -> None:
    """Add ``slam``."""
    parser = add_command(subparsers, "slam", "the reference SLAM on the loop, and in its saved map", __doc__, main)
    add_report_options(parser)
    add_data_option(parser)


def main(args: argparse.Namespace) -> None:
    """Run and report."""
    folder = simulated(args.data, _SCENE)
    report = Report()
    report.add(machine())
    with tempfile.TemporaryDirectory() as made:
        out = Path(made) / "map"
        _slam(f"replay:{folder}", "--out", out)
        report.table(_HEAD, _errors(folder, out))
        report.add(_smoothness(folder, out))
        rows = []
        for start_s in _SESSION_BEGINS_S:
            again = Path(made) / f"from-{start_s:g}"
            until_s = start_s + _RELOCALISED_S
            _slam(f"replay:{folder}?from_s={start_s:g}&to_s={until_s:g}", "--map", out, "--out", again)
            rows.append(_relocalised(folder, out, again, start_s))
            log_progress(f"from {start_s:g} s")
        report.add(f"In the saved map, from {len(_SESSION_BEGINS_S)} places of the walk, {_RELOCALISED_S:g} s each:")
        report.table(("begins at, s", "found after, s", "error when found, mm", "error at the end, mm"), rows)
    report.write(args, "slam")


def _slam(source: str, *arguments: str | Path) -> None:
    command = [sys.executable, "-c", "from graphvio.cli import main; main()", "slam", source, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    print(done.stderr[-600:], file=sys.stderr)
    if done.returncode:
        raise GraphvioError(f"graphvio slam {source} ended with {done.returncode}: {done.stderr[-300:]}")


def _errors(folder: Path, out: Path) -> list[list[str]]:
    """Return rows of the errors that ``graphvio evaluate`` reports."""
    rows: list[list[str]] = [["ATE, rmse"], ["drift: the end's error where the start is aligned"]]
    for name in ("odometry.txt", "online.txt", "trajectory.txt"):
        found = evaluate(load_trajectory(out / name), _truth(folder))
        rows[0].append(f"{1e3 * found.ate_position_m.rmse:.1f}")
        rows[1].append(f"{10.0 * (found.drift_percent or np.nan) * found.path_length_m:.2f}")
    return rows


def _truth(folder: Path) -> Trajectory:
    path = open_source(folder).truth
    assert path is not None
    return load_trajectory(path)


def _truth_T(found: Trajectory, truth: Trajectory) -> Float:
    """Return the transform ``truth_T_map`` (4, 4) that aligns a trajectory with the truth best."""
    true, known = truth.at(found.stamps_ns, _GAP_S)
    return np.ascontiguousarray(align(found.select(known), true))


def _off(found: Trajectory, truth: Trajectory, truth_T_map: Float) -> Float:
    """Return the distances (N,) of a trajectory's positions from the truth, metres."""
    true, known = truth.at(found.stamps_ns, _GAP_S)
    return np.asarray(np.linalg.norm(found.select(known).transformed(truth_T_map).positions - true.positions, axis=1))


def _smoothness(folder: Path, out: Path) -> str:
    """Return a sentence on the steps of odom between framesets: the largest, and the largest error of one."""
    odom = load_trajectory(out / "odometry.txt")
    true, known = _truth(folder).at(odom.stamps_ns, _GAP_S)
    measured, expected = _steps(odom.select(known)), _steps(true)
    longest = [1e3 * float(np.linalg.norm(steps, axis=1).max()) for steps in (measured, expected)]
    return (
        f"Steps of odom between framesets: {longest[0]:.1f} mm at most, the true ones {longest[1]:.1f} mm; "
        f"{1e3 * np.linalg.norm(measured - expected, axis=1).max():.2f} mm apart at most."
    )


def _steps(path: Trajectory) -> Float:
    """Return the translations (N - 1, 3) from each pose to the next, in body."""
    poses = [np.ascontiguousarray(pose) for pose in path.nav_T_body]
    return np.array([(se3_inverse(a) @ b)[:3, 3] for a, b in pairwise(poses)])


def _relocalised(folder: Path, out: Path, again: Path, start_s: float) -> list[str]:
    truth, begun_ns = _truth(folder), open_source(folder).start_ns
    if not (again / "online.txt").exists():
        return [f"{start_s:g}", "never", "-", "-"]
    online = load_trajectory(again / "online.txt")
    errors = 1e3 * _off(online, truth, _truth_T(load_trajectory(out / "trajectory.txt"), truth))
    found_s = 1e-9 * (int(online.stamps_ns[0]) - begun_ns) - start_s
    return [f"{start_s:g}", f"{found_s:.1f}", f"{errors[0]:.1f}", f"{errors[-1]:.1f}"]
