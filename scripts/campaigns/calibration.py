"""``scripts/campaign calibration``: the accuracy of P_12, and its effect on the odometry.

There are three parts. Synthetic errors: 200 runs at each of several noise levels and shares of outliers, whose errors
are compared with the covariance. Images: two minutes of the scene ``calibration``, of which more and more framesets are
used. Odometry: every scene with the true rig, with the rig calibrated from these images, and with a rig that is 3
degrees and 5 cm wrong.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from benchmarks.command_line import add_command, add_report_options
from benchmarks.recordings import SCENES_OF_TWO_PAIRS, add_data_option, simulated
from benchmarks.report import Report, log_progress, machine
from benchmarks.runs import run, with_moved_pair
from scipy.stats import chi2

from campaigns.calibration_draws import PAIRS, Run, one_run
from graphvio.arrays import Float
from graphvio.calibration.calibrate import calibrate_pairs, segments_of_motions
from graphvio.calibration.camera_motions import SeparateMotions
from graphvio.calibration.pair_calibration import PairCalibration, calibrate_pair
from graphvio.calibration.result import Calibration
from graphvio.config import Config
from graphvio.errors import GraphvioError
from graphvio.geometry import se3_inverse, se3_log
from graphvio.sources import open_source

_NOISES = ((2e-4, 4e-4), (1e-3, 2e-3), (4e-3, 8e-3))  # sigmas of a motion over a third of a second: radians, metres
_OUTLIERS = (0.0, 0.3, 0.6)
_FRAMESETS = (50, 100, 200, 400, 800, 1600, 2400)
_SECONDS = 120.0
_WRONG_DEG, _WRONG_M = 3.0, 0.05
_HEAD = ("noise, mrad, mm", "outliers, %", "rotation, deg", "translation, mm", "paper's: rotation, deg",
         "translation, mm", "NEES of 6", "outliers kept, %", "inliers lost, %", "methods agree, %")  # fmt: skip
_GROWTH_HEAD = ("framesets", "rotation, deg", "sigma", "translation, mm", "sigma", "squared distance of 6",
                "motions that fit", "alignment error, mm", "paper's: rotation, deg", "translation, mm")  # fmt: skip
_ODOMETRY_HEAD = ("recording", "IMU", "true rig", "found rig", "found / true", "wrong rig", "wrong / true")


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``calibration``."""
    parser = add_command(subparsers, "calibration", "how well P_12 is found from motion", __doc__, main)
    parser.add_argument("--runs", type=int, default=200, help="runs of each case with synthetic errors (default: 200)")
    parser.add_argument(
        "--scenes", nargs="*", default=list(SCENES_OF_TWO_PAIRS), metavar="NAME", help="default: all of two pairs"
    )
    parser.add_argument("--jobs", type=int, default=2, help="runs side by side (default: 2)")
    add_data_option(parser)
    add_report_options(parser)


def main(args: argparse.Namespace) -> None:
    """Run the campaign and report."""
    if args.runs < 1 or args.jobs < 1:
        raise GraphvioError("--runs and --jobs must be 1 or more")
    report = Report()
    report.add(machine(), "", f"`--runs {args.runs}`.", "", "### Synthetic errors")
    low, high = chi2.ppf([0.025, 0.975], 6 * args.runs) / args.runs
    report.add(
        f"{PAIRS} pose pairs a run, along the walk of the scene `calibration`; root mean square errors. NEES of 6 has "
        f"its 95 % band at {low:.2f} to {high:.2f}.",
    )
    report.table(_HEAD, _synthetic(args.runs, args.jobs))
    recording = simulated(args.data, "calibration", _SECONDS)
    source = open_source(recording)
    whole, rows = _growth(recording)
    report.add(
        "### Framesets", f"From images: {_SECONDS:g} s of the scene `calibration`, {source.frameset_count} framesets."
    )
    report.table(_GROWTH_HEAD, rows)
    report.add(
        "### Odometry with the rig that was found",
        "ATE in mm, each epoch aligned by itself, with the true rig, with the one found from all these framesets, and "
        f"with one whose second pair is {_WRONG_DEG:g} degrees and {100 * _WRONG_M:g} cm from its place, which the "
        "odometry notices and corrects.",
    )
    report.table(_ODOMETRY_HEAD, _odometry(args.data, args.scenes, whole))
    report.write(args, "calibration")


def _synthetic(runs: int, jobs: int) -> list[list[str]]:
    rows = []
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for rotation_rad, translation_m in _NOISES:
            for share in _OUTLIERS:
                options = ([value] * runs for value in (rotation_rad, translation_m, share))
                made = list(pool.map(one_run, range(runs), *options))
                rows.append([f"{1e3 * rotation_rad:g}, {1e3 * translation_m:g}", f"{100 * share:g}", *_cells(made)])
                log_progress(" | ".join(rows[-1]))
    return rows


def _cells(runs: list[Run]) -> list[str]:
    def rms(values: list[float]) -> float:
        return float(np.sqrt(np.mean(np.square(values))))

    outliers = sum(each.outliers for each in runs)
    inliers = len(runs) * PAIRS - outliers
    return [
        f"{np.rad2deg(rms([each.rotation_rad for each in runs])):.4f}",
        f"{1e3 * rms([each.translation_m for each in runs]):.3f}",
        f"{np.rad2deg(rms([each.paper_rotation_rad for each in runs])):.4f}",
        f"{1e3 * rms([each.paper_translation_m for each in runs]):.3f}",
        f"{np.mean([each.square for each in runs]):.2f}",
        f"{100 * sum(each.outliers_kept for each in runs) / outliers:.2f}" if outliers else "-",
        f"{100 * sum(each.inliers_lost for each in runs) / inliers:.2f}",
        f"{100 * np.mean([each.agrees for each in runs]):.1f}",
    ]


def _growth(recording: Path) -> tuple[Calibration, list[list[str]]]:
    """Return the calibration from all framesets, and a row of the table for each number of framesets."""
    rows: list[list[str]] = []
    truth = open_source(recording).rig.left2_T_left1()

    def follow(number: int, separate: SeparateMotions) -> bool:
        if number in _FRAMESETS:
            rows.append(_growth_row(number, calibrate_pair(segments_of_motions(separate.motions())), truth))
            log_progress(" | ".join(rows[-1]))
        return False

    return calibrate_pairs(recording, on_frameset=follow), rows


def _growth_row(number: int, found: PairCalibration, truth: Float) -> list[str]:
    off, sigmas = found.apart(truth), np.sqrt(np.diag(found.covariance))
    paper = se3_log(se3_inverse(found.paper_left2_T_left1) @ np.ascontiguousarray(truth))
    fits = found.frame_inlier
    return [
        str(number),
        f"{np.rad2deg(np.linalg.norm(off[:3])):.4f}",
        f"{np.rad2deg(np.linalg.norm(sigmas[:3])):.4f}",
        f"{1e3 * np.linalg.norm(off[3:]):.2f}",
        f"{1e3 * np.linalg.norm(sigmas[3:]):.2f}",
        f"{found.distance(truth):.1f}",
        f"{int(fits.sum())} of {len(fits)}",
        f"{1e3 * found.frame_errors_m[fits].mean():.2f}",
        f"{np.rad2deg(np.linalg.norm(paper[:3])):.4f}",
        f"{1e3 * np.linalg.norm(paper[3:]):.2f}",
    ]


def _odometry(data: Path, scenes: list[str], found: Calibration) -> list[list[str]]:
    rows, totals = [], np.zeros((2, 3))
    for scene in scenes:
        recording = simulated(data, scene)
        true = open_source(recording).rig
        rigs = [true, found.calibrated_rig(), with_moved_pair(true, 1, _WRONG_DEG, _WRONG_M)]
        for without, used in ((True, [rig.without_imu() for rig in rigs]), (False, rigs)):
            log_progress(f"{scene}, {'cameras alone' if without else 'with the IMU'}")
            outcomes = [run(recording, rig, Config()) for rig in used]
            errors = np.array([1e3 * outcome.epoch_ate_m for outcome in outcomes])
            totals[int(without)] += errors
            rows.append(_odometry_row(scene, "no" if without else "yes", errors))
    for label, total in (("no", totals[1]), ("yes", totals[0])):
        rows.append(_odometry_row("sum", label, total))
    return rows


def _odometry_row(scene: str, imu: str, errors: Float) -> list[str]:
    true, right, wrong = errors
    return [scene, imu, f"{true:.2f}", f"{right:.2f}", f"{right / true:.2f}", f"{wrong:.2f}", f"{wrong / true:.2f}"]
