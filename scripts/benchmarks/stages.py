"""``scripts/benchmark stages``: processor time per frameset by stage, on which other programs have little effect."""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.command_line import add_report_options
from benchmarks.recordings import Footage, add_data_option, simulated
from benchmarks.report import IMAGES, Report, log_progress, machine, writing
from benchmarks.timing import WARM_UP
from graphvio import timing
from graphvio.config import Config
from graphvio.odometry import Odometry
from graphvio.warmup import warm_up

_RATE_HZ = 20
_WITHIN_TRACK = ("pyramid", "register", "flow", "stereo")
_ALL = "the process, all threads"


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "stages",
        help="processor time of a frameset by stage",
        description="Runs the odometry on decoded images and reports the processor time of each stage, in the thread "
        "that waits for it, and of all threads together. Draws the median and the 99th percentile.",
        epilog="Example:  scripts/benchmark stages --recording recording --framesets 200",
    )
    parser.add_argument("--recording", type=Path, metavar="DIR", help="of this recording (default: a simulated room)")
    parser.add_argument("--framesets", type=int, default=200, metavar="N", help="counted framesets (default: 200)")
    parser.add_argument("--profile", default="default", metavar="NAME", help="configuration, by name or YAML file")
    add_report_options(parser)
    add_data_option(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Measure the times, and report and draw them."""
    count = WARM_UP + args.framesets
    folder = args.recording or simulated(args.data, "room", math.ceil((count + 1) / _RATE_HZ))
    log_progress("decoding")
    footage, config = Footage.load(folder, count), Config.load(args.profile)
    log_progress("compiling")
    warm_up(footage.rig, config)
    times = _times_ms(footage, config)
    report = Report()
    report.add(machine())
    width, height = footage.rig.pairs[0].left.size_px
    report.add(
        f"{len(times[_ALL])} framesets, {len(footage.rig.pairs)} pairs of {width}x{height} pixels, "
        f"{'with' if footage.rig.imu else 'without'} IMU: milliseconds of processor time."
    )
    rows = [[name, *(f"{t:.2f}" for t in (*np.percentile(ms, (50, 99)), np.mean(ms)))] for name, ms in times.items()]
    report.table(["stage", "median", "p99", "mean"], rows)
    report.write(args, "stages")
    if args.docs:
        draw(IMAGES / "stage-times.png", times)


def _times_ms(footage: Footage, config: Config) -> dict[str, list[float]]:
    """Return the processor times of each counted frameset, milliseconds: by stage, and of all threads together."""
    timing.clock = time.thread_time  # the stages' own stopwatches then count processor time
    odometry, times = Odometry(footage.rig, config), dict[str, list[float]]()
    try:
        for index, step in enumerate(footage.steps):
            start, stages = time.process_time(), dict[str, float]()
            for measurement in step:
                estimate = odometry.process(measurement)
                stages = stages if estimate is None else dict(estimate.stage_ms)
            stages[_ALL] = 1e3 * (time.process_time() - start)
            if index >= WARM_UP:
                for name, ms in stages.items():
                    times.setdefault(name, []).append(ms)
    finally:
        odometry.finish()
        timing.clock = time.perf_counter
    return times


def draw(path: Path, times: dict[str, list[float]]) -> None:
    """Draw a bar for each stage, with the median and a line up to the 99th percentile.

    Raises:
        GraphvioError: if the picture cannot be written.
    """
    names = list(times)[::-1]
    medians, highs = np.array([np.percentile(times[name], (50, 99)) for name in names]).T
    figure = Figure(figsize=(8.0, 3.6), dpi=110, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.barh(names, medians, xerr=[np.zeros_like(medians), highs - medians], color="#1f5fbf", capsize=3)
    axes.set_yticks(range(len(names)), [f"in track: {name}" if name in _WITHIN_TRACK else name for name in names])
    axes.set_xlabel("processor time of a frameset, ms: median, and line to the 99th percentile")
    axes.grid(axis="x", alpha=0.3)
    with writing(path):
        figure.savefig(path, metadata={"Software": None})
