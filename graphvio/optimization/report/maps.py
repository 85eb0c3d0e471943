"""Plan and side view of the trajectories, as the odometry emitted them and as they are now, with the loop closures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from graphvio.arrays import Bool, Float
from graphvio.optimization.optimize import Optimization
from graphvio.optimization.report.numbers import Numbers
from graphvio.reporting.figures import GREEN, RED, add_axes, empty_figure

COLOURS = ("#1f5fbf", "#f28e1c", "#8e44ad", "#17a3b8", "#8c564b", "#555555", "#e377c2", "#9a9a00")
"""Of sessions, in turn; green and red are loop closures'."""

_COLUMN_IN, _HEIGHT_IN = 4.5, 6.0
_LEFT_IN, _RIGHT_IN, _BOTTOM_IN, _GAP_IN = 0.75, 0.15, 0.55, 0.3
_LEGEND_ROW_IN, _HEADING_IN, _PER_ROW = 0.22, 0.4, 6
_REFUSED, _REFUSED_ALPHA = "loop, refused", 0.15  # there may be hundreds of them
_EDGE = {"markeredgecolor": "#111111", "markeredgewidth": 0.9, "linestyle": "none", "zorder": 5}


@dataclass(frozen=True, eq=False)
class _Line:
    """A session: positions (F, 3) by column, which of them are in the frame (F,), and where epochs begin (F,)."""

    number: int
    name: str
    colour: str
    columns: tuple[Float, Float]
    inside: Bool
    begins: Bool


def session_colour(number: int) -> str:
    """The colour of a session in all pictures."""
    return COLOURS[number % len(COLOURS)]


def draw_map(found: Optimization, numbers: Numbers, frame: int) -> Figure:
    """Online poses on the left and optimised ones on the right; plan (x, y) above, side view (x, z) below.

    Args:
        found: the optimisation.
        numbers: of it.
        frame: number of the frame; only what is in it is drawn.
    """
    lines = list(_lines(found, numbers, frame))
    points = np.concatenate([column[line.inside] for line in lines for column in line.columns])
    figure, panels = _panels(points, _LEGEND_ROW_IN * -(-_labels(found, lines) // _PER_ROW))
    for column, plots in enumerate(panels):
        for axes, z in zip(plots, (1, 2), strict=True):
            _draw_loops(axes, found, lines, column, z)
            for line in lines:
                _draw_line(axes, line, column, z)
    plan = panels[0][0]
    handles, labels = plan.get_legend_handles_labels()
    kept = dict(zip(labels, handles, strict=True))
    width, height = figure.get_size_inches()
    legend = figure.legend(
        kept.values(), kept.keys(), loc="upper left", bbox_to_anchor=(_LEFT_IN / width, 1.0 - 0.05 / height),
        ncol=_PER_ROW, frameon=False, fontsize=9, borderaxespad=0.0, handlelength=1.6, columnspacing=1.4,
    )  # fmt: skip
    for text, handle in zip(legend.get_texts(), legend.get_lines(), strict=True):
        if text.get_text() == _REFUSED:
            handle.set(alpha=0.6, linewidth=1.0)  # what is faint in the plot is to be seen here
    return figure


def _lines(found: Optimization, numbers: Numbers, frame: int) -> Iterator[_Line]:
    for number, (session, told) in enumerate(zip(found.sessions, numbers.sessions, strict=True)):
        inside = np.asarray(session.frame == frame)
        if inside.any():
            columns = (told.online[:, :3, 3], session.nav_T_body[:, :3, 3])
            begins = np.append(True, np.diff(session.record.epoch) != 0)
            yield _Line(number, told.name, session_colour(number), columns, inside, begins)


def _labels(found: Optimization, lines: list[_Line]) -> int:
    """How many the legend has at most."""
    judged = {not loop.refusal for loop in found.loops}
    epochs = sum(int((line.begins & line.inside).sum()) for line in lines) > len(lines)
    return len(lines) + len(judged) + epochs + 2


def _draw_line(axes: Any, line: _Line, column: int, z: int) -> None:
    positions = np.where(line.inside[:, None], line.columns[column], np.nan)
    drawn = np.insert(positions, np.flatnonzero(line.begins), np.nan, axis=0)
    axes.plot(*drawn[:, [0, z]].T, color=line.colour, linewidth=1.1, label=line.name, zorder=3)
    rows = np.flatnonzero(line.inside)
    again = positions[line.begins & line.inside & (np.arange(len(positions)) != rows[0])]
    if len(again):
        axes.plot(again[:, 0], again[:, z], "D", color=line.colour, markersize=5.5, label="new epoch", **_EDGE)
    for row, marker, name in ((rows[0], "o", "start"), (rows[-1], "s", "end")):
        at = positions[row]
        axes.plot(at[0], at[z], marker, color=line.colour, markersize=6, label=name, **_EDGE)


def _draw_loops(axes: Any, found: Optimization, lines: list[_Line], column: int, z: int) -> None:
    by_number = {line.number: line for line in lines}
    segments: dict[bool, list[Float]] = {True: [], False: []}
    for loop in found.loops:
        ends = []
        for place in (loop.closure.reference, loop.closure.current):
            line = by_number.get(place.session)
            if line is not None and line.inside[place.row]:
                ends.append(line.columns[column][place.row])
        if len(ends) == 2:
            segments[not loop.refusal] += [*ends, np.full(3, np.nan)]
    refused = {"color": RED, "linewidth": 0.5, "alpha": _REFUSED_ALPHA, "zorder": 1.5}
    used = {"color": GREEN, "linewidth": 1.2, "alpha": 0.85, "zorder": 4, "marker": ".", "markersize": 3}
    for is_used, name, style in ((False, _REFUSED, refused), (True, "loop, used", used)):
        if segments[is_used]:
            axes.plot(*np.array(segments[is_used])[:, [0, z]].T, label=name, **style)


def _panels(points: Float, legend_in: float) -> tuple[Figure, list[tuple[Any, Any]]]:
    """Figure, and of each column the plan and the side view: one scale, boxes that fit the data."""
    low, high = points.min(axis=0), points.max(axis=0)
    centre, span = 0.5 * (low + high), 1.12 * (high - low)
    span[0] = max(span[0], 0.6 * span[1], 0.1)
    span[1] = max(span[1], 0.35 * span[0])
    span[2] = max(1.3 * span[2], 0.2 * span[0])
    inch_per_m = min(_COLUMN_IN / span[0], _HEIGHT_IN / (span[1] + span[2]))
    width, plan_in, side_in = inch_per_m * span
    total_width = max(_LEFT_IN + 2 * width + _GAP_IN + _RIGHT_IN, 6.4)
    total_height = _BOTTOM_IN + side_in + _GAP_IN + plan_in + _HEADING_IN + legend_in
    figure = empty_figure(total_width, total_height)
    made = []
    for column, name in enumerate(("online", "optimised")):
        left = (_LEFT_IN + column * (width + _GAP_IN)) / total_width
        plots = []
        for z, bottom_in, height_in in ((1, _BOTTOM_IN + side_in + _GAP_IN, plan_in), (2, _BOTTOM_IN, side_in)):
            place = (left, bottom_in / total_height, width / total_width, height_in / total_height)
            axes = add_axes(figure, place)
            axes.set_aspect("equal", adjustable="box")
            axes.set_xlim(centre[0] - span[0] / 2, centre[0] + span[0] / 2)
            axes.set_ylim(centre[z] - span[z] / 2, centre[z] + span[z] / 2)
            axes.tick_params(labelsize=8.5, labelbottom=z == 2, labelleft=column == 0)
            if column == 0:
                axes.set_ylabel("xyz"[z] + ", m", fontsize=9)
            plots.append(axes)
        plots[0].set_title(name, fontsize=10, loc="left")
        plots[1].set_xlabel("x, m", fontsize=9)
        plots[1].locator_params(axis="y", nbins=4)
        made.append((plots[0], plots[1]))
    return figure, made
