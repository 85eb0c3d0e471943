"""``scripts/benchmark startup``: the time until the first pose, with compiled kernels and without."""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import NamedTuple

from benchmarks.command_line import Subparsers, add_command, add_report_options
from benchmarks.recordings import add_data_option, simulated
from benchmarks.report import Report, log_progress, machine
from graphvio.errors import GraphvioError

_RECORDED_S = 12.0  # seconds of the recording; other benchmarks use the same one
_PARTS = ("import", "open", "kernels", "first pose")
_COMMANDS = {
    "`import graphvio`": (["-c", "import graphvio"], None),
    "`graphvio --help`": (["-c", "from graphvio.cli import main; main()", "--help"], 0.15),
    "`graphvio doctor`": (["-c", "from graphvio.cli import main; main()", "doctor"], 0.5),
}


class _Case(NamedTuple):
    """Sensors that are used, and the aims in seconds for the first pose with compiled kernels (warm) and without."""

    name: str
    pairs: str
    imu: str
    aim_warm_s: float
    aim_cold_s: float | None


_CASES = (
    _Case("one pair, no IMU", "0", "no", 1.0, None),
    _Case("two pairs, IMU", "0,1", "yes", 1.5, 30.0),
)


class _Timed(NamedTuple):
    output: str
    wall_s: float
    cpu_s: float


def add_parser(subparsers: Subparsers) -> None:
    """Add the subcommand."""
    parser = add_command(
        subparsers, "startup", "time until the first pose, with compiled kernels and without", __doc__, run
    )
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="warm ones of each kind (default: 5)")
    parser.add_argument("--no-cold", action="store_true", help="leave out the start that compiles everything")
    add_report_options(parser)
    add_data_option(parser)


def run(args: argparse.Namespace) -> None:
    """Measure the times and report them next to the aims."""
    if args.rounds < 1:
        raise GraphvioError("--rounds: give one or more")
    recording = simulated(args.data, "room", _RECORDED_S)
    report = Report()
    report.add(machine())
    report.add(
        "Each row is of processes of their own. *Import* is that of what `graphvio run` uses, *open* reads the index "
        "of the recording and the rig, *kernels* compiles them or loads them from the cache, *first pose* is from the "
        f"first measurement to the first estimate that has a pose. Medians of {args.rounds} with a warm cache."
    )
    rows = []
    for case in _CASES:
        _first_pose(recording, case, None)  # compiles the kernels that are missing
        laps = [_first_pose(recording, case, None) for _ in range(args.rounds)]
        typical = {part: median(lap[part] for lap in laps) for part in _PARTS}
        rows.append(_row(f"warm, {case.name}", typical, case.aim_warm_s))
        log_progress(f"warm: {case.name}")
    if not args.no_cold:
        case = _CASES[-1]
        with tempfile.TemporaryDirectory() as empty:
            laps_s = _first_pose(recording, case, empty)
        rows.append(_row(f"cold, {case.name}", laps_s, case.aim_cold_s))
        with tempfile.TemporaryDirectory() as empty:
            whole = _timed(["-c", "from graphvio.cli import main; main()", "warmup"], empty)
    report.table(["start", *(f"{part}, s" for part in _PARTS), "sum, s", "aim, s", "result"], rows)
    if not args.no_cold:
        report.add(
            "`graphvio warmup` with an empty cache, for all kinds of rigs and with the self-calibration: "
            f"{whole.wall_s:.0f} s, {whole.cpu_s:.0f} s of processor time."
        )
    commands = []
    for name, (command, aim_s) in _COMMANDS.items():
        seconds = median(_timed(command, None).wall_s for _ in range(args.rounds))
        commands.append([name, f"{seconds:.2f}", *_judged(seconds, aim_s)])
    report.table(["command", "s", "aim, s", "result"], commands)
    report.write(args, "startup")


def _row(name: str, laps_s: Mapping[str, float], aim_s: float | None) -> list[str]:
    total = sum(laps_s.values())
    cells = [f"{laps_s[part]:.2f}" for part in _PARTS]
    return [name, *cells, f"{total:.1f}", *_judged(total, aim_s)]


def _judged(seconds: float, aim_s: float | None) -> tuple[str, str]:
    if aim_s is None:
        return "", ""
    return f"{aim_s:g}", "met" if seconds <= aim_s else "missed"


def _first_pose(recording: Path, case: _Case, cache: str | None) -> dict[str, float]:
    timed = _timed(["-m", "benchmarks.first_estimate", str(recording), case.pairs, case.imu], cache)
    laps_s: dict[str, float] = json.loads(timed.output)
    return laps_s


def _timed(arguments: Sequence[str], cache: str | None) -> _Timed:
    """Run Python in a new process, with the user's cache of kernels or another folder."""
    environment = dict(os.environ) if cache is None else {**os.environ, "GRAPHVIO_CACHE_DIR": cache}
    before, start_s = resource.getrusage(resource.RUSAGE_CHILDREN), perf_counter()
    done = subprocess.run(
        [sys.executable, *arguments], env=environment, capture_output=True, text=True, check=False
    )  # fmt: skip
    wall_s, after = perf_counter() - start_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode != 0:
        raise GraphvioError(f"{' '.join(arguments)}: {done.stderr.strip()}")
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return _Timed(done.stdout, wall_s, cpu_s)
