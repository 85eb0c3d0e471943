"""``scripts/benchmark backend``: time per frameset of the back-end and of gtsam's fixed-lag smoother.

The odometry runs once over a recording, and the inputs of its back-end are logged: IMU samples and motions by vision.
Then the back-end processes them again without a front-end, and gtsam's IncrementalFixedLagSmoother processes the
factors that the back-end has created. The two take turns at every frameset.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import gtsam
import numpy as np

from benchmarks.backend_streams import Added, FactorLog, Stream, log_stream
from benchmarks.command_line import Subparsers, add_command, add_report_options
from benchmarks.recordings import add_data_option, simulated
from benchmarks.report import Report, log_progress, machine
from graphvio.arrays import Float
from graphvio.backend.factors import g, r, x
from graphvio.backend.smoother_estimator import SmootherEstimator
from graphvio.config import Config
from graphvio.errors import GraphvioError

AIM_MS, AIM_P99_MS, AIM_PREDICTION_US = 1.5, 5.0, 50.0
LAGS_S = (0.5, 0.75, 1.0, 2.0, 4.0)
_WARM_UP = 20
_MIN_FRAMESETS = 100
_NS_PER_S = 1e9


def add_parser(subparsers: Subparsers) -> None:
    """Add ``backend``."""
    parser = add_command(subparsers, "backend", "time of the back-end and of gtsam's fixed-lag smoother", __doc__, main)
    parser.add_argument("--recording", type=Path, metavar="DIR", help="with an IMU (default: the simulated room)")
    parser.add_argument("--framesets", type=int, default=800, metavar="N", help="at most so many (default: 800)")
    add_report_options(parser)
    add_data_option(parser)


def main(args: argparse.Namespace) -> None:
    """Measure the times and report them next to the aims."""
    if args.framesets < _MIN_FRAMESETS:
        raise GraphvioError(f"percentiles need framesets: give {_MIN_FRAMESETS} or more")
    folder = simulated(args.data, "room") if args.recording is None else args.recording
    log_progress("logging the inputs of the back-end")
    stream = log_stream(folder, args.framesets)
    if stream.rig.imu is None or len(stream.framesets) < _MIN_FRAMESETS:
        raise GraphvioError(f"{folder}: needs an IMU and {_MIN_FRAMESETS} framesets or more")
    report = Report()
    title = "the simulated room" if args.recording is None else "a recording"
    report.add(
        machine(),
        "",
        f"{len(stream.framesets) - _WARM_UP} framesets of {title}, {len(stream.rig.pairs)} pairs and IMU.",
    )
    timings = {}
    for lag_s in LAGS_S:
        log_progress(f"lag {lag_s:g} s")
        timings[lag_s] = _timed(stream, lag_s)
    head = ["lag, s", "ours, median ms", "p95", "p99", "gtsam's, median ms", "p95", "p99", "with covariance",
            "ours / gtsam's", "apart, mm"]  # fmt: skip
    report.table(head, [_row(lag_s, timing) for lag_s, timing in timings.items()])
    default = timings[Config().smoother.lag_s]
    median_ms, _, p99_ms = _percentiles(default.ours_ms)
    whole_ms = float(np.median(default.ours_ms[default.is_whole > 0.0]))
    report.table(
        ["default lag", "ms", "aim"],
        [
            ["median", f"{median_ms:.2f}", f"{AIM_MS:g}: {'met' if median_ms <= AIM_MS else 'missed'}"],
            ["99th percentile", f"{p99_ms:.2f}", f"{AIM_P99_MS:g}: {'met' if p99_ms <= AIM_P99_MS else 'missed'}"],
            ["mean", f"{default.ours_ms.mean():.2f}", ""],
            [f"median of the {np.mean(default.is_whole):.0%} that solve the whole window", f"{whole_ms:.2f}", ""],
        ],
    )
    median_us, _, p99_us = _percentiles(np.array(stream.prediction_us))
    report.table(
        ["a pose at the IMU's rate", "us", "aim"],
        [
            ["median", f"{median_us:.1f}", ""],
            [
                "99th percentile",
                f"{p99_us:.1f}",
                f"{AIM_PREDICTION_US:g}: {'met' if p99_us <= AIM_PREDICTION_US else 'missed'}",
            ],
        ],
    )
    report.write(args, "backend")


class _Timing(NamedTuple):
    """Values for each counted frameset: times in milliseconds, the distance between the newest positions of both
    smoothers in metres, and whether ours solved the whole window."""

    ours_ms: Float
    theirs_ms: Float
    with_covariance_ms: Float
    apart_m: Float
    is_whole: Float


def _timed(stream: Stream, lag_s: float) -> _Timing:
    log, config = FactorLog(), Config()
    estimator = SmootherEstimator(
        stream.rig, replace(config, smoother=replace(config.smoother, lag_s=lag_s)), lambda *_: None
    )
    theirs = _Incremental(lag_s)
    rows = []
    for calls in stream.framesets:
        start = perf_counter()
        for name, arguments in calls:
            getattr(estimator, name)(*arguments)
        ours_s = perf_counter() - start
        stamp_ns, _, keep = calls[-1].arguments
        index_of = estimator._running._index_of
        references = [index_of[ns] for ns in keep if ns in index_of]
        spent_s, covariance_s, position = theirs.step(stamp_ns, index_of[stamp_ns], references, log.take())
        apart_m = np.linalg.norm(position - estimator.state().nav_T_body[:3, 3])
        is_whole = estimator._running._advanced == 0
        rows.append([1e3 * ours_s, 1e3 * spent_s, 1e3 * (spent_s + covariance_s), apart_m, is_whole])
    return _Timing(*np.array(rows[_WARM_UP:]).T)


class _Incremental:
    """gtsam's incremental fixed-lag smoother, which is given the factors of our smoother."""

    def __init__(self, lag_s: float) -> None:
        params = gtsam.ISAM2Params()
        params.setFactorization("QR")  # with the default, it throws on some graphs
        self._smoother = gtsam.IncrementalFixedLagSmoother(lag_s, params)
        self._known: set[int] = set()

    def step(self, stamp_ns: int, newest: int, references: list[int], added: Added) -> tuple[float, float, Float]:
        """Update with the newest state; return the seconds for its pose and for its covariance, and its position (3,).

        Args:
            stamp_ns: stamp of the newest state.
            newest: number of the newest state.
            references: numbers of the states from which later motions are measured: they must stay in the window.
            added: factors and new variables.
        """
        now_s = stamp_ns / _NS_PER_S
        new = list(added.values.keys())
        self._known |= set(new)
        kept = [key for k in references for key in (x(k), r(k)) if key in self._known]
        kept += [g()] if g() in self._known else []  # gravity's direction, one for all states
        stamps = dict.fromkeys([*new, *kept], now_s)
        start = perf_counter()
        self._smoother.update(added.factors, added.values, stamps)  # type: ignore[arg-type]
        pose = self._smoother.calculateEstimatePose3(x(newest))
        done = perf_counter()
        self._smoother.marginalCovariance(x(newest))
        return done - start, perf_counter() - done, np.asarray(pose.translation())


def _row(lag_s: float, timing: _Timing) -> list[str]:
    ours, theirs = _percentiles(timing.ours_ms), _percentiles(timing.theirs_ms)
    return [
        f"{lag_s:g}",
        *(f"{ms:.2f}" for ms in (*ours, *theirs)),
        f"{np.median(timing.with_covariance_ms):.2f}",
        f"{ours[0] / np.median(timing.with_covariance_ms):.2f}",
        f"{1e3 * np.median(timing.apart_m):.2f}",
    ]


def _percentiles(values: Float) -> list[float]:
    return [float(value) for value in np.percentile(values, (50, 95, 99))]
