"""``scripts/benchmark decoding``: the processor time of decoding PNG files, beside OpenCV's decoder in turns."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from benchmarks.command_line import add_report_options
from benchmarks.recordings import add_data_option, simulated
from benchmarks.report import Report, machine
from graphvio.arrays import AnyArray
from graphvio.image_decoding import decode_grey

_ROUNDS = 5
_DURATION_S = 5.0


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "decoding",
        help="decoding of PNG files, beside OpenCV's",
        description="Decodes the PNG files of a recording in rounds, in turns with OpenCV, and compares processor "
        "times and pixels.",
        epilog="Example:  scripts/benchmark decoding --recording recording",
    )
    parser.add_argument("--recording", type=Path, metavar="DIR", help="of this recording (default: a simulated room)")
    parser.add_argument("--images", type=int, default=200, metavar="N", help="images of each round (default: 200)")
    add_report_options(parser)
    add_data_option(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Measure and report."""
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
    report.write(args, "decoding")


def _ms_of_one(decode: Callable[[bytes], AnyArray], files: list[bytes]) -> float:
    """Return the processor time of one image, in milliseconds."""
    start = time.process_time()
    for data in files:
        decode(data)
    return 1e3 * (time.process_time() - start) / len(files)
