"""Results without their plots, which take most of the time of short runs: for tests whose claims are of other files.

It is also a preload of dask's workers.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from graphvio.optimization.report import figures, write
from graphvio.reporting.figures import png
from graphvio.results import writer
from graphvio.results.calibration_plot import CalibrationHistory


def _nothing(*_: Any) -> None:
    return None


def _png(figure: Figure | None) -> bytes:
    return b"" if figure is None else png(figure)


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
)


@contextmanager
def undrawn() -> Iterator[None]:
    """Leave the plots of results empty."""
    with pytest.MonkeyPatch.context() as patch:
        for module, name, instead in _PLOTS:
            patch.setattr(module, name, instead)
        yield


def dask_setup(_: Any) -> None:
    """Leave the plots of results empty in a worker, from now on; that of the map, too."""
    for module, name, instead in (*_PLOTS, (figures, "plot_plan", _nothing)):
        setattr(module, name, instead)
