"""``scripts/benchmark frontend``: time of each stage of the front-end, next to a plain pipeline of OpenCV functions."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.backend import AIM_MS as BACKEND_AIM_MS
from benchmarks.backend import AIM_P99_MS as BACKEND_AIM_P99_MS
from benchmarks.command_line import add_report_options
from benchmarks.growth import add_growth
from benchmarks.recordings import Footage, add_data_option, simulated
from benchmarks.report import Report, log_progress, machine
from benchmarks.timing import (
    WARM_UP,
    Contender,
    FrontendContender,
    OdometryContender,
    ReferenceContender,
    Timings,
    take_turns,
)
from graphvio.config import Config
from graphvio.errors import GraphvioError
from graphvio.rig import Rig
from graphvio.runtime import set_up_threads
from graphvio.warmup import warm_up

AIM = 0.35
"""Aim for the front-end's median time over the reference's, for two pairs; of several rounds, the median ratio."""
AIM_MS = 10.0
"""Aim for the median time of the complete odometry, from decoded images to the estimate, for two pairs of `AIM_SIZE_PX`
on 2 cores."""
AIM_SIZE_PX = (640, 480)
BACKEND_STAGES = ("predict", "update")
_SHORTEST_S = 12
_RATE_HZ = 20
_MIN_FRAMESETS = 10


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "frontend",
        help="time of every stage, and of a pipeline of OpenCV's functions",
        description="Times the odometry, its front-end alone and a plain pipeline of OpenCV's functions in turns on "
        "the same images, which are decoded before. Prints medians, 95th and 99th percentiles for each stage, and "
        "how the front-end's time grows with features, hypotheses, pairs and image size.",
        epilog="Examples:  scripts/benchmark frontend --out speed.md  |  scripts/benchmark frontend --docs",
    )
    parser.add_argument(
        "--recording", type=Path, metavar="DIR", help="time it on this recording (default: a simulated room)"
    )
    parser.add_argument(
        "--framesets", type=int, default=200, metavar="N", help="counted framesets of a round (default: 200)"
    )
    parser.add_argument(
        "--rounds", type=int, default=7, metavar="N", help="how often they are worked through (default: 7)"
    )
    parser.add_argument(
        "--growth-framesets", type=int, default=80, metavar="N", help="the same for each row of growth (default: 80)"
    )
    parser.add_argument("--no-growth", action="store_true", help="leave out the tables of growth")
    parser.add_argument("--profile", default="default", metavar="NAME", help="configuration, by name or YAML file")
    add_report_options(parser)
    add_data_option(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Measure the times and report them next to the aims."""
    if min(args.framesets, args.growth_framesets) < _MIN_FRAMESETS or args.rounds < 1:
        raise GraphvioError(f"percentiles need framesets: give {_MIN_FRAMESETS} or more, and at least one round")
    set_up_threads()  # as commands do; each contender then sets its number of OpenCV's threads
    config = Config.load(args.profile)
    count = WARM_UP + args.framesets
    longest = count if args.no_growth else max(count, WARM_UP + args.growth_framesets)
    folder = args.recording
    if folder is None:
        folder = simulated(args.data, "room", max(_SHORTEST_S, math.ceil((longest + 1) / _RATE_HZ)))
    log_progress("decoding")
    footage = Footage.load(folder, longest)
    if len(footage.steps) < WARM_UP + _MIN_FRAMESETS:
        raise GraphvioError(f"{folder}: has {len(footage.steps)} framesets; {WARM_UP + _MIN_FRAMESETS} are needed")
    log_progress("compiling")
    warm_up(footage.rig, config)  # for all processes
    report = Report()
    report.add(machine())
    title = "a simulated room" if args.recording is None else "a recording"
    _stages(report, footage, folder, args, title)
    if not args.no_growth:
        add_growth(report, footage, config, args.growth_framesets)
    report.write(args, "frontend")


class _Round(NamedTuple):
    """Result of one round.

    Attributes:
        whole: times of the complete odometry.
        ours: times of the front-end alone.
        theirs: times of the reference.
        tracks: mean number of the front-end's tracks for each pair.
        points: mean number of the front-end's candidate points for each pair.
        failures: number of framesets in which the front-end found no motion.
        candidates: mean number of the reference's candidate points for each pair.
        inliers: share of the inliers among them.
    """

    whole: Timings
    ours: Timings
    theirs: Timings
    tracks: float
    points: float
    failures: int
    candidates: float
    inliers: float


def _round(folder: Path, count: int, profile: str) -> _Round:
    """Time the three pipelines in turns."""
    footage, config = Footage.load(folder, count), Config.load(profile)
    warm_up(footage.rig, config)
    frontend, reference = FrontendContender(footage, config), ReferenceContender(footage)
    contenders: list[Contender] = [OdometryContender(footage, config), frontend, reference]
    whole, ours, theirs = take_turns(contenders, len(footage.steps))
    pipeline = reference.pipeline
    return _Round(
        whole,
        ours,
        theirs,
        float(np.mean(frontend.tracks)),
        float(np.mean(frontend.points)),
        frontend.failures,
        float(np.mean(pipeline.tracked)),
        float(np.sum(pipeline.inliers) / max(np.sum(pipeline.tracked), 1)),
    )


def _stages(report: Report, footage: Footage, folder: Path, args: argparse.Namespace, title: str) -> None:
    whole, ours, theirs = Timings(), Timings(), Timings()
    rounds: list[_Round] = []
    # Each round has its own process: the speed of OpenCV's threads differs between processes as much as over time.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        for number in range(args.rounds):
            log_progress(f"timing odometry, front-end and reference in turns, round {number + 1} of {args.rounds}")
            rounds.append(pool.submit(_round, folder, WARM_UP + args.framesets, args.profile).result())
    for one in rounds:
        whole.add(one.whole)
        ours.add(one.ours)
        theirs.add(one.theirs)
    last, (width, height) = rounds[-1], footage.rig.pairs[0].left.size_px
    report.add(
        f"{len(rounds)} rounds of {len(last.whole.total_ms)} framesets of {title}, {len(footage.rig.pairs)} pairs of "
        f"{width}x{height} pixels, "
        f"{'with' if footage.rig.imu else 'without'} IMU. The front-end followed {last.tracks:.0f} tracks "
        f"a pair, {last.points:.0f} of them with depth and in the reference frameset, and found no motion "
        f"in {last.failures} framesets; the reference had {last.candidates:.0f} candidate points a pair, of "
        f"which {100 * last.inliers:.0f} % were inliers."
    )
    ratios = [one.ours.median_ms / one.theirs.median_ms for one in rounds]
    rows = [
        *_rows("odometry", whole),
        *_rows("front-end alone", ours),
        *_rows("reference", theirs),
    ]
    report.table(["pipeline", "stage", "median, ms", "p95, ms", "p99, ms", "framesets"], rows)
    _aims(report, footage.rig, ratios, whole, theirs.median_ms)


def _aims(report: Report, rig: Rig, ratios: Sequence[float], odometry: Timings, reference_ms: float) -> None:
    """Report the results next to the aims, which are for two pairs of one size."""
    has_aims = len(rig.pairs) == 2 and all(pair.left.size_px == AIM_SIZE_PX for pair in rig.pairs)

    def aim_result(value: float, aim: float, unit: str = "") -> str:
        return f"{aim:g}{unit}: {'met' if value <= aim else 'missed'}" if has_aims else "-"

    ratio, odometry_ms = float(np.median(ratios)), odometry.median_ms
    backend_ms = [sum(parts) for parts in zip(*(odometry.stage_ms[name] for name in BACKEND_STAGES), strict=True)]
    median_ms, p99_ms = map(float, np.percentile(backend_ms, (50, 99)))
    each = ", ".join(f"{value:.2f}" for value in sorted(ratios))
    report.table(
        ["medians", "value", "aim"],
        [
            [f"front-end / reference, median of the rounds' ({each})", f"{ratio:.2f}", aim_result(ratio, AIM)],
            ["odometry / reference", f"{odometry_ms / reference_ms:.2f}", "-"],
            ["odometry, a frameset", f"{odometry_ms:.1f} ms", aim_result(odometry_ms, AIM_MS, " ms")],
            [
                f"back-end in it ({' and '.join(BACKEND_STAGES)})",
                f"{median_ms:.2f} ms",
                aim_result(median_ms, BACKEND_AIM_MS, " ms"),
            ],
            ["the same, 99th percentile", f"{p99_ms:.2f} ms", aim_result(p99_ms, BACKEND_AIM_P99_MS, " ms")],
        ],
    )


def _rows(name: str, timings: Timings) -> list[list[str]]:
    """Return a row for each stage, in order of appearance, and one for the total; stages may run in parallel."""
    stages = {**timings.stage_ms, "**total**": timings.total_ms}
    return [
        [
            name,
            stage,
            *(f"{value:.2f}" for value in np.percentile(values, (50, 95, 99))),
            f"{len(values)}",
        ]
        for stage, values in stages.items()
    ]
