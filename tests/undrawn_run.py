"""``graphvio run`` that leaves its plots empty: a program, which does not load matplotlib."""

from pathlib import Path
from typing import Any
from unittest.mock import patch

from graphvio.cli import main
from graphvio.results import writer
from graphvio.results.calibration_plot import CalibrationHistory


def _plot_run(path: Path, *_: Any, **__: Any) -> None:
    path.write_bytes(b"")


def _plot_calibration(_: CalibrationHistory, path: Path, *__: Any) -> None:
    path.write_bytes(b"")


if __name__ == "__main__":  # not in its own processes
    with patch.object(writer, "plot_run", _plot_run), patch.object(CalibrationHistory, "plot", _plot_calibration):
        main()
