"""``scripts/campaign endurance``: time, memory and errors of the back-end over an hour, which should stay constant.

The rig walks in rounds through a room, with an IMU whose biases drift and visual motions that are sampled around the
truth. Time per frameset, memory of the process, errors of the state and their sigmas are reported for each part of the
hour.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from time import perf_counter

import numpy as np
from benchmarks.command_line import Subparsers, add_command, add_report_options
from benchmarks.report import Report, log_progress, machine

from campaigns.measures import tilt_error
from campaigns.walks import FRAMES_HZ
from graphvio.arrays import Float
from graphvio.backend.inertial import ImuBuffer
from graphvio.backend.smoother_estimator import SmootherEstimator
from graphvio.config import Config
from graphvio.errors import GraphvioError
from graphvio.geometry import se3_exp, se3_inverse
from graphvio.measurements.motion import Quality, RelativeMotion, VisualResult
from graphvio.measurements.sensors import ImuSample
from graphvio.rig import Imu
from graphvio.simulation.default_rig import default_rig
from graphvio.simulation.imu import measure
from graphvio.simulation.motion import Walk

_PARTS = 6
_CORNERS_M = np.array([[2.6, 2.1, 1.45], [-2.6, 2.1, 1.45], [-2.6, -2.1, 1.45], [2.6, -2.1, 1.45]])
_SPEED_M_S = 1.05
_SIGMAS = np.repeat([1e-3, 2e-3], 3)  # of visual motions from frame to frame: rad and metres
_HEAD = ("minutes", "median ms", "99th percentile", "memory, MB", "variables", "events", "position, m, sigma",
         "tilt, deg", "sigma", "gyro bias, mrad/s", "sigma")  # fmt: skip


def add_parser(subparsers: Subparsers) -> None:
    """Add ``endurance``."""
    parser = add_command(subparsers, "endurance", "memory, time and errors of the back-end over an hour", __doc__, main)
    parser.add_argument("--minutes", type=float, default=60.0, help="of the walk (default: 60)")
    add_report_options(parser)


def main(args: argparse.Namespace) -> None:
    """Run and report."""
    if args.minutes < 1.0:
        raise GraphvioError("--minutes must be 1 or more")
    report = Report()
    report.add(
        machine(),
        "",
        f"`--minutes {args.minutes:g}`. Errors are those at the end of each part. The position's sigma grows, as no "
        "measurement determines the position.",
    )
    report.table(_HEAD, _parts(60.0 * args.minutes))
    report.write(args, "endurance")


def _parts(duration_s: float) -> list[list[str]]:
    rng, imu, rig = np.random.default_rng(0), Imu(), default_rig()
    rounds = 1 + round(duration_s * _SPEED_M_S / np.linalg.norm(np.diff(_CORNERS_M, axis=0), axis=1).sum())
    motion = Walk(np.tile(_CORNERS_M, (rounds, 1)), _SPEED_M_S, duration_s + 1.0).motion
    times = np.arange(round((duration_s + 0.5) * imu.rate_hz)) / imu.rate_hz
    track = measure(motion, imu, times, np.round(times * 1e9).astype(np.int64), 0)
    framesets = round(duration_s * FRAMES_HZ)
    stamps = [round(k * 1e9 / FRAMES_HZ) for k in range(framesets + 1)]
    states = motion.at(np.array(stamps) * 1e-9)
    events: list[int] = []
    estimator = SmootherEstimator(rig, Config(), lambda ns, *_: events.append(ns))
    buffer, added = ImuBuffer(50.0), 0
    spent_ms: list[float] = []
    rows = []
    for k, stamp_ns in enumerate(stamps):
        while added < len(track.stamps_ns) and (added == 0 or track.stamps_ns[added - 1] < stamp_ns + 1_000_000_000):
            rate, force = track.angular_velocity[added], track.linear_acceleration[added]
            buffer.add(ImuSample(int(track.stamps_ns[added]), rate, force))
            added += 1
        visual = VisualResult(_motion(states.world_T_body, stamps, k, rng) if k else None, Quality.GOOD, "", {})
        start = perf_counter()
        if k == 0:
            found = buffer.segment(0, stamps[0] + 500_000_000)
            assert found is not None
            estimator.initialise(stamp_ns, (found[0], 0.0))
        else:
            estimator.predict(stamp_ns, buffer.interval(stamps[k - 1], stamp_ns))
        used = estimator.apply(visual, is_stationary=False).motion is not None
        estimator.update(stamp_ns, used or k == 0, frozenset())
        estimator.take_final()
        spent_ms.append(1e3 * (perf_counter() - start))
        buffer.discard_before(stamp_ns)
        if k and k % (framesets // _PARTS) == 0:
            rows.append(
                [
                    f"{(k - framesets // _PARTS) / FRAMES_HZ / 60.0:g} to {k / FRAMES_HZ / 60.0:g}",
                    f"{np.median(spent_ms):.2f}",
                    f"{np.percentile(spent_ms, 99):.2f}",
                    f"{_memory_mb():.0f}",
                    str(estimator._running._window.values.size()),
                    str(len(events)),
                    *_errors(estimator, states.world_T_body[k], track.gyro_bias[round(k * imu.rate_hz / FRAMES_HZ)]),
                ]
            )
            log_progress(" | ".join(rows[-1]))
            spent_ms.clear()
    return rows


def _motion(world_T_body: Float, stamps: list[int], k: int, rng: np.random.Generator) -> RelativeMotion:
    true = se3_inverse(world_T_body[k - 1]) @ world_T_body[k]
    measured = true @ se3_exp(_SIGMAS * rng.standard_normal(6))
    return RelativeMotion(stamps[k - 1], stamps[k], measured, np.diag(_SIGMAS**2), np.zeros((6, 6)), 300)


def _errors(estimator: SmootherEstimator, world_T_body: Float, gyro_bias: Float) -> list[str]:
    """Return cells: sigma of the position; error and sigma of the tilt; error and sigma of the gyro's bias."""
    state, known = estimator.state(), estimator.covariance
    assert known.gyro_bias is not None
    assert known.tilt is not None
    tilt = tilt_error(state.nav_T_body, state.gravity_nav, world_T_body)
    return [
        f"{_sigma(known.pose[3:, 3:]):.2f}",
        f"{np.rad2deg(np.linalg.norm(tilt)):.3f}",
        f"{np.rad2deg(_sigma(known.tilt)):.3f}",
        f"{1e3 * np.abs(gyro_bias - state.gyro_bias).max():.3f}",
        f"{1e3 * _sigma(known.gyro_bias):.3f}",
    ]


def _sigma(covariance: Float) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))


def _memory_mb() -> float:
    """Return the resident memory of the process, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20
