"""``scripts/campaign live``: the live system in real time, with faults of the sensors and the machine.

In each case, the whole live system runs in real time on the simulated room, which is walked to and fro.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks.command_line import Subparsers, add_command, add_report_options
from benchmarks.recordings import add_data_option, simulated
from benchmarks.report import Report, log_progress, machine

from campaigns.live_listener import Listener
from graphvio.config import Config
from graphvio.errors import GraphvioError
from graphvio.live.outputs import Output
from graphvio.live.running import LiveOdometry
from graphvio.live.sources import open_live_source
from graphvio.measurements.estimate import Estimate
from graphvio.measurements.sensors import FrameSet, ImuSample
from graphvio.sources import open_source
from graphvio.warmup import warm_up

_SCENE = "room"
_HEAD = ("case", "framesets", "skipped", "least corners, %", "p50, ms", "p99, ms", "longest, ms", "epochs", "error, mm",
         "events")  # fmt: skip


@dataclass(frozen=True)
class _Case:
    """Name of a case, options of the simulated devices, and for how long the output is blocked once, seconds."""

    name: str
    options: str = ""
    stalls_s: float = 0.0


_CASES = (
    _Case("nothing"),
    _Case("clocks drift by 100 ppm, readings come 2 ms late on average", "drift_ppm=100&jitter_ms=2"),
    _Case("back pair unplugged for 3 s", "unplug=back@8-11"),
    _Case("both pairs unplugged for 3 s, the IMU is not", "unplug=front@8-11,back@8-11"),
    _Case("IMU unplugged for 3 s", "unplug=imu@8-11"),
    _Case("all unplugged for 3 s", "unplug=front@8-11,back@8-11,imu@8-11"),
    _Case("output stalls for 7 s", stalls_s=7.0),
    _Case("overload: 80 framesets a second", "speed=4"),
    _Case("more overload: 160 framesets a second", "speed=8"),
)


def add_parser(subparsers: Subparsers) -> None:
    """Add ``live``."""
    parser = add_command(subparsers, "live", "unplugged, drifting, stalled, overloaded and killed", __doc__, main)
    parser.add_argument("--seconds", type=float, default=25.0, help="of each case (default: 25)")
    parser.add_argument("--kills", type=int, default=5, help="recordings that are killed (default: 5)")
    add_report_options(parser)
    add_data_option(parser)


def main(args: argparse.Namespace) -> None:
    """Run all cases and report."""
    if args.seconds < 15.0:
        raise GraphvioError("--seconds must be 15 or more")
    folder = simulated(args.data, _SCENE)
    report = Report()
    report.add(machine(), "", f"`--seconds {args.seconds:g} --kills {args.kills}`")
    rows = []
    for case in _CASES:
        rows.append([case.name, *_run(case, folder, args.seconds)])
        log_progress(case.name)
    report.table(_HEAD, rows)
    lost_s = [_killed(folder, 4.0 + 1.3 * k) for k in range(args.kills)]
    if lost_s:
        report.add(
            f"Recordings killed at {len(lost_s)} moments: all could be read, to {max(lost_s):.2f} s before the newest "
            "frameset at most."
        )
    report.write(args, "live")


def _run(case: _Case, folder: Path, seconds: float) -> list[str]:
    config, options = Config(), f"&{case.options}" if case.options else ""
    speed = float(dict(each.split("=") for each in case.options.split("&") if each).get("speed", "1"))
    source = open_live_source(f"simulator:{_SCENE}?recording={folder}&duration_s={seconds * speed:g}{options}")
    rig = source.open()
    warm_up(rig, config)
    stall = _Stall(case.stalls_s)
    running = LiveOdometry(source, rig, config, [stall])
    listener = Listener(running, folder)
    running.start()
    min_share = 1.0
    while not running.wait(0.05):
        min_share = min(min_share, float(running.status()["corner_share"] or 0.0))
    running.stop()
    listener.thread.join()
    figures = running.status()
    events = {name.removeprefix("event_"): value for name, value in figures.items() if name.startswith("event_")}
    return [
        str(figures["framesets"]),
        str(int(figures["skipped_late"] or 0) + int(figures["skipped_no_room"] or 0)),
        f"{100 * min_share:.0f}",
        *(f"{figures[name]:.1f}" for name in ("latency_p50_ms", "latency_p99_all_ms", "latency_max_ms")),
        str(listener.epochs),
        f"{listener.error_mm:.0f}",
        ", ".join(f"{kind} {count}" for kind, count in events.items()) or "nothing",
    ]


class _Stall(Output):
    """An output that blocks once, at the hundredth result."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._results = 0

    def add_result(self, estimate: Estimate, frameset: FrameSet | None) -> None:
        """See `Output`."""
        self._results += 1
        if self._seconds and self._results == 100:
            time.sleep(self._seconds)


def _killed(folder: Path, after_s: float) -> float:
    """Kill a recording process ``after_s`` seconds after its file appeared; return how many seconds are lost in it."""
    with tempfile.TemporaryDirectory() as made:
        out = Path(made) / "killed.mcap"
        command = [sys.executable, "-c", "from graphvio.cli import main; main()", "live"]
        process = subprocess.Popen(
            [*command, f"simulator:{_SCENE}?recording={folder}", "--record", str(out)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        while not out.exists() or not out.stat().st_size:
            if process.poll() is not None:
                raise GraphvioError(f"graphvio live ended with exit code {process.returncode} before it recorded")
            time.sleep(0.01)
        begin_s = time.monotonic()
        time.sleep(after_s)
        os.kill(process.pid, signal.SIGKILL)
        elapsed_s = time.monotonic() - begin_s
        process.wait()
        session = open_source(out)
        framesets = [measurement for measurement in session if not isinstance(measurement, ImuSample)]
        recorded_s = 1e-9 * (framesets[-1].stamp_ns - framesets[0].stamp_ns)
        return max(0.0, elapsed_s - recorded_s)
