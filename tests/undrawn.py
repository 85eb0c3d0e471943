"""Replaces the drawings of results by empty files: a preload of workers, whose short runs mostly draw."""

from pathlib import Path
from typing import Any

from graphvio.optimization.report import figures, write
from graphvio.results import writer


def _nothing(*_: Any) -> bytes:
    return b""


def _empty_file(path: Path, *_: Any, **__: Any) -> None:
    path.write_bytes(b"")


for _plot in ("plot_map", "plot_residuals", "plot_moved", "plot_sigmas"):
    setattr(figures, _plot, _nothing)
write.png = _nothing
writer.plot_run = _empty_file
