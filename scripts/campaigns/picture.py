"""The plot of the consistency campaign: mean squared Mahalanobis distances over time, each with its 95 % band."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from benchmarks.report import writing
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from campaigns.measures import Squares

_BLUE, _BAND = "#1f5fbf", "#dfe8f5"
_COLUMNS = 2
_DPI = 130
_MIN_TIMES = 3


def draw_consistency(path: Path, squares: Squares, names: Mapping[str, str]) -> None:
    """Plot one panel for each quantity that has values at several times.

    Raises:
        GraphvioError: if the plot cannot be written.
    """
    plotted = [name for name in names if len(squares.over_time(name)[0]) >= _MIN_TIMES]
    rows = -(-len(plotted) // _COLUMNS)
    figure = Figure(figsize=(10.0, 2.3 * rows), dpi=_DPI, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, _COLUMNS, sharex=True, squeeze=False)
    for axis in axes.flat[len(plotted) :]:
        axis.set_visible(False)
    for axis, name in zip(axes.flat, plotted, strict=False):
        times, means = squares.over_time(name)
        dimensions, (low, high) = squares.dimensions[name], squares.band(name)
        axis.axhspan(low, high, color=_BAND, label="95 % band")
        axis.axhline(dimensions, color="#888888", linewidth=0.8)
        axis.plot(times, means, color=_BLUE, linewidth=1.0, marker="o" if len(times) < 60 else "", markersize=3)
        axis.set_ylim(0.0, 2.0 * dimensions)
        axis.set_title(f"{names[name]} ({dimensions} dimensions)", fontsize=10)
        axis.grid(color="#dddddd", linewidth=0.5)
    for axis in axes[-1]:
        axis.set_xlabel("seconds")
    axes[0, 0].legend(loc="upper right", fontsize=8)
    figure.suptitle(f"Mean squared Mahalanobis distance of {squares.runs(plotted[0])} runs", fontsize=11)
    with writing(path):
        figure.savefig(path)
