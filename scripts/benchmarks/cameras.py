"""``scripts/benchmark cameras``: accuracy by what cameras a rig has, in the same scenes."""

from __future__ import annotations

import argparse
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks.recordings import add_data_option, rendered_once
from benchmarks.report import Report, machine
from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.errors import GraphvioError, TrajectoryError
from graphvio.evaluation import evaluate
from graphvio.odometry import Odometry
from graphvio.rig import Rig
from graphvio.simulation import SCENE_NAMES, simulate
from graphvio.simulation.named_rigs import NAMED_RIGS
from graphvio.sources import open_source
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory
from graphvio.warmup import warm_up

_RENDERED = "paper"  # its cameras include those of the others
_RIGS = ("paper", "stereo", "stereo+back")
_BASE = "stereo"
_CONFIGS = {"estimated": "{}", "trusted": "calibration: {online: false}"}


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "cameras",
        help="accuracy of the named rigs in the same scenes",
        description="Runs simulated scenes with the cameras of each rig that has a name, with exact calibration files, "
        "which the odometry checks by its self-calibration or takes for exact.",
        epilog="Example: scripts/benchmark cameras --scenes room --seeds 1",
    )
    parser.add_argument("--scenes", nargs="+", default=["room", "corridor"], choices=SCENE_NAMES, metavar="NAME")
    parser.add_argument("--rigs", nargs="+", default=list(_RIGS), choices=_RIGS, metavar="NAME")
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="number of recordings (default: 3)")
    parser.add_argument("--duration", type=float, metavar="S", help="only so much of each walk")
    parser.add_argument("--out", type=Path, metavar="FILE", help="also write the tables to this file")
    parser.add_argument("--docs", action="store_true", help="put the tables into docs/explanation/benchmarks")
    add_data_option(parser)
    parser.set_defaults(run=run_all)


def run_all(args: argparse.Namespace) -> None:
    """Measure and report."""
    if args.seeds < 1:
        raise GraphvioError("--seeds must be at least 1")
    rigs = [_BASE, *(name for name in args.rigs if name != _BASE)]
    report = Report()
    report.add(machine())
    rows = []
    for scene in args.scenes:
        folders = [_rendered(args.data, scene, seed, args.duration) for seed in range(args.seeds)]
        for calibration, text in _CONFIGS.items():
            ates_mm = {name: [_ate_of(folder, name, Config.from_yaml(text)) for folder in folders] for name in rigs}
            base = median(ates_mm[_BASE])
            rows += [
                (scene, calibration, name, f"{median(each):.2f}", f"{max(each):.2f}", f"{median(each) / base:.2f}")
                for name, each in ates_mm.items()
            ]
    head = ("scene", "calibration", "rig", "ATE, mm, median", "worst", f"over {_BASE}")
    report.table(head, rows)
    report.write(args, "cameras")


def _rendered(data: Path, scene: str, seed: int, duration_s: float | None) -> Path:
    variant = f"seed{seed}" if duration_s is None else f"{duration_s:g}s-seed{seed}"
    return rendered_once(data, scene, variant, lambda folder: simulate(scene, folder, seed=seed, duration_s=duration_s))


def _ate_of(folder: Path, name: str, config: Config) -> float:
    wanted = [camera.name for camera in NAMED_RIGS[name]().cameras]
    return ate_mm(folder, open_source(folder).rig.with_only(wanted), config)


def ate_mm(folder: Path, rig: Rig, config: Config) -> float:
    """Run a rig's cameras and return the causal absolute trajectory error; infinite without poses."""
    source = open_source(folder, rig)
    assert source.truth is not None
    warm_up(source.rig, config)
    odometry = Odometry(source.rig, config)
    estimates = [estimate for estimate in map(odometry.process, source) if estimate is not None]
    posed = [estimate for estimate in [*estimates, *odometry.finish()] if estimate.nav_T_body is not None]
    try:
        poses: Float = np.array([estimate.nav_T_body for estimate in posed]).reshape(-1, 4, 4)
        trajectory = Trajectory(np.array([estimate.stamp_ns for estimate in posed], dtype=np.int64), poses)
        return 1e3 * evaluate(trajectory, load_trajectory(source.truth)).ate_position_m.rmse
    except TrajectoryError:
        return float("inf")
