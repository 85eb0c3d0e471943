"""Warm-up of a command, with a progress bar while kernels are compiled."""

from __future__ import annotations

import threading
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

if TYPE_CHECKING:
    from graphvio.config import Config
    from graphvio.rig import Rig

_PERIOD_S = 0.5


def warm_up_visibly(rig: Rig, config: Config, *, wait_for_calibration: bool = True) -> None:
    """Compile or load all kernels, see `graphvio.warmup.warm_up`; in a terminal a bar shows what is compiled."""
    from graphvio.warmup import warm_up

    with _CompilationBar():
        warm_up(rig, config, wait_for_calibration=wait_for_calibration)


class _CompilationBar(AbstractContextManager["_CompilationBar"]):
    """Bar that appears when a kernel is compiled and disappears at the end; none where there is no terminal."""

    def __init__(self) -> None:
        columns = (BarColumn(20), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
        self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
        self._has_ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="graphvio-compilation-bar", daemon=True)

    def __enter__(self) -> _CompilationBar:
        if self._bar.console.is_terminal:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._has_ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _watch(self) -> None:
        from graphvio.kernels import compilation_progress

        task = self._bar.add_task("", total=None)
        while not self._has_ended.wait(_PERIOD_S):
            progress = compilation_progress()
            if progress is None:
                continue
            self._bar.start()
            self._bar.update(
                task, completed=progress.compiled, total=progress.total, description=f"kernels: {progress.newest}"
            )
        self._bar.stop()
