"""``graphvio record`` and ``graphvio convert``: record the odometry's results, and convert recordings."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graphvio.cli import completion, options
from graphvio.cli.json_output import publish
from graphvio.cli.shared import (
    EXIT_INCOMPLETE,
    check_session_name,
    ends_at_interrupt,
    framesets_bar,
    open_recording,
    warn,
)

if TYPE_CHECKING:
    from graphvio.measurements.sensors import Measurement
    from graphvio.odometry import Odometry
    from graphvio.sessions.storage import RecordingWriter
    from graphvio.sessions.writer import SessionWriter
    from graphvio.sources import Source
    from graphvio.trajectory import Trajectory


def record(
    source: options.Source,
    out: options.SessionOut,
    rig: options.RigFile = None,
    topics: options.Topics = None,
    config: options.ConfigName = "default",
    png: options.Png = False,
    no_imu: options.NoImu = False,
    from_s: options.FromS = None,
    to_s: options.ToS = None,
) -> None:
    """Run the odometry and record images, IMU, rig, poses and events as a session (MCAP, ROS 2 messages).

    When the disk is full, recording stops, the odometry goes on, and the exit code is 3. After Ctrl-C the exit code is
    130, and the session can be read up to the interruption.

    Example:

        graphvio record walk --out walk.mcap
    """
    from graphvio.cli.warming import warm_up_visibly
    from graphvio.config import Config
    from graphvio.odometry import Odometry
    from graphvio.runtime import set_up_threads
    from graphvio.sessions.writer import SessionWriter

    check_session_name(out)
    settings = Config.load(config)
    reading = options.ReadingOptions(rig=rig, topics=topics, no_imu=no_imu, from_s=from_s, to_s=to_s)
    opened = open_recording(source, reading, settings)
    set_up_threads()
    warm_up_visibly(opened.rig, settings)
    writer = SessionWriter(out, opened.rig, "png" if png else "raw")
    truth = _truth(opened, is_whole=from_s is None and to_s is None)
    with ends_at_interrupt(f"interrupted; what was recorded until then is in {out}, which can be read"):
        _write(opened, truth, writer, Odometry(opened.rig, settings))
    publish({"out": str(out), "size_bytes": out.stat().st_size, "poses": writer.poses, "stopped": writer.stopped})
    typer.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB, {writer.poses} poses")
    _exit_if_stopped(writer)


def convert(
    source: options.Source,
    out: Annotated[
        Path, typer.Option("--out", help="Recording to write; new: NAME.mcap, NAME.bag, or a folder.", metavar="PATH")
    ],
    file_format: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="mcap, rosbag1, rosbag2 or euroc.  [default: by the name: .mcap, .bag]",
            autocompletion=completion.session_format,
        ),
    ] = None,
    rig: options.RigFile = None,
    topics: options.Topics = None,
    png: options.Png = False,
    from_s: options.FromS = None,
    to_s: options.ToS = None,
) -> None:
    """Write a recording in another format: MCAP, a ROS 1 or ROS 2 bag, or the EuRoC/ASL layout.

    If the disk becomes full, the exit code is 3, and a line says whether the result can be read.

    Examples:

        graphvio convert MH_01_easy --out mh01.mcap

        graphvio convert mh01.mcap --out mh01.bag

        graphvio convert mh01.bag --format euroc --out MH_01_again

        graphvio convert walk --from 10 --to 20 --png --out piece.mcap
    """
    from graphvio.config import Config
    from graphvio.sessions.formats import format_of, open_writer

    known = format_of(out, file_format)
    reading = options.ReadingOptions(rig=rig, topics=topics, from_s=from_s, to_s=to_s)
    opened = open_recording(source, reading, Config())
    truth = _truth(opened, is_whole=from_s is None and to_s is None)
    writer = open_writer(out, opened.rig, known, "png" if png else "raw")
    _write(opened, truth, writer, None)
    files = [out] if out.is_file() else [file for file in out.rglob("*") if file.is_file()]
    size = sum(file.stat().st_size for file in files)
    names = {old.name: new.name for old, new in zip(opened.rig.cameras, writer.rig.cameras, strict=True)}
    publish(
        {
            "out": str(out),
            "format": known,
            "size_bytes": size,
            "true_poses": len(truth) if truth else 0,
            "cameras": names,
            "stopped": writer.stopped,
        }
    )
    typer.echo(f"{out}: {size / 1e6:.1f} MB, {known}, {f'truth of {len(truth)} poses' if truth else 'no truth'}")
    if any(old != new for old, new in names.items()):
        typer.echo("cameras are renamed: " + ", ".join(f"{old} is {new}" for old, new in names.items()))
    _exit_if_stopped(writer)


def _truth(opened: Source, is_whole: bool) -> Trajectory | None:
    """Load the true trajectory of a recording, only around its interval unless ``is_whole``.

    Returns:
        The trajectory; None if there is none, or, with a warning, if it cannot be read.
    """
    from graphvio.errors import TrajectoryError
    from graphvio.trajectory_files import load_trajectory

    if opened.truth is None:
        return None
    try:
        truth = load_trajectory(opened.truth)
    except TrajectoryError as error:
        warn(f"the true trajectory is left out: {error}")
        return None
    return truth if is_whole else truth.around(opened.start_ns, opened.end_ns)


def _write(opened: Source, truth: Trajectory | None, writer: RecordingWriter, odometry: Odometry | None) -> None:
    """Write measurements, true poses and an odometry's results; without an odometry, stop when the disk is full."""
    from graphvio.measurements.sensors import FrameSet
    from graphvio.runtime import HeldInterrupt, interruptible
    from graphvio.sessions.writer import SessionWriter

    poses = deque(zip(truth.stamps_ns.tolist(), truth.nav_T_body, strict=True) if truth is not None else ())
    with interruptible(), HeldInterrupt() as held, writer, framesets_bar() as bar:
        task = bar.add_task("framesets", total=opened.frameset_count)
        for measurement in opened:
            held.check()
            while poses and poses[0][0] <= measurement.stamp_ns:
                writer.add_true_pose(*poses.popleft())
            writer.add(measurement)
            bar.advance(task, isinstance(measurement, FrameSet))
            if odometry is not None and isinstance(writer, SessionWriter):
                _advance(odometry, measurement, writer)
            elif writer.stopped is not None:
                break
        for stamp_ns, pose in poses:
            writer.add_true_pose(stamp_ns, pose)
        if odometry is not None and isinstance(writer, SessionWriter):
            for estimate in odometry.finish():
                writer.add_estimate(estimate)
        events = odometry.take_events() if odometry is not None else []
        for event in (*events, *opened.faults.events):
            writer.add_event(event)


def _advance(odometry: Odometry, measurement: Measurement, writer: SessionWriter) -> None:
    estimate = odometry.process(measurement)
    if estimate is not None:
        writer.add_estimate(estimate)
    for event in odometry.take_events():
        writer.add_event(event)


def _exit_if_stopped(writer: RecordingWriter) -> None:
    if writer.stopped is not None:
        warn(writer.stopped)
        raise typer.Exit(EXIT_INCOMPLETE)
