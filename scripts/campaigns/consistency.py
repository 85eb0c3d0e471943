"""``scripts/campaign consistency``: NEES and NIS of the smoother over many runs.

Walks of the simulator's scenes are estimated many times, each time with different errors of the IMU, the initial state
and vision. Errors of vision are sampled from the covariances that the front-end reports on rendered images of a room.
In a second set of runs, the whole odometry processes rendered images, and only the IMU differs between runs.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from benchmarks.command_line import add_command
from benchmarks.recordings import add_data_option
from benchmarks.report import IMAGES, Report, log_progress, machine

from campaigns.measures import HEAD, Squares, rows
from campaigns.model_run import model_run
from campaigns.picture import draw_consistency
from campaigns.rendered_run import SHARED_ERROR_SHARE, WITHOUT_SHARE, rendered_run
from campaigns.synthetic_vision import Template, templates_of
from campaigns.walks import SCENES
from graphvio.errors import GraphvioError

NAMES = {
    "pose over 1 s": "relative pose over 1 s",
    "pose over 10 s": "relative pose over 10 s",
    "velocity": "velocity",
    "tilt": "roll and pitch",
    "gyro bias": "gyro bias",
    "accel bias": "accelerometer bias",
    "vision": "NIS of vision's motions",
}
SYNTHETIC_NAMES = NAMES | {"imu": "the preintegrated IMU at the true states"}
RENDERED_NAMES = NAMES | {f"pose over 10 s{WITHOUT_SHARE}": f"relative pose over 10 s{WITHOUT_SHARE}"}
_WHERE = "room"  # scene on whose images the front-end's covariances are measured


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``consistency``."""
    parser = add_command(subparsers, "consistency", "NEES and NIS over many runs", __doc__, main)
    parser.add_argument("--seeds", type=int, default=50, help="runs with synthetic errors (default: 50)")
    parser.add_argument("--rendered", type=int, default=3, help="runs of each rendered scene (default: 3)")
    parser.add_argument("--duration", type=float, default=25.0, metavar="S", help="seconds of a run (default: 25)")
    parser.add_argument("--jobs", type=int, default=2, help="runs side by side (default: 2)")
    parser.add_argument("--out", type=Path, metavar="FILE.md", help="write the report to this file, a plot next to it")
    parser.add_argument("--docs", action="store_true", help="write report and plot into docs/")
    add_data_option(parser)


def main(args: argparse.Namespace) -> None:
    """Run the campaign and report."""
    if args.seeds < 2 or args.rendered < 0 or args.jobs < 1 or args.duration < 20.0:
        raise GraphvioError("--seeds must be 2 or more, --rendered 0, --jobs 1 and --duration 20 or more")
    templates = templates_of(args.data, _WHERE)
    synthetic, rendered = Squares(), Squares()
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        tasks = [pool.submit(model_run, seed, templates, args.duration) for seed in range(args.seeds)]
        tasks += [
            pool.submit(rendered_run, seed, scene, args.data, args.duration)
            for scene in SCENES
            for seed in range(args.rendered)
        ]
        for number, task in enumerate(tasks):
            squares = synthetic if number < args.seeds else rendered
            for name, time_s, square, dimensions in task.result():
                squares.add_square(name, number, time_s, square, dimensions)
            log_progress(f"run {number + 1} of {len(tasks)}")
    report = Report()
    _write(report, args, synthetic, rendered, templates)
    if args.out is not None:
        report.save(args.out)
        draw_consistency(args.out.with_suffix(".png"), synthetic, NAMES)
    if args.docs:
        report.save_to_docs("consistency", "![NEES over time](../../images/consistency.png)")
        draw_consistency(IMAGES / "consistency.png", synthetic, NAMES)


def _write(
    report: Report, args: argparse.Namespace, synthetic: Squares, rendered: Squares, templates: dict[int, Template]
) -> None:
    report.add(
        machine(),
        "",
        f"`--seeds {args.seeds}`, `--rendered {args.rendered}`, `--duration {args.duration:g}`.",
        "",
        "Squared Mahalanobis distances: of a consistent estimator the mean is the number of dimensions. The band is "
        "that of the mean of all runs at one time; of the times, 95 % are expected in it.",
    )
    report.add(
        "### Errors sampled from the model",
        f"{args.seeds} runs on the walks of {', '.join(SCENES)}. Vision's covariances are those that the front-end "
        f"reported for {len(templates)} motions in the rendered {_WHERE}; errors of IMU, biases and initial state are "
        "sampled from the model of the smoother (`smoother.imu_noise_scale` 1). The last row compares the IMU from one "
        "frameset to the next with the true states. It is a little conservative: the mean of two samples has less "
        "noise than one, and some error of the integration is allowed for.",
    )
    report.table(HEAD, rows(synthetic, SYNTHETIC_NAMES))
    if args.rendered:
        report.add(
            "### Rendered images",
            f"The whole odometry, {args.rendered} IMUs on each of {', '.join(SCENES)}. The defaults allow for an IMU "
            "noisier than its data sheet, which the simulator does not have; here they do not "
            "(`smoother.imu_noise_scale` 1). `motion.shared_error_share` is "
            f"{SHARED_ERROR_SHARE:g}, as by default: it stands for errors of tracking that motions have in "
            "common, and was chosen on these recordings; a row shows the pose over 10 s with a share of 0. The initial "
            "covariance of the biases is wider than the simulator's biases are, so that less than the number of "
            "dimensions is expected of them and of the tilt. The aim is a factor of 2 for the others.",
        )
        report.table(HEAD, rows(rendered, RENDERED_NAMES))
