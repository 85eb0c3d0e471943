"""``scripts/campaign random-rigs``: accuracy with randomly sampled rigs, with exact and with wrong calibration files.

Each rig has none to three pairs and none to four single cameras with any lens model, field of view, position and
direction, baselines of 3 to 25 cm, 8 to 40 Hz, pairs triggered together or apart, global or rolling shutters, and an
IMU with up to eight times the usual noise. It is carried through one of the simulator's scenes, and the odometry begins
at a standstill or in the middle of the motion. It runs with the exact calibration and with one that is wrong at level
1, 2 or 3 in turn. All poses count, including those before the calibration is known.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
from benchmarks.calibration_cases import EXACT
from benchmarks.calibration_runs import CalibrationOutcome, WronglyCalibrated
from benchmarks.command_line import Subparsers, add_command, add_report_options
from benchmarks.recordings import add_data_option, rendered_once
from benchmarks.report import Report, log_progress, machine

from campaigns import random_rig_cases
from campaigns.random_rig_cases import MAX_BEGIN_S, RandomRig, sample_rig
from graphvio.config import Config
from graphvio.errors import GraphvioError
from graphvio.measurements.events import EventKind
from graphvio.simulation import simulate
from graphvio.simulation.calibration_error import LEVELS, CalibrationErrorSizes
from graphvio.sources import open_source
from graphvio.trajectory_files import load_trajectory

_HEAD = ("rig", "sampled", "path, m", "files", "ATE, cm", "ATE, %", "poses, %", "epochs", "NEES", "events")
_NOTABLE = (
    EventKind.IMU_LEFT_OUT,
    EventKind.IMU_CLOCK_OFF,
    EventKind.EXTRINSICS_OFF,
    EventKind.CALIBRATION_CHANGED,
    EventKind.GATE_RESET,
    EventKind.LOST,
    EventKind.WINDOW_REBUILT,
    EventKind.NOT_INITIALISED,
)
"""Events that should not occur with exact files, since nothing fails or jumps here. An exception is that single cameras
may need a long time to initialise."""


_KINDS: dict[str, Callable[[RandomRig], bool]] = {
    "with pairs": lambda sampled: bool(sampled.rig.pairs),
    "of single cameras": lambda sampled: not sampled.rig.pairs,
    "with rolling shutters": lambda sampled: sampled.rig.cameras[0].readout_ns > 0,
    "from motion on": lambda sampled: sampled.begin_s > 0.0,
}


class _Result(NamedTuple):
    seed: int
    sampled: RandomRig
    level: int
    path_m: float
    outcome: CalibrationOutcome

    @property
    def ate_percent(self) -> float:
        """ATE as a percentage of the path's length."""
        return 100.0 * self.outcome.ate_m / self.path_m

    @property
    def cells(self) -> list[str]:
        """The cells of a table's row below `_HEAD`."""
        outcome = self.outcome
        events = [f"{kind} {outcome.events[kind]}" for kind in _NOTABLE if kind in outcome.events]
        return [
            str(self.seed),
            self.sampled.summary,
            f"{self.path_m:.1f}",
            "exact" if self.level == EXACT else f"level {self.level}",
            f"{100 * outcome.ate_m:.2f}",
            f"{self.ate_percent:.3f}",
            f"{outcome.posed_percent:.0f}",
            f"{outcome.epochs}",
            f"{outcome.pose_nees:.1f}",
            ", ".join(events) or "-",
        ]


def add_parser(subparsers: Subparsers) -> None:
    """Add ``random-rigs``."""
    parser = add_command(subparsers, "random-rigs", "any rig, with exact and with wrong files", __doc__, main)
    parser.add_argument("--rigs", type=int, default=24, metavar="N", help="how many (default: 24)")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="number of the first (default: 0)")
    parser.add_argument("--duration", type=float, default=16.0, metavar="S", help="of each walk (default: 16)")
    add_report_options(parser)
    add_data_option(parser)


def main(args: argparse.Namespace) -> None:
    """Run the campaign and report."""
    if args.rigs < 1 or args.first < 0 or not args.duration > MAX_BEGIN_S + 1.0:
        raise GraphvioError(
            f"--rigs must be 1 or more, --first not negative, and --duration more than {MAX_BEGIN_S + 1.0:g}"
        )
    report = Report()
    report.add(machine())
    results: list[_Result] = []
    for seed in range(args.first, args.first + args.rigs):
        for result in _run(args, seed):
            log_progress(" | ".join(result.cells))
            results.append(result)
    report.table(_HEAD, [result.cells for result in results])
    for of, is_one in _KINDS.items():
        _summarise(report, of, [result for result in results if is_one(result.sampled)])
    report.write(args, "random-rigs")


def _run(args: argparse.Namespace, seed: int) -> list[_Result]:
    """Run the rig of a seed, and return the results with exact and with wrong files."""
    sampled = sample_rig(seed)
    render = partial(
        simulate,
        sampled.scene,
        duration_s=args.duration,
        rate_hz=sampled.rate_hz,
        trigger_offset_ms=sampled.trigger_offset_ms,
        rig=sampled.rig,
    )
    variant, sampler = f"random-{seed}-{args.duration:g}s", Path(random_rig_cases.__file__)
    folder = rendered_once(args.data, sampled.scene, variant, render, sampler)
    truth = open_source(folder).truth
    assert truth is not None
    walked = load_trajectory(truth)
    since_ns = walked.stamps_ns[0] + round(1e9 * sampled.begin_s)
    positions, results = walked.nav_T_body[walked.stamps_ns >= since_ns, :3, 3], []
    path_m = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    for level in (EXACT, LEVELS[seed % len(LEVELS)]):
        error = CalibrationErrorSizes() if level == EXACT else CalibrationErrorSizes.of_level(level)
        walk = WronglyCalibrated(folder, sampled.scene, args.duration, None, error, seed, sampled.begin_s)
        results.append(_Result(seed, sampled, level, path_m, walk.run(Config.load("default"), lambda rig: rig)))
    return results


def _summarise(report: Report, of: str, results: list[_Result]) -> None:
    for name in ("exact", "wrong"):
        if chosen := [result for result in results if (result.level == EXACT) == (name == "exact")]:
            percents = sorted(result.ate_percent for result in chosen)
            least = min(result.outcome.posed_percent for result in chosen)
            report.add(
                f"{len(chosen)} rigs {of}, {name} files: ATE {median(percents):.3f} % of the path in the median, "
                f"{percents[-1]:.3f} % at worst; poses of at least {least:.0f} % of the framesets."
            )
