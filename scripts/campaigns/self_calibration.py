"""``scripts/campaign self-calibration``: errors of the calibration before and after a walk, and their covariance.

Each run samples a wrong calibration file and a walk through a cloud of points, without images: the tracks have white
noise and no outliers. The IMU has the time offset and the white noise of the level of calibration error; its scale is
exact.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np
from benchmarks.command_line import add_command, add_report_options
from benchmarks.report import Report, log_progress, machine
from scipy.stats import chi2
from walked_views import Walk, calibrated, true_difference

from graphvio.arrays import Float
from graphvio.errors import GraphvioError
from graphvio.self_calibration.imu_model import PARAMETERS, TIME_OFFSET
from graphvio.self_calibration.online import SelfCalibration
from graphvio.self_calibration.parameters import BODY, CAMERA, INTRINSICS, PAIR, STEREO, relative_to_first
from graphvio.simulation.calibration_error import LEVELS, CalibrationErrorSizes, draw
from graphvio.simulation.default_rig import default_rig

_COMPONENTS = (
    "focal", "principal-point", "distortion", "left-right-rotation", "baseline", "cameras-in-body", "pair-transform",
    "time-offset", "imu-noise",
)  # fmt: skip
_HEAD = ("level", "parameters", "before, RMS", "after, RMS", "worst", "NEES / dimension", "95 % band")
_CAMERAS = np.arange(2 * PAIR).reshape(2, PAIR)  # index of each parameter, by pair
_OF_CAMERA = np.concatenate([_CAMERAS[:, :CAMERA], _CAMERAS[:, CAMERA:STEREO]])


class _Group(NamedTuple):
    name: str
    rows: Float  # (n, C) matrix; its product with the C parameters are the quantities of the group
    scale: float  # factor to the unit in the name


class _Run(NamedTuple):
    before: dict[str, Float]
    after: dict[str, Float]
    nees: dict[str, float]  # NEES per dimension


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``self-calibration``."""
    parser = add_command(
        subparsers, "self-calibration", "what is found of wrong calibration files, and its covariance", __doc__, main
    )
    parser.add_argument("--seeds", type=int, default=50, metavar="N", help="runs of each level (default: 50)")
    parser.add_argument("--levels", type=int, nargs="+", default=list(LEVELS), metavar="N", help="default: all")
    parser.add_argument("--duration", type=float, default=40.0, metavar="S", help="of each walk (default: 40)")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="runs side by side (default: 2)")
    add_report_options(parser)


def main(args: argparse.Namespace) -> None:
    """Run the campaign and report."""
    if args.seeds < 1 or args.jobs < 1 or not args.duration > 0.0:
        raise GraphvioError("--seeds and --jobs must be 1 or more, and --duration positive")
    report = Report()
    report.add(
        machine(),
        f"{args.seeds} runs of {args.duration:g} s each. NEES is 1 where covariances are right, and less where they "
        "are cautious; its band is that of independent runs.",
    )
    rows = []
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        for level in args.levels:
            options = ([value] * args.seeds for value in (level, args.duration))
            runs = list(pool.map(_one_run, range(args.seeds), *options))
            of_level = [_row(level, group, runs) for group in _groups()]
            log_progress("\n".join(" | ".join(row) for row in of_level))
            rows += of_level
    report.table(_HEAD, rows)
    report.write(args, "self-calibration")


def _one_run(seed: int, level: int, duration_s: float) -> _Run:
    """Estimate a calibration from a walk, and compare it with the truth."""
    sampled = draw(default_rig(), CalibrationErrorSizes.of_level(level, list(_COMPONENTS)), seed)
    written, true = sampled.written_rig, sampled.true_rig
    found = calibrated(SelfCalibration(written), Walk(true, seed=seed), duration_s).estimate
    assert written.imu is not None
    assert true.imu is not None
    exact = np.zeros_like(found.difference)
    exact[: 2 * PAIR] = true_difference(written, true)
    exact[2 * PAIR + TIME_OFFSET] = true.imu.time_offset_s - written.imu.time_offset_s
    before, after, nees = {}, {}, {}
    for group in _groups():
        before[group.name] = group.scale * (group.rows @ exact)
        after[group.name] = group.scale * (group.rows @ (found.difference - exact))
        off, spread = group.rows @ (found.posterior.mean - exact), found.posterior.covariance
        nees[group.name] = float(off @ np.linalg.solve(group.rows @ spread @ group.rows.T, off)) / len(off)
    return _Run(before, after, nees)


def _groups() -> list[_Group]:
    every = np.eye(2 * PAIR + PARAMETERS)
    p_12 = np.zeros((6, len(every)))
    p_12[:, : 2 * PAIR] = relative_to_first(default_rig(), 1)
    degrees = float(np.rad2deg(1.0))
    return [
        _Group("focal lengths, px", every[_OF_CAMERA[:, :2].ravel()], 1.0),
        _Group("principal points, px", every[_OF_CAMERA[:, 2:INTRINSICS].ravel()], 1.0),
        _Group("k1, k2", every[_OF_CAMERA[:, INTRINSICS : INTRINSICS + 2].ravel()], 1.0),
        _Group("left-right rotation, deg", every[_CAMERAS[:, STEREO : STEREO + 3].ravel()], degrees),
        _Group("left-right translation, mm", every[_CAMERAS[:, STEREO + 3 : BODY].ravel()], 1e3),
        _Group("rotation of P_12, deg", p_12[:3], degrees),
        _Group("translation of P_12, mm", p_12[3:], 1e3),
        _Group("cameras in body, deg", every[_CAMERAS[0, BODY : BODY + 3]], degrees),
        _Group("cameras in body, mm", every[_CAMERAS[0, BODY + 3 : PAIR]], 1e3),
        _Group("time offset, ms", every[[2 * PAIR + TIME_OFFSET]], 1e3),
    ]


def _row(level: int, group: _Group, runs: list[_Run]) -> list[str]:
    before, after = (np.array([getattr(run, when)[group.name] for run in runs]) for when in ("before", "after"))
    dimension = before.size
    low, high = chi2.ppf([0.025, 0.975], dimension) / dimension
    return [
        str(level),
        group.name,
        f"{np.sqrt(np.mean(before**2)):.2g}",
        f"{np.sqrt(np.mean(after**2)):.2g}",
        f"{np.abs(after).max():.2g}",
        f"{np.mean([run.nees[group.name] for run in runs]):.2f}",
        f"{low:.2f} to {high:.2f}",
    ]
