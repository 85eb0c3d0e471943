"""``scripts/campaign lags``: the gain of a longer lag and more iterations over the paper's filter.

The paper's filter equals a factor graph of its model with a lag of one step and one iteration. Here lag and iterations
are increased, on simulated walks with sampled errors of vision and IMU, and without vision for one second in every
five. The odometry's smoother is compared with them on the same measurements.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
from benchmarks.command_line import add_command, add_report_options
from benchmarks.report import Report, log_progress, machine

from campaigns.paper_run import PaperRun, Track
from campaigns.walks import FRAMES_HZ
from graphvio.arrays import Float
from graphvio.config.stages import SmootherConfig
from graphvio.errors import GraphvioError

LAGS = ((1, 1), (1, 3), (5, 1), (5, 3), (20, 1), (20, 3))
_HEAD = ("estimator", "lag, steps", "iterations", "position, cm", "velocity, cm/s", "roll, pitch, deg", "heading, deg",
         "leaving: position, cm", "leaving: velocity, cm/s")  # fmt: skip


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``lags``."""
    parser = add_command(subparsers, "lags", "the paper's filter against windows of its model", __doc__, main)
    parser.add_argument("--seeds", type=int, default=50, help="runs (default: 50)")
    parser.add_argument("--duration", type=float, default=20.0, metavar="S", help="seconds of a run (default: 20)")
    parser.add_argument("--jobs", type=int, default=2, help="runs side by side (default: 2)")
    add_report_options(parser)


def main(args: argparse.Namespace) -> None:
    """Run the campaign and report."""
    if args.seeds < 1 or args.jobs < 1 or args.duration < 6.0:
        raise GraphvioError("--seeds and --jobs must be 1 or more, --duration 6 or more")
    tracks: dict[str, list[dict[str, Track]]] = defaultdict(list)
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        for seed, result in enumerate(pool.map(one_run, range(args.seeds), [args.duration] * args.seeds)):
            for name, track in result.items():
                tracks[name].append(track)
            log_progress(f"run {seed + 1} of {args.seeds}")
    report = Report()
    report.add(
        machine(),
        "",
        f"`--seeds {args.seeds}`, `--duration {args.duration:g}`. Root mean square errors against the truth, the start "
        "being known: of the newest state when it is reported, and of a state as it leaves the window.",
    )
    rows = [_row("filter", "1", "1", tracks["filter"])]
    rows += [_row("its graph", str(lag), str(n), tracks[f"{lag}, {n}"]) for lag, n in LAGS]
    lag = str(round(SmootherConfig().lag_s * FRAMES_HZ))
    rows.append(_row("the odometry's smoother", lag, "all states every third step", tracks["smoother"]))
    report.table(_HEAD, rows)
    report.write(args, "lags")


def one_run(seed: int, duration_s: float) -> dict[str, dict[str, Track]]:
    """Run all estimators on the same measurements.

    Returns:
        Name of the estimator -> errors of the states when they were ``newest``, and when ``leaving`` the window.
    """
    run = PaperRun(seed, duration_s)
    made = {"filter": run.by_filter(), "smoother": run.by_smoother()}
    return made | {f"{lag}, {iterations}": run.by_graph(lag, iterations) for lag, iterations in LAGS}


def _row(name: str, lag: str, iterations: str, runs: list[dict[str, Track]]) -> list[str]:
    newest, leaving = ([run[which] for run in runs] for which in ("newest", "leaving"))
    return [
        name,
        lag,
        iterations,
        _rms([100.0 * track.position_m for track in newest]),
        _rms([100.0 * track.velocity_m_s for track in newest]),
        _rms([np.rad2deg(track.tilt_rad) for track in newest]),
        _rms([np.rad2deg(track.heading_rad) for track in newest]),
        _rms([100.0 * track.position_m for track in leaving]),
        _rms([100.0 * track.velocity_m_s for track in leaving]),
    ]


def _rms(errors: list[Float]) -> str:
    """Return the root mean square, over all runs, of the norms of errors (N, M) or (N,); "" if they are not known."""
    mean = float(np.mean([np.mean(np.sum(np.atleast_2d(each.T) ** 2, axis=0)) for each in errors]))
    return "" if np.isnan(mean) else f"{np.sqrt(mean):.2f}"
