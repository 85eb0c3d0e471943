"""Run of the odometry on a live source, with display, recording and services; shared by several commands.

Commands import this module only when they run, since it imports all stages.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING

import typer

from graphvio.cli.dashboard import Dashboard, line_of, summary_of
from graphvio.cli.json_output import publish
from graphvio.cli.options import LiveOptions, ReadingOptions
from graphvio.cli.shared import EXIT_INCOMPLETE, check_session_name, reading_of, warn
from graphvio.cli.warming import warm_up_visibly
from graphvio.config import Config
from graphvio.live.health import HealthServer
from graphvio.live.outputs import ViewOutput
from graphvio.live.running import LiveOdometry
from graphvio.live.session_recorder import SessionRecorder
from graphvio.runtime import StopSignals, set_up_threads, share_heap, sigterm_as_interrupt

if TYPE_CHECKING:
    from graphvio.cli.services import Services, Started
    from graphvio.live.calibration_memory import CalibrationMemory
    from graphvio.live.source import LiveSource
    from graphvio.rig import Rig
    from graphvio.sessions.topics import ImageFormat
    from graphvio.viewer import Viewer


def run_live(spec: str, options: LiveOptions, services: Services | None, view: bool = False) -> None:
    """Open a source, run the odometry on it with recording, viewer and services, and save everything at the end.

    Args:
        spec: the source, ``KIND[:DEVICE][?OPTION=VALUE]``, or a recording's path.
        options: the options that all live commands share.
        services: services for other programs, or None for none.
        view: whether the viewer's window is opened.
    """
    _check_recording(options)
    share_heap()
    config = Config.load(options.config)
    if services is not None:
        config = services.settings(config)
    source = _source_of(spec, options)
    if services is not None:
        services.check()
    with ExitStack() as stack:
        stack.callback(source.close)
        with sigterm_as_interrupt():  # nothing has to be saved yet
            rig, memory = _prepare(spec, source, config, options)
        signals = stack.enter_context(StopSignals())
        recording = stack.enter_context(ExitStack())  # closed after the run, so that it is complete
        viewer = _viewer(stack, rig, services, view)
        running = LiveOdometry(source, rig, config, wants_keyframes=services is not None)
        stack.callback(running.stop)
        if viewer is not None:
            running.add_output(ViewOutput(viewer, lambda: running.odometry.calibration))
        if options.health_port is not None:
            health = HealthServer(running.status, port=options.health_port)
            stack.callback(health.close)
            typer.echo(f"health: http://{health.address}/healthz, metrics: http://{health.address}/metrics", err=True)
        started = None
        if services is not None:
            started = services.start(running, stack, lambda: signals.came)
            for line in started.lines:
                typer.echo(line, err=True)
        recorder = None
        if options.record is not None:  # last, so that no file is left if a port is in use
            image_format: ImageFormat = "png" if options.png else "raw"
            recorder = SessionRecorder(options.record, running.rig, image_format, waits=not source.is_realtime)
            recording.callback(recorder.close)
            running.add_output(recorder)
        running.start()
        failure = _run_until_end(source.name, running, signals, started, options)
        figures = running.status()
        is_whole = started is None or started.finish()
        if failure is not None:
            raise failure
    recorded = {} if recorder is None else {"recording": str(options.record), **recorder.status()}
    publish({**figures, **recorded})
    typer.echo(line_of(figures))
    typer.echo(summary_of(figures))
    if memory is not None and figures.get("status_tracking"):
        _keep(memory, running)
    if recorder is not None and options.record is not None:
        is_whole = _print_recorded(options.record, recorder.status()) and is_whole
    if not is_whole:
        raise typer.Exit(EXIT_INCOMPLETE)


# ---------------------------------------------------------------------- before the run


def _check_recording(options: LiveOptions) -> None:
    """Refuse a session file that cannot be written, before sensors are started."""
    from graphvio.errors import SessionError
    from graphvio.sessions.storage import exists_error

    path = options.record
    if path is None:
        if options.png:
            raise typer.BadParameter("--png is how images are recorded; give --record FILE, too")
        return
    check_session_name(path)
    if path.exists():
        raise exists_error(path)
    if not path.parent.is_dir():
        raise SessionError(f"{path}: {path.parent} is no folder; make it first")


def _source_of(spec: str, options: LiveOptions) -> LiveSource:
    """Return the live source that the options select; no sensor is started."""
    from graphvio.live.source import SelectedCameras
    from graphvio.live.sources import open_live_source
    from graphvio.rig_files import load_rig

    source = open_live_source(spec, None if options.rig is None else load_rig(options.rig))
    if options.cameras is None and not options.no_pairs:
        return source
    return SelectedCameras(source, reading_of(ReadingOptions(cameras=options.cameras, no_pairs=options.no_pairs)).of)


def _prepare(
    spec: str, source: LiveSource, config: Config, options: LiveOptions
) -> tuple[Rig, CalibrationMemory | None]:
    """Open a source and load the kernels.

    Returns:
        The source's rig, with the calibration that an earlier run has stored, if any; and the store of this
        calibration, or None if calibrations of this source are not stored.
    """
    from graphvio.live.calibration_memory import devices_of

    rig = source.open()
    memory = _memory(devices_of(spec, source.name), rig, config, options)
    if memory is not None:
        rig = _remembered(memory, rig)
    set_up_threads()
    warm_up_visibly(rig, config)  # measurements that arrive meanwhile are not used
    return rig, memory


def _memory(devices: str | None, rig: Rig, config: Config, options: LiveOptions) -> CalibrationMemory | None:
    """Return the store of a source's calibration, emptied after ``--forget-calibration``, or None if there is none."""
    from graphvio.live.calibration_memory import CalibrationMemory

    if devices is None or not config.estimates_calibration:
        return None
    memory = CalibrationMemory(devices, rig)
    if options.forget_calibration:
        try:
            memory.forget()
        except OSError as error:
            warn(f"{memory.path}: cannot be removed ({error.strerror})")
            return None
    return memory


def _remembered(memory: CalibrationMemory, rig: Rig) -> Rig:
    """Return the rig with the calibration that an earlier run has stored, or unchanged if there is none to use."""
    from graphvio.errors import RigError

    try:
        remembered = memory.recall()
    except RigError as error:
        warn(f"{error}: not used")
        return rig
    if remembered is None:
        return rig
    learnt = remembered.saved.strftime("%Y-%m-%d %H:%M")
    typer.echo(f"calibration: as learnt by the run of {learnt}; --forget-calibration uses the rig file", err=True)
    return remembered.rig


# ---------------------------------------------------------------------- around the run


def _viewer(stack: ExitStack, rig: Rig, services: Services | None, view: bool) -> Viewer | None:
    """Open the viewer, if it is asked for, until the stack closes."""
    from graphvio.viewer import Viewer, WebOptions

    web = None if services is None or services.web_port is None else WebOptions(port=services.web_port)
    viewer = stack.enter_context(Viewer(rig, spawn=view, web=web)) if view or web is not None else None
    if web is not None:
        typer.echo(f"browser: {web.url}", err=True)
    return viewer


# ---------------------------------------------------------------------- the run, and what is printed and kept after it


def _run_until_end(
    name: str, running: LiveOdometry, signals: StopSignals, started: Started | None, options: LiveOptions
) -> Exception | None:
    """Run with a dashboard until the source has ended, a signal came, a service failed, or the duration is over.

    Returns:
        The error that ended the run, to be raised once everything until then is saved; None if there was none.
    """
    until = None if options.duration is None else monotonic() + options.duration
    try:
        with Dashboard(name, running.events.subscribe(64)) as dashboard:
            while not running.wait(0.1) and not signals.came and (until is None or monotonic() < until):
                dashboard.show(running.status(), running.devices)
                if started is not None:
                    started.check()
        if signals.came:
            typer.echo("stopping: measurements that have come are processed and saved", err=True)
        running.stop()
    except Exception as error:
        with suppress(Exception):
            running.stop()
        return error
    return None


def _keep(memory: CalibrationMemory, running: LiveOdometry) -> None:
    try:
        if memory.keep(running.odometry):
            typer.echo(f"calibration: kept for the next run of {memory.name}")
    except OSError as error:
        warn(f"{memory.path}: what was learnt of the calibration cannot be kept ({error.strerror})")


def _print_recorded(path: Path, status: Mapping[str, float | int | str | None]) -> bool:
    """Print the size of the recording, and whether parts are missing; return whether it is complete."""
    size = f"{path.stat().st_size / 1e6:.1f} MB, " if path.exists() else ""
    typer.echo(f"{path}: {size}{status['recorded_framesets']} framesets")
    if status["recording_stopped"]:
        came = int(status["recorded_framesets"] or 0) + int(status["framesets_not_recorded"] or 0)
        warn(f"{status['recording_stopped']}: {_readable(path)} framesets of {came}")
        return False
    if status["framesets_not_recorded"] or status["messages_not_recorded"]:
        warn(
            f"the disk was too slow; {status['framesets_not_recorded']} framesets and "
            f"{status['messages_not_recorded']} samples, poses and messages were left out"
        )
        return False
    return True


def _readable(path: Path) -> int:
    """Count the framesets of a truncated recording that can be read."""
    from graphvio.errors import GraphvioError
    from graphvio.sources import open_source

    try:
        return open_source(path).frameset_count
    except GraphvioError:
        return 0
