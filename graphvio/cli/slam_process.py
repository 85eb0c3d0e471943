"""The process in which the SLAM of ``graphvio slam`` runs."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from graphvio.cli.output import lasting_streams
from graphvio.cli.shared import EXIT_BAD_INPUT, warn
from graphvio.errors import GraphvioError, MapError, ServiceError, writing
from graphvio.runtime import stop_signals_blocked

if TYPE_CHECKING:
    from multiprocessing.synchronize import Event

    from graphvio.live.outputs import PathOutput
    from graphvio.mapping.process import MappingTask

_POLL_S = 0.1
_PATIENCE_S = 300.0  # time after the odometry's end in which a SLAM that is behind has to process the last keyframes
_PATHS = ("odometry.txt", "online.txt")


class SlamProcess:
    """The process of the SLAM. When it fails, a warning is printed and the odometry goes on.

    Args:
        task: task of the process; its working folder is made here, so that it is removed even if the process is killed.
        path: recorder of the odometry's path, which is written next to the map.
    """

    def __init__(self, task: MappingTask, path: PathOutput) -> None:
        from multiprocessing import get_context

        self._out = task.out
        self._path = path
        self._is_reported = False
        context = get_context("spawn")
        self._ready = context.Event()  # before signals are blocked: its helper process unblocks them
        with stop_signals_blocked():  # the odometry handles signals, and the SLAM ends with it
            try:
                self._folder = tempfile.mkdtemp(prefix="graphvio-map-")
            except OSError as error:
                raise MapError(f"{tempfile.gettempdir()}: no folder can be made ({error}); set TMPDIR") from None
            started = replace(task, folder=Path(self._folder))
            self._process = context.Process(target=_map, args=(started, self._ready), name="graphvio-slam")
            self._process.start()

    def wait_ready(self, is_stopped: Callable[[], bool]) -> None:
        """Wait until the SLAM receives keyframes; places of keyframes before that would be missing in the map.

        Raises:
            KeyboardInterrupt: if ``is_stopped`` returns True before that.
            ServiceError: if the process fails before that.
        """
        while not self._ready.wait(_POLL_S):
            if is_stopped():
                raise KeyboardInterrupt
            if self._process.exitcode:
                raise ServiceError(self._failure)

    def check(self) -> None:
        """Print a warning, once, if the process has failed."""
        if self._process.exitcode and not self._is_reported:
            self._warn(f"{self._failure}; the odometry goes on without it")

    def finish(self) -> bool:
        """Wait for the saved map, and write the odometry's path next to it; return whether both succeeded."""
        if self._process.is_alive():
            typer.echo("waiting for the SLAM, which processes the last keyframes", err=True)
        self._process.join(_PATIENCE_S)
        if self._process.exitcode is None:
            self._warn(f"the SLAM is not done {_PATIENCE_S:g} s after the odometry; its map is not saved")
        elif self._process.exitcode and not self._is_reported:
            self._warn(self._failure)
        is_done = self._process.exitcode == 0
        if self._out is None:
            return is_done
        try:
            self._write_path(self._out)
        except GraphvioError as error:
            self._warn(str(error))
            return False
        paths = ", ".join(_PATHS)
        if is_done:
            typer.echo(f"map: {self._out}; paths in it: {paths} as estimated online, trajectory.txt as corrected")
        else:
            typer.echo(f"{self._out}: has the paths {paths} as estimated online")
        return is_done

    def close(self) -> None:
        """Kill the process if it still runs, and remove its folder."""
        self._process.kill()
        self._process.join()
        shutil.rmtree(self._folder, ignore_errors=True)

    @property
    def _failure(self) -> str:
        return f"the SLAM failed (exit code {self._process.exitcode}); its messages are above"

    def _warn(self, message: str) -> None:
        self._is_reported = True
        warn(message)

    def _write_path(self, out: Path) -> None:
        with writing(out, MapError, "the odometry's path is lost"):
            out.mkdir(parents=True, exist_ok=True)  # a SLAM that failed may not have made it
            for name in _PATHS:
                (out / name).unlink(missing_ok=True)  # a file of an earlier session would be taken for one of this
        self._path.write(out)


def _map(task: MappingTask, ready: Event) -> None:
    """Run the SLAM's task; called in the SLAM's process."""
    from graphvio.mapping.process import run_mapping

    with lasting_streams():
        try:
            typer.echo(run_mapping(task, ready), err=True)
        except GraphvioError as error:
            warn(f"mapping: {error}")
            raise SystemExit(EXIT_BAD_INPUT) from None
