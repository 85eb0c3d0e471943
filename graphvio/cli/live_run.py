"""Runs the odometry on a live source with displays, recording and services around it, for several commands."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from graphvio.cli.json_output import publish
from graphvio.cli.shared import EXIT_INCOMPLETE, check_session_name, reading_of, warn

if TYPE_CHECKING:
    from graphvio.cli.services import Services, Started
    from graphvio.config import Config
    from graphvio.live.calibration_memory import CalibrationMemory
    from graphvio.live.running import LiveOdometry
    from graphvio.live.source import LiveSource
    from graphvio.rig import Rig
    from graphvio.runtime import StopSignals
    from graphvio.viewer import Viewer


def run_live(
    source: str,
    rig: Path | None,
    config: str,
    *,
    cameras: str | None = None,
    no_pairs: bool = False,
    record: Path | None,
    png: bool,
    view: bool,
    health_port: int | None,
    duration_s: float | None,
    forget_calibration: bool,
    services: Services | None,
) -> None:
    """Open a source, run the odometry on it with recording, viewer and services, and save everything at the end."""
    from graphvio.cli.dashboard import line_of, summary_of
    from graphvio.cli.warming import warm_up_visibly
    from graphvio.config import Config
    from graphvio.live.health import HealthServer
    from graphvio.live.outputs import ViewOutput
    from graphvio.live.running import LiveOdometry
    from graphvio.live.session_recorder import SessionRecorder
    from graphvio.runtime import StopSignals, set_up_threads, share_heap, sigterm_as_interrupt

    if png and record is None:
        raise typer.BadParameter("--png is how images are recorded; give --record FILE, too")
    if record is not None:
        _check_recording(record)
    share_heap()
    settings = Config.load(config)
    if services is not None:
        settings = services.settings(settings)
    opened = _opened(source, rig, cameras, no_pairs)
    recorder: SessionRecorder | None = None
    if services is not None:
        services.check()
    with ExitStack() as stack:
        stack.callback(opened.close)
        with sigterm_as_interrupt():  # nothing has to be saved yet
            used = opened.open()
            memory = _memory(source, opened.name, used, settings, forget_calibration)
            if memory is not None:
                used = _remembered(memory, used)
            set_up_threads()
            warm_up_visibly(used, settings)  # measurements that come meanwhile are not used
        signals = stack.enter_context(StopSignals())
        recording = stack.enter_context(ExitStack())  # closed after the run, so that it is complete
        viewer = _viewer(stack, used, view, services)
        running = LiveOdometry(opened, used, settings, wants_keyframes=services is not None)
        stack.callback(running.stop)
        if viewer is not None:
            running.add_output(ViewOutput(viewer, lambda: running.odometry.calibration))
        if health_port is not None:
            health = HealthServer(running.status, port=health_port)
            stack.callback(health.close)
            typer.echo(f"health: http://{health.address}/healthz, metrics: http://{health.address}/metrics", err=True)
        started = None if services is None else services.start(running, stack, lambda: signals.came)
        for line in () if started is None else started.lines:
            typer.echo(line, err=True)
        if record is not None:  # last, so that a port in use leaves no file behind
            recorder = SessionRecorder(record, used, "png" if png else "raw", waits=not opened.is_realtime)
            recording.callback(recorder.close)
            running.add_output(recorder)
        running.start()
        failure: Exception | None = None
        try:
            _show_until_end(opened.name, running, signals, duration_s, started)
            running.stop()
        except Exception as error:  # raised after everything until then is saved
            failure = error
            with suppress(Exception):
                running.stop()
        figures = running.status()
        is_whole = started is None or started.finish()
        if failure is not None:
            raise failure
    publish({**figures, **({} if recorder is None else {"recording": str(record), **recorder.status()})})
    typer.echo(line_of(figures))
    typer.echo(summary_of(figures))
    if memory is not None and figures.get("status_tracking"):
        _keep(memory, running)
    if recorder is not None and record is not None:
        is_whole = _print_recorded(record, recorder.status()) and is_whole
    if not is_whole:
        raise typer.Exit(EXIT_INCOMPLETE)


def _opened(source: str, rig: Path | None, cameras: str | None, no_pairs: bool) -> LiveSource:
    """Make a source as the options of a command ask for it; no sensor is started."""
    from graphvio.live.source import SelectedCameras
    from graphvio.live.sources import open_live_source
    from graphvio.rig_files import load_rig

    opened = open_live_source(source, None if rig is None else load_rig(rig))
    if cameras is None and not no_pairs:
        return opened
    return SelectedCameras(opened, reading_of(cameras=cameras, no_pairs=no_pairs).of)


def _show_until_end(
    name: str, running: LiveOdometry, signals: StopSignals, duration_s: float | None, started: Started | None
) -> None:
    """Show what happens until the source has ended, a signal came, or the time is over.

    Raises:
        GraphvioError: that of a service which failed.
    """
    from time import monotonic

    from graphvio.cli.dashboard import Dashboard

    until = None if duration_s is None else monotonic() + duration_s
    with Dashboard(name, running.events.subscribe(64)) as dashboard:
        while not running.wait(0.1) and not signals.came and (until is None or monotonic() < until):
            dashboard.show(running.status(), running.devices)
            if started is not None:
                started.check()
    if signals.came:
        typer.echo("stopping: measurements that have come are processed and saved", err=True)


def _memory(source: str, name: str, rig: Rig, settings: Config, forget_calibration: bool) -> CalibrationMemory | None:
    """Return the memory of a source's calibration, emptied if it is to be, or None where none is kept."""
    from graphvio.live.calibration_memory import CalibrationMemory, devices_of

    devices = devices_of(source, name)
    if devices is None or not settings.estimates_calibration:
        return None
    memory = CalibrationMemory(devices, rig)
    if forget_calibration:
        try:
            memory.forget()
        except OSError as error:
            warn(f"{memory.path}: cannot be removed ({error.strerror})")
            return None
    return memory


def _remembered(memory: CalibrationMemory, rig: Rig) -> Rig:
    """Return the rig with what earlier runs learnt, or as it is."""
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


def _keep(memory: CalibrationMemory, running: LiveOdometry) -> None:
    try:
        if memory.keep(running.odometry):
            typer.echo(f"calibration: kept for the next run of {memory.name}")
    except OSError as error:
        warn(f"{memory.path}: what was learnt of the calibration cannot be kept ({error.strerror})")


def _check_recording(path: Path) -> None:
    """Refuse a session that cannot be written, before sensors are started."""
    from graphvio.errors import SessionError
    from graphvio.sessions.storage import exists_error

    check_session_name(path)
    if path.exists():
        raise exists_error(path)
    if not path.parent.is_dir():
        raise SessionError(f"{path}: {path.parent} is no folder; make it first")


def _print_recorded(path: Path, status: Mapping[str, float | int | str | None]) -> bool:
    """Print the size of the recording, and return whether it is complete."""
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


def _viewer(stack: ExitStack, rig: Rig, view: bool, services: Services | None) -> Viewer | None:
    """Open the viewer, if it is asked for, until the stack closes."""
    from graphvio.viewer import Viewer, WebOptions

    web = None if services is None or services.web_port is None else WebOptions(port=services.web_port)
    viewer = stack.enter_context(Viewer(rig, spawn=view, web=web)) if view or web is not None else None
    if web is not None:
        typer.echo(f"browser: {web.url}", err=True)
    return viewer
