"""The process in which the SLAM of ``graphvio slam`` runs."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from graphvio.errors import GraphvioError, MapError, ServiceError
from graphvio.runtime import stop_signals_blocked

if TYPE_CHECKING:
    from multiprocessing.synchronize import Event

    from graphvio.live.outputs import PathOutput
    from graphvio.mapping.process import MappingTask

EXIT_FAILED = 2
_LOOK_S = 0.1
_PATIENCE_S = 300.0  # for a SLAM that is behind when the odometry ends
_PATHS = ("odometry.txt", "online.txt")


class SlamProcess:
    """Runs a task beside the odometry, which does not need it: when it fails, that is told, and the odometry goes on.

    Args:
        task: what to do; a folder to work in is made here, so that it goes even when the process is killed.
        path: of the odometry, to be put beside the map.

    Raises:
        MapError: if there is no room for temporary files.
    """

    def __init__(self, task: MappingTask, path: PathOutput) -> None:
        from multiprocessing import get_context

        self._out = task.out
        self._path = path
        self._is_told = False
        context = get_context("spawn")
        self._ready = context.Event()  # before signals are blocked: its helper process, once started, unblocks them
        with stop_signals_blocked():  # signals are for the odometry, with which the SLAM ends
            try:
                self._folder = tempfile.mkdtemp(prefix="graphvio-map-")
            except OSError as error:
                raise MapError(f"{tempfile.gettempdir()}: no folder can be made ({error}); set TMPDIR") from None
            started = replace(task, folder=Path(self._folder))
            self._process = context.Process(target=_map, args=(started, self._ready), name="graphvio-slam")
            self._process.start()

    def wait_ready(self, is_stopped: Callable[[], bool]) -> None:
        """Wait until it takes keyframes: places that are seen before would be lost.

        Raises:
            KeyboardInterrupt: if the odometry is to stop before.
            ServiceError: if it fails before.
        """
        while not self._ready.wait(_LOOK_S):
            if is_stopped():
                raise KeyboardInterrupt
            if self._process.exitcode:
                raise ServiceError(self._failure)

    def check(self) -> None:
        """Tell, once, if it has failed."""
        if self._process.exitcode and not self._is_told:
            self._tell(f"{self._failure}; the odometry goes on without it")

    def finish(self) -> bool:
        """Wait until it has worked on all keyframes and saved the map, and put the odometry's path beside it.

        Returns:
            Whether all of that was done; what was not is told.
        """
        if self._process.is_alive():
            typer.echo("waiting for the SLAM, which works on the last keyframes", err=True)
        self._process.join(_PATIENCE_S)
        if self._process.exitcode is None:
            self._tell(f"the SLAM is not done {_PATIENCE_S:g} s after the odometry; its map is not saved")
        elif self._process.exitcode and not self._is_told:
            self._tell(self._failure)
        is_done = self._process.exitcode == 0
        if self._out is None:
            return is_done
        try:
            self._write_path(self._out)
        except GraphvioError as error:
            self._tell(str(error))
            return False
        paths = ", ".join(_PATHS)
        if is_done:
            typer.echo(f"map: {self._out}; paths in it: {paths} as it was known, trajectory.txt as it is now")
        else:
            typer.echo(f"{self._out}: has the paths {paths} as it was known")
        return is_done

    def close(self) -> None:
        """Kill it if it still runs, and remove its folder."""
        self._process.kill()
        self._process.join()
        shutil.rmtree(self._folder, ignore_errors=True)

    @property
    def _failure(self) -> str:
        return f"the SLAM failed (exit code {self._process.exitcode}); what it said is above"

    def _tell(self, line: str) -> None:
        self._is_told = True
        typer.echo(f"graphvio: {line}", err=True)

    def _write_path(self, out: Path) -> None:
        try:
            out.mkdir(parents=True, exist_ok=True)  # a SLAM that failed may not have
            for name in _PATHS:
                (out / name).unlink(missing_ok=True)  # an earlier session's would be taken for this one's
        except OSError as error:
            raise MapError(f"{out}: cannot be written ({error}); the odometry's path is lost") from None
        self._path.write(out)


def _map(task: MappingTask, ready: Event) -> None:
    """What the process does."""
    from graphvio.mapping.process import run_mapping

    try:
        typer.echo(run_mapping(task, ready), err=True)
    except GraphvioError as error:
        typer.echo(f"graphvio: mapping: {error}", err=True)
        raise SystemExit(EXIT_FAILED) from None
