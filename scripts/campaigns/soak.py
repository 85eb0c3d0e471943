"""``scripts/campaign soak``: memory and speed of the live system over thousands of framesets, which should be constant.

The whole live system, from the source to the listeners, runs on the simulated room, which is walked to and fro. The
memory of the process is reported. With ``--services``, the run is recorded and served by gRPC and ROS 2, and a client
receives all keyframes.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
from benchmarks.command_line import Subparsers, add_command, add_report_options
from benchmarks.recordings import add_data_option, simulated
from benchmarks.report import Report, log_progress, machine

from campaigns.live_listener import Listener
from campaigns.live_services import Services
from graphvio.config import Config
from graphvio.errors import GraphvioError
from graphvio.live.running import LiveOdometry
from graphvio.live.sources.simulator import SimulatedRig
from graphvio.runtime import share_heap
from graphvio.warmup import warm_up

_SCENE = "room"
_PARTS = 10
_LOOK_S = 0.2
_HEAD = ("framesets", "minutes", "framesets/s", "memory, MB", "error, mm", "epoch", "lost")
_Figures = Mapping[str, float | int | str | None]


def add_parser(subparsers: Subparsers) -> None:
    """Add ``soak``."""
    parser = add_command(subparsers, "soak", "memory, latency and losses of the live system over hours", __doc__, main)
    parser.add_argument("--framesets", type=int, default=20_000, help="number of framesets (default: 20000)")
    parser.add_argument("--real-time", action="store_true", help="at the sensors' pace, not as fast as possible")
    parser.add_argument(
        "--services", action="store_true", help="record it, and serve it by gRPC and ROS 2 (25 GB of disk for 20000)"
    )
    add_report_options(parser)
    add_data_option(parser)


def main(args: argparse.Namespace) -> None:
    """Run and report."""
    if args.framesets < 100:
        raise GraphvioError("--framesets must be 100 or more")
    folder = simulated(args.data, _SCENE)
    report = Report()
    how = "at the sensors' pace" if args.real_time else "as fast as possible"
    given = "".join(f" --{name}" for name in ("real-time", "services") if vars(args)[name.replace("-", "_")])
    report.add(machine(), "", f"`--framesets {args.framesets}{given}`: {how}.")
    with tempfile.TemporaryDirectory() as made:
        target = Path(made) / "soak.mcap" if args.services else None
        rows, figures, growth_mb, services_summary = _soak(folder, args.framesets, args.real_time, target)
    report.table(_HEAD, rows)
    lost = _lost(figures)
    latency = f"p50 {figures['latency_p50_ms']:.1f} ms (newest), p99 {figures['latency_p99_all_ms']:.1f} ms (all)"
    report.add(
        f"Memory grew by {growth_mb:.1f} MB after {'three tenths' if args.services else 'the first tenth'}. "
        f"Lost: {lost or 'nothing'}. "
        + (f"Latency: {latency}." if args.real_time else f"Work on a frameset: {_work_summary(figures)}.")
    )
    if services_summary:
        report.add(services_summary)
    report.write(args, "soak-services" if args.services else "soak")


def _soak(
    folder: Path, framesets: int, is_real_time: bool, target: Path | None
) -> tuple[list[list[str]], _Figures, float, str]:
    """Run the live system; return a row for each tenth of the run, the figures at the end, the growth of memory (MB),
    and the services' summary, "" without services."""
    share_heap()  # as the command line does
    config = Config()
    if target is not None:
        config = replace(config, keyframes=replace(config.keyframes, images=True))
    seconds = framesets / 20.0
    source = SimulatedRig(_SCENE, None, 1.0 if is_real_time else None, duration_s=seconds, recording=folder)
    rig = source.open()
    warm_up(rig, config)
    running = LiveOdometry(source, rig, config, wants_keyframes=target is not None)
    listener = Listener(running, folder)
    with ExitStack() as stack:
        services = None if target is None else Services.start(running, target, not is_real_time, stack)
        running.start()
        begun_s, due = time.monotonic(), framesets / _PARTS
        rows: list[list[str]] = []
        memories: list[float] = []
        while not running.wait(_LOOK_S):
            figures = running.status()
            if int(figures["estimates"] or 0) >= due * (len(rows) + 1):
                memories.append(float(figures["memory_mb"] or np.nan))
                rows.append(_row(figures, listener.error_mm, time.monotonic() - begun_s))
                log_progress(f"{figures['estimates']} of {framesets}")
        running.stop()
        listener.thread.join()
        summary = "" if services is None else services.summary()
    figures = dict(running.status())
    figures |= {f"work_p{percent}_ms": float(np.percentile(listener.work_ms, percent)) for percent in (50, 99)}
    rows.append(_row(figures, listener.error_mm, time.monotonic() - begun_s))
    memories.append(float(figures["memory_mb"] or np.nan))
    warm = 2 if services is not None else 0  # parts until the store of keyframes, up to 256 MB, is full
    return rows, figures, max(memories[warm:]) - memories[warm], summary


def _row(figures: _Figures, error_mm: float, elapsed_s: float) -> list[str]:
    done = int(figures["estimates"] or 0)
    return [
        str(done),
        f"{elapsed_s / 60.0:.1f}",
        f"{done / elapsed_s:.1f}",
        f"{figures['memory_mb']:.0f}",
        f"{error_mm:.0f}",
        str(figures.get("epoch")),
        str(sum(_lost(figures).values())),
    ]


def _lost(figures: _Figures) -> dict[str, int]:
    kinds = ("skipped", "images_not", "imu_lost", "results_not", "event_")
    return {name: int(value) for name, value in figures.items() if name.startswith(kinds) and value}


def _work_summary(figures: _Figures) -> str:
    return f"p50 {figures['work_p50_ms']:.1f} ms, p99 {figures['work_p99_ms']:.1f} ms"
