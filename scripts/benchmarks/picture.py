"""The plot of the accuracy benchmark: trajectories with all pairs and with each alone, seen from above."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.report import writing
from benchmarks.runs import Outcome
from graphvio.arrays import Float
from graphvio.evaluation import MAX_GAP_S
from graphvio.geometry import se3_inverse

_DPI = 130
_TRUTH = "#222222"
_COLOURS = ("#1f5fbf", "#d62728", "#e69f00", "#2ca02c", "#8e44ad")  # all pairs together first
_WIDTH_IN, _MIN_HEIGHT_IN, _MAX_HEIGHT_IN = 10.0, 2.4, 6.0
_LEFT_IN, _RIGHT_IN, _TITLE_IN, _BOTTOM_IN, _LEGEND_IN = 0.8, 0.25, 0.75, 0.55, 0.25


@dataclass(frozen=True)
class Panel:
    """Panel of one recording.

    Attributes:
        title: title of the panel.
        lines: name of the pairs -> run, the one with all pairs first.
    """

    title: str
    lines: dict[str, Outcome]


def draw_trajectories(path: Path, panels: Sequence[Panel]) -> None:
    """Draw x-y plots of all panels below each other, with the first pose of each epoch aligned with the truth.

    Raises:
        GraphvioError: if the picture cannot be written.
    """
    views = [_Plan(panel) for panel in panels]
    heights = [view.height_in for view in views]
    total_in = sum(heights) + len(views) * (_TITLE_IN + _BOTTOM_IN) + _LEGEND_IN
    figure = Figure(figsize=(_WIDTH_IN, total_in), dpi=_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    top_in = total_in
    for view, height_in in zip(views, heights, strict=True):
        top_in -= _TITLE_IN
        left, width = _LEFT_IN / _WIDTH_IN, (_WIDTH_IN - _LEFT_IN - _RIGHT_IN) / _WIDTH_IN
        axes = figure.add_axes((left, (top_in - height_in) / total_in, width, height_in / total_in))
        view.draw(axes)
        top_in -= height_in + _BOTTOM_IN
    caption = (
        "seen from above; each line begins at the true first pose, and again at the true pose after a declared break"
    )
    figure.text(_LEFT_IN / _WIDTH_IN, 0.12 / total_in, caption, fontsize=9)
    with writing(path):
        figure.savefig(path, metadata={"Software": None} if path.suffix == ".png" else None)


class _Plan:
    """The lines of one panel, rotated so that the walk's longer side is horizontal, and the height that they need."""

    def __init__(self, panel: Panel) -> None:
        self._title = panel.title
        self._lines = {}
        for name, outcome in panel.lines.items():
            line, end_m = _from_start(outcome)
            count = len(np.unique(outcome.epochs)) - 1
            breaks = f", {count} break{'s' if count > 1 else ''}" if count else ""
            self._lines[f"{name}{breaks}, end off {100 * end_m:.1f} cm"] = line
        first = next(iter(panel.lines.values()))
        during = (first.truth.stamps_ns >= first.estimate.stamps_ns[0]) & (
            first.truth.stamps_ns <= first.estimate.stamps_ns[-1]
        )
        self._truth = first.truth.positions[during][:, :2]
        extent = np.ptp(self._truth, axis=0)
        self._turned = bool(extent[1] > extent[0])
        everything = self._oriented(np.concatenate([self._truth, *self._lines.values()]))
        low, high = np.nanmin(everything, axis=0), np.nanmax(everything, axis=0)
        margin = 0.06 * float(max(high - low)) + 0.02
        self._low, self._high = low - margin, high + margin
        width_in = _WIDTH_IN - _LEFT_IN - _RIGHT_IN
        wanted_in = width_in * (self._high[1] - self._low[1]) / (self._high[0] - self._low[0])
        self.height_in = float(np.clip(wanted_in, _MIN_HEIGHT_IN, _MAX_HEIGHT_IN))

    def _oriented(self, points: Float) -> Float:
        """Return points (N, 2), turned clockwise by 90 degrees, (x, y) to (y, -x), if that lays the walk down."""
        return np.column_stack([points[:, 1], -points[:, 0]]) if self._turned else points

    def draw(self, axes: Any) -> None:
        """Draw the panel onto axes that have the needed height."""
        truth = self._oriented(self._truth)
        axes.plot(*truth.T, color=_TRUTH, linewidth=2.6, alpha=0.35, label="truth", solid_capstyle="round")
        for i, (name, line) in reversed(list(enumerate(self._lines.items()))):
            oriented = self._oriented(line)
            style = {"color": _COLOURS[i % len(_COLOURS)], "linewidth": 1.6 if i == 0 else 1.2}
            axes.plot(*oriented.T, label=name, zorder=5 - i, **style)
            finite = oriented[np.isfinite(oriented[:, 0])]
            axes.plot(*finite[-1], "s", color=style["color"], markersize=6, markeredgecolor="white", zorder=7)
        axes.plot(*truth[0], "o", color="#2ca02c", markersize=9, markeredgecolor="white", label="start", zorder=8)
        axes.plot(*truth[-1], "s", color=_TRUTH, markersize=8, markeredgecolor="white", label="true end", zorder=6)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlim(self._low[0], self._high[0])
        axes.set_ylim(self._low[1], self._high[1])
        axes.set_xlabel("y, m" if self._turned else "x, m")
        axes.set_ylabel("-x, m" if self._turned else "y, m")
        axes.grid(color="#dddddd", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.text(0.0, 1.0, f"{self._title}\n", transform=axes.transAxes, fontweight="bold", va="bottom", fontsize=11)
        handles, labels = axes.get_legend_handles_labels()
        names = ["truth", *self._lines, "start", "true end"]
        axes.legend(
            [handles[labels.index(name)] for name in names],
            names,
            loc="lower left",
            bbox_to_anchor=(0.0, 1.0),
            ncols=len(names),
            frameon=False,
            fontsize=8,
            borderaxespad=0.2,
            handlelength=1.2,
            columnspacing=0.9,
        )


def _from_start(outcome: Outcome) -> tuple[Float, float]:
    """Return the line of a run, with the first pose of each epoch aligned with the true one.

    Returns:
        Positions (N, 2) in the truth's frame, with NaN between epochs; and the distance of the last position from the
        true one in 3-D, metres.
    """
    plotted, end_m = [], np.nan
    for epoch in np.unique(outcome.epochs):
        poses = outcome.estimate.select(outcome.epochs == epoch)
        true_poses, known = outcome.truth.at(poses.stamps_ns, MAX_GAP_S)
        if not known.any():
            continue
        first, last = np.flatnonzero(known)[[0, -1]]
        world_T_nav = true_poses.nav_T_body[0] @ se3_inverse(poses.nav_T_body[first])
        positions = poses.transformed(world_T_nav).positions
        end_m = float(np.linalg.norm(positions[last] - true_poses.positions[-1]))
        plotted += [positions[first:, :2], np.full((1, 2), np.nan)]
    return np.concatenate(plotted or [np.full((1, 2), np.nan)]), end_m
