"""Warm-up of a command, with a progress bar while kernels are compiled."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

if TYPE_CHECKING:
    from graphvio.config import Config
    from graphvio.rig import Rig

_PERIOD_S = 0.5


def warm_up_visibly(rig: Rig, config: Config, *, wait_for_calibration: bool = True) -> None:
    """Compile or load all kernels, see `graphvio.warmup.warm_up`; in a terminal, a bar shows the compilation."""
    from graphvio.warmup import warm_up

    columns = (BarColumn(20), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    bar, has_ended = Progress(*columns, console=Console(stderr=True), transient=True), threading.Event()
    watcher = threading.Thread(target=_watch, args=(bar, has_ended), name="graphvio-compilation-bar", daemon=True)
    if bar.console.is_terminal:
        watcher.start()
    try:
        warm_up(rig, config, wait_for_calibration=wait_for_calibration)
    finally:
        has_ended.set()
        if watcher.is_alive():
            watcher.join()


def _watch(bar: Progress, has_ended: threading.Event) -> None:
    """Show the bar from the first compilation of a kernel until the end of the warm-up."""
    from graphvio.kernels import compilation_progress

    task = bar.add_task("", total=None)
    while not has_ended.wait(_PERIOD_S):
        progress = compilation_progress()
        if progress is not None:
            bar.start()
            bar.update(
                task, completed=progress.compiled, total=progress.total, description=f"kernels: {progress.newest}"
            )
    bar.stop()
