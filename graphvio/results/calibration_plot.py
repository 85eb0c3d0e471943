"""Plot of the estimated calibration over the time of a run."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from graphvio.arrays import Float
from graphvio.results.plotting import new_figure, save_figure
from graphvio.self_calibration.curves import Curve, curves_of, values_of, with_sigma
from graphvio.self_calibration.estimate import CalibrationEstimate

_COLUMNS = 2
_PANEL_IN, _HEIGHT_IN, _LABEL_IN, _LEGEND_IN, _GAP_IN, _HEAD_IN, _FOOT_IN = 4.2, 1.75, 0.75, 2.6, 0.42, 0.85, 0.5
_COLOURS = ("#1f5fbf", "#d1602a", "#2e9b57", "#8e44ad", "#b8860b", "#17a398", "#c2185b", "#555555")
_STYLES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1, 1.2)), (0, (5, 1.5, 1, 1.5)))
_LEGEND_ROWS = 9


class CalibrationHistory:
    """Collects the estimates of the calibration during a run, and plots them."""

    def __init__(self) -> None:
        self._curves: list[Curve] = []
        self._stamps_ns: list[int] = []
        self._values: list[tuple[Float, Float]] = []

    def add(self, stamp_ns: int, estimate: CalibrationEstimate) -> None:
        """Add an estimate that is in force from a stamp on; stamps must increase."""
        if not self._curves:
            self._curves = curves_of(estimate.file_rig)
        self._stamps_ns.append(stamp_ns)
        self._values.append(values_of(self._curves, estimate))

    def plot(self, path: Path, end_ns: int, name: str = "") -> None:
        """Plot differences from the rig file with a band of one standard deviation, one panel per group of curves.

        Args:
            path: image file; its suffix chooses the format.
            end_ns: stamp of the end of the run.
            name: start of the title.

        Raises:
            GraphvioError: if the file cannot be written.
        """
        seconds = 1e-9 * (np.array([*self._stamps_ns, end_ns]) - self._stamps_ns[0])
        differences, sigmas = (np.array([*column, column[-1]]) for column in zip(*self._values, strict=True))
        groups = [list(group) for _, group in groupby(range(len(self._curves)), lambda i: self._curves[i].group)]
        n_rows = -(-len(groups) // _COLUMNS)
        width_in = _COLUMNS * (_LABEL_IN + _PANEL_IN + _LEGEND_IN)
        height_in = _HEAD_IN + n_rows * (_HEIGHT_IN + _GAP_IN) + _FOOT_IN - _GAP_IN
        figure = new_figure(width_in, height_in)
        title = f"{name}: {_TITLE}" if name else _TITLE.capitalize()
        figure.text(_LABEL_IN / width_in, 1.0 - 0.4 / height_in, title, fontsize=13, fontweight="bold")
        for number, group in enumerate(groups):
            row, column = divmod(number, _COLUMNS)
            left_in = _LABEL_IN + column * (_LABEL_IN + _PANEL_IN + _LEGEND_IN)
            bottom_in = _FOOT_IN + (n_rows - 1 - row) * (_HEIGHT_IN + _GAP_IN)
            place = (left_in / width_in, bottom_in / height_in, _PANEL_IN / width_in, _HEIGHT_IN / height_in)
            axes: Any = figure.add_axes(place)
            curves = [self._curves[i] for i in group]
            _plot_group(axes, curves, seconds, differences[:, group], sigmas[:, group])
            is_lowest = number + _COLUMNS >= len(groups)
            axes.tick_params(labelsize=8, labelbottom=is_lowest)
            if is_lowest:
                axes.set_xlabel("time, s")
        save_figure(figure, path)


_TITLE = "calibration, difference from the rig file, with one standard deviation"


def _plot_group(axes: Any, curves: list[Curve], seconds: Float, differences: Float, sigmas: Float) -> None:
    """Plot the M curves of a group over the times (N,), from differences and sigmas (N, M)."""
    items = list(dict.fromkeys(curve.item for curve in curves))
    components = list(dict.fromkeys(curve.component for curve in curves))
    unit = f" {curves[0].unit}" if curves[0].unit else ""
    for m, curve in enumerate(curves):
        item, component = items.index(curve.item), components.index(curve.component)
        colour, style = (item, component) if len(items) > 1 else (component, 0)
        look = {"color": _COLOURS[colour % len(_COLOURS)], "linewidth": 1.3}
        value, sigma = differences[:, m], sigmas[:, m]
        axes.fill_between(seconds, value - sigma, value + sigma, step="post", color=look["color"], alpha=0.1, lw=0)
        label = f"{curve.name}  {with_sigma(value[-1], sigma[-1])}{unit}".strip()
        axes.step(seconds, value, where="post", linestyle=_STYLES[style % len(_STYLES)], label=label, **look)
    axes.axhline(0.0, color="#999999", linewidth=0.8, zorder=1)
    axes.set_xlim(0.0, max(float(seconds[-1]), 1e-3))
    axes.set_title(curves[0].group, fontsize=10, loc="left", pad=4, y=1.0)  # with y given, matplotlib computes none
    axes.set_ylabel(unit.strip())
    axes.locator_params(nbins=4)  # each tick costs matplotlib 3 ms
    axes.grid(color="#e2e2e2", linewidth=0.6)
    axes.set_axisbelow(True)
    rows = len(curves)
    axes.legend(
        loc="upper left", bbox_to_anchor=(1.01, 1.04), frameon=False, fontsize=8 if rows <= _LEGEND_ROWS else 6,
        ncol=-(-rows // (2 * _LEGEND_ROWS)), handlelength=2.2, labelspacing=0.25,
    )  # fmt: skip
