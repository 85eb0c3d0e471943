"""``scripts/benchmark decoding``: time of decoding PNG files, next to OpenCV's decoder, and during the odometry."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from benchmarks.command_line import add_report_options
from benchmarks.recordings import add_data_option, simulated
from benchmarks.report import Report, log_progress, machine
from graphvio.arrays import AnyArray
from graphvio.config import Config
from graphvio.image_decoding import decode_grey
from graphvio.measurements.sensors import FrameSet
from graphvio.odometry import Odometry
from graphvio.runtime import set_up_threads
from graphvio.sources import open_source
from graphvio.warmup import warm_up

_ROUNDS = 5
_DURATION_S = 20.0
_UNTIMED = 40  # framesets at the beginning of a replay that are not timed


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "decoding",
        help="decoding of PNG files, beside OpenCV's and beside the odometry",
        description="Decodes the PNG files of a recording in rounds, in turns with OpenCV, and compares processor "
        "times and pixels. Then runs the odometry on the recording, whose images are decoded in threads and in a "
        "process of its own, in turns.",
        epilog="Example:  scripts/benchmark decoding --recording recording",
    )
    parser.add_argument("--recording", type=Path, metavar="DIR", help="of this recording (default: a simulated room)")
    parser.add_argument("--images", type=int, default=200, metavar="N", help="images of each round (default: 200)")
    add_report_options(parser)
    add_data_option(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Measure the decoding times, and report."""
    folder = args.recording or simulated(args.data, "room", _DURATION_S)
    files = [path.read_bytes() for path in sorted(folder.glob("**/*.png"))[: args.images]]
    decoders: dict[str, Callable[[bytes], AnyArray]] = {
        "graphvio": lambda data: decode_grey(data, "a file"),
        "OpenCV": lambda data: np.asarray(cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)),
    }
    ours, reference = decoders.values()
    are_equal = all(np.array_equal(ours(data), reference(data)) for data in files)
    rounds = np.array([[_ms_of_one(decode, files) for decode in decoders.values()] for _ in range(_ROUNDS)])
    medians = np.median(rounds, axis=0)
    report = Report()
    report.add(machine())
    report.add(f"{len(files)} images, {_ROUNDS} rounds in turns; pixels are {'equal' if are_equal else 'NOT equal'}.")
    rows = [[name, f"{ms:.2f}", f"{ms / medians[1]:.2f}"] for name, ms in zip(decoders, medians, strict=True)]
    report.table(["decoder", "median, ms of processor time", "ratio"], rows)
    _add_replays(report, folder)
    report.write(args, "decoding")


def _ms_of_one(decode: Callable[[bytes], AnyArray], files: list[bytes]) -> float:
    """Return the processor time for decoding one file, milliseconds."""
    start = time.process_time()
    for data in files:
        decode(data)
    return 1e3 * (time.process_time() - start) / len(files)


def _add_replays(report: Report, folder: Path) -> None:
    """Add the table of the odometry's times while images are decoded in the same process or in another one."""
    config = Config.load("default")
    warm_up(open_source(folder).rig, config)
    set_up_threads()
    times = []
    for number in range(_ROUNDS):
        log_progress(f"replay {number + 1} of {_ROUNDS}")
        times.append([_ms_of_a_frameset(folder, config, in_process) for in_process in (False, True)])
    medians = np.median(times, axis=0)
    report.add(f"The odometry from files: the mean time of a frameset, median of {_ROUNDS} replays in turns.")
    rows = [
        [name, f"{ms:.1f}", f"{1e3 / ms:.0f}", f"{ms / medians[0]:.2f}"]
        for name, ms in zip(("threads", "a process"), medians, strict=True)
    ]
    report.table(["decoded in", "wall time, ms", "framesets/s", "ratio"], rows)


def _ms_of_a_frameset(folder: Path, config: Config, in_process: bool) -> float:
    """Return the mean wall time per frameset when a recording is processed as fast as possible, milliseconds."""
    source = open_source(folder)
    source.decodes_in_process = in_process
    odometry = Odometry(source.rig, config)
    begun = framesets = 0
    for measurement in source:
        if isinstance(measurement, FrameSet):
            if framesets == _UNTIMED:
                begun = time.perf_counter_ns()
            framesets += 1
        odometry.process(measurement)
    ended = time.perf_counter_ns()
    odometry.finish()
    return 1e-6 * (ended - begun) / (framesets - _UNTIMED)
