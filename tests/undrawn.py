"""Results without their plots, which take most of the time of short runs: for tests whose claims are of other files.

It is also a preload of dask's workers.
"""

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

from matplotlib.figure import Figure

from graphvio.benchmark import run as benchmark
from graphvio.calibration.report import page
from graphvio.fleet import cluster
from graphvio.optimization.report import figures, write
from graphvio.reporting.figures import png
from graphvio.results import writer
from graphvio.results.calibration_plot import CalibrationHistory


def _nothing(*_: Any) -> None:
    return None


def _png(figure: Figure | None) -> bytes:
    return b"" if figure is None else png(figure)


def _no_pictures(*_: Any) -> dict[str, bytes]:
    return {}


def _empty_file(path: Path, *_: Any, **__: Any) -> None:
    path.write_bytes(b"")


def _empty_file_of(_: CalibrationHistory, path: Path, *__: Any) -> None:
    path.write_bytes(b"")


_PLOTS: tuple[tuple[Any, str, Any], ...] = (
    (figures, "plot_map", _nothing),
    (figures, "plot_residuals", _nothing),
    (figures, "plot_moved", _nothing),
    (figures, "plot_sigmas", _nothing),
    (write, "png", _png),
    (writer, "plot_run", _empty_file),
    (CalibrationHistory, "plot", _empty_file_of),
    (page, "_pictures", _no_pictures),
)


@contextmanager
def undrawn() -> Iterator[None]:
    """Leave the plots of results empty, here and in workers and runs of a benchmark that are begun here."""
    elsewhere = (
        (cluster, "WORKER_PRELOADS", [*cluster.WORKER_PRELOADS, __file__]),
        (benchmark, "RUN", (sys.executable, str(Path(__file__).with_name("undrawn_run.py")), "run")),
    )
    with ExitStack() as patches:
        for module, name, instead in (*_PLOTS, *elsewhere):
            patches.enter_context(patch.object(module, name, instead))
        yield


def dask_setup(_: Any) -> None:
    """Leave the plots of results empty in a worker, from now on; that of the map, too."""
    for module, name, instead in (*_PLOTS, (figures, "plot_plan", _nothing)):
        setattr(module, name, instead)
