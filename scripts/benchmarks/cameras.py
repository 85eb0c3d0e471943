"""``scripts/benchmark cameras``: accuracy of rigs with different cameras in the same scenes."""

from __future__ import annotations

import argparse
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks.command_line import add_report_options
from benchmarks.recordings import add_data_option, rendered_once
from benchmarks.report import Report, machine
from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.errors import GraphvioError, TrajectoryError
from graphvio.evaluation import Evaluation, evaluate
from graphvio.odometry import Odometry
from graphvio.rig import Rig
from graphvio.simulation import SCENE_NAMES, simulate
from graphvio.simulation.named_rigs import NAMED_RIGS
from graphvio.sources import open_source
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory
from graphvio.warmup import warm_up

_RIGS = ("paper", "stereo", "stereo+back")  # in one recording: the paper's cameras include those of the others
_BASE = "stereo"
_SINGLES = "paper, no pairs"
_OWN_RIGS = ("headset", "surround", "phone")  # rigs that each have their own recording
_CONFIGS = {"estimated": "{}", "trusted": "calibration: {online: false}"}


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "cameras",
        help="accuracy of the named rigs in the same scenes",
        description="Runs simulated scenes with the cameras of each rig that has a name, with exact calibration files, "
        "which the odometry checks by its self-calibration or takes for exact; then those of other cameras than the "
        "paper's, and the paper's cameras each by itself.",
        epilog="Example: scripts/benchmark cameras --scenes room --seeds 1",
    )
    parser.add_argument("--scenes", nargs="+", default=["room", "corridor"], choices=SCENE_NAMES, metavar="NAME")
    parser.add_argument(
        "--rigs", nargs="*", default=list(_RIGS), choices=_RIGS, metavar="NAME", help="of the paper's cameras"
    )
    parser.add_argument(
        "--own-rigs",
        nargs="*",
        default=[_SINGLES, *_OWN_RIGS],
        choices=(_SINGLES, *_OWN_RIGS),
        metavar="NAME",
        help="rendered by themselves",
    )
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="number of recordings (default: 3)")
    parser.add_argument("--duration", type=float, metavar="S", help="only so much of each walk")
    add_report_options(parser)
    add_data_option(parser)
    parser.set_defaults(run=run_all)


def run_all(args: argparse.Namespace) -> None:
    """Measure the accuracy of all rigs, and report."""
    if args.seeds < 1:
        raise GraphvioError("--seeds must be at least 1")
    report = Report()
    report.add(machine())
    if args.rigs:
        _compare(args, report)
    if args.own_rigs:
        _measure_own(args, report)
    report.write(args, "cameras")


def _compare(args: argparse.Namespace, report: Report) -> None:
    """Add the table of the rigs that share one recording."""
    rigs, rows = [_BASE, *(name for name in args.rigs if name != _BASE)], []
    for scene in args.scenes:
        folders = [_rendered(args, scene, seed) for seed in range(args.seeds)]
        for calibration, text in _CONFIGS.items():
            ates_mm = {name: [_ate_of(folder, name, Config.from_yaml(text)) for folder in folders] for name in rigs}
            base = median(ates_mm[_BASE])
            rows += [
                (scene, calibration, name, f"{median(each):.2f}", f"{max(each):.2f}", f"{median(each) / base:.2f}")
                for name, each in ates_mm.items()
            ]
    report.table(("scene", "calibration", "rig", "ATE, mm, median", "worst", f"over {_BASE}"), rows)


def _measure_own(args: argparse.Namespace, report: Report) -> None:
    """Add the table of the rigs with their own recordings, and of single cameras, whose scale comes from the IMU."""
    rows = []
    for scene in args.scenes:
        for name in args.own_rigs:
            runs = []
            for seed in range(args.seeds):
                folder = _rendered(args, scene, seed, "paper" if name == _SINGLES else name)
                rig = open_source(folder).rig
                runs.append(run(folder, rig.without_pairs() if name == _SINGLES else rig, Config()))
            ates = [each.ate_position_m.rmse if each is not None else float("inf") for each, _ in runs]
            shares = [
                float("inf") if each is None or each.ate_percent is None else each.ate_percent for each, _ in runs
            ]
            posed = min(share for _, share in runs)
            rows.append(
                (scene, name, f"{1e3 * median(ates):.1f}", f"{1e3 * max(ates):.1f}", f"{median(shares):.3f}",
                 f"{100.0 * posed:.0f}")
            )  # fmt: skip
    report.table(("scene", "rig", "ATE, mm, median", "worst", "share of the path, %", "with pose, %, worst"), rows)


def _rendered(args: argparse.Namespace, scene: str, seed: int, rig: str = "paper") -> Path:
    variant = f"seed{seed}" if args.duration is None else f"{args.duration:g}s-seed{seed}"
    return rendered_once(
        args.data,
        scene,
        variant if rig == "paper" else f"{rig}-{variant}",
        lambda folder: simulate(scene, folder, seed=seed, duration_s=args.duration, rig=NAMED_RIGS[rig]()),
    )


def _ate_of(folder: Path, name: str, config: Config) -> float:
    wanted = [camera.name for camera in NAMED_RIGS[name]().cameras]
    return ate_mm(folder, open_source(folder).rig.with_only(wanted), config)


def ate_mm(folder: Path, rig: Rig, config: Config, from_s: float = 0.0) -> float:
    """Run the odometry with a rig and return the ATE of the causal trajectory, millimetres; infinite without poses."""
    evaluation, _ = run(folder, rig, config, from_s)
    return float("inf") if evaluation is None else 1e3 * evaluation.ate_position_m.rmse


def run(folder: Path, rig: Rig, config: Config, from_s: float = 0.0) -> tuple[Evaluation | None, float]:
    """Run the odometry with a rig; return the causal trajectory's errors, or None without poses, and the share of
    framesets that have a pose."""
    source = open_source(folder, rig, from_s=from_s)
    assert source.truth is not None
    warm_up(source.rig, config)
    odometry = Odometry(source.rig, config)
    estimates = [estimate for estimate in map(odometry.process, source) if estimate is not None]
    estimates += odometry.finish()
    posed = [estimate for estimate in estimates if estimate.nav_T_body is not None]
    share = len(posed) / max(len(estimates), 1)
    try:
        poses: Float = np.array([estimate.nav_T_body for estimate in posed]).reshape(-1, 4, 4)
        trajectory = Trajectory(np.array([estimate.stamp_ns for estimate in posed], dtype=np.int64), poses)
        return evaluate(trajectory, load_trajectory(source.truth)), share
    except TrajectoryError:
        return None, share
