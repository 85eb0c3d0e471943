"""Figures of an optimisation's report: maps, a plan, residuals, and changes and uncertainty over time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator
from scipy.special import chdtr  # scipy.stats takes a second to import

from graphvio.arrays import Bool, Float
from graphvio.optimization.optimize import Optimization
from graphvio.optimization.report.numbers import Kind, Numbers, per_dimension, seconds
from graphvio.reporting.figures import BLUE, GREEN, GREY, RED, add_axes, empty_figure

_COLOURS = ("#1f5fbf", "#f28e1c", "#8e44ad", "#17a3b8", "#8c564b", "#555555", "#e377c2", "#9a9a00")
"""Colours of the sessions, in turn; green and red are those of loop closures."""

_COLUMN_IN, _HEIGHT_IN = 4.5, 6.0
_LEFT_IN, _RIGHT_IN, _BOTTOM_IN, _GAP_IN = 0.75, 0.15, 0.55, 0.3
_LEGEND_ROW_IN, _HEADING_IN, _PER_ROW = 0.22, 0.4, 6
_REFUSED, _REFUSED_ALPHA = "loop, refused", 0.15  # there may be hundreds
_EDGE = {"markeredgecolor": "#111111", "markeredgewidth": 0.9, "linestyle": "none", "zorder": 5}

_PLAN_IN, _MIN_PLAN_IN, _PLAN_PER_ROW = 7.0, 3.2, 4
_PLAN_TAIL = 0.05  # share of the points on each side that the plan's limits may leave out

_COLUMNS = 3
_MIN_SQUARE, _MAX_SQUARE = 1e-4, 1e6  # squared distances per dimension within the bins
_BINS_PER_DECADE = 5


@dataclass(frozen=True, eq=False)
class _Line:
    """A session on a map: positions (F, 3) by column, whether they are in the frame (F,) and begin an epoch (F,)."""

    number: int
    name: str
    colour: str
    columns: tuple[Float, Float]
    inside: Bool
    begins: Bool


def plot_map(found: Optimization, numbers: Numbers, frame: int) -> Figure:
    """Plot online poses on the left and optimised ones on the right; plan (x, y) above, side view (x, z) below."""
    lines = list(_lines(found, numbers, frame))
    points = np.concatenate([column[line.inside] for line in lines for column in line.columns])
    figure, panels = _panels(points, _LEGEND_ROW_IN * -(-_labels(found, lines) // _PER_ROW))
    for column, plots in enumerate(panels):
        for axes, z in zip(plots, (1, 2), strict=True):
            _plot_loops(axes, found, lines, column, z)
            for line in lines:
                _plot_line(axes, line, column, z)
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
            handle.set(alpha=0.6, linewidth=1.0)  # faint in the plot, but legible here
    return figure


def plot_plan(found: Optimization, numbers: Numbers, frame: int, points: Float | None) -> Figure:
    """Plot a frame from above: points of its map (N, 3), optimised trajectories, and loop closures.

    The limits hold all trajectories and, along each axis, the inner 90 % of the points, as a few are far off.
    """
    lines = list(_lines(found, numbers, frame))
    shown = np.concatenate([line.columns[1][line.inside, :2] for line in lines])
    if points is not None and len(points):
        near = np.quantile(points[:, :2], [_PLAN_TAIL, 1.0 - _PLAN_TAIL], axis=0)
        shown = np.concatenate([shown, near])
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = 0.05 * max(float((high - low).max()), 0.1)
    extent = high - low + 2.0 * margin
    inch_per_m = _PLAN_IN / float(extent.max())
    width, height = np.maximum(inch_per_m * extent, _MIN_PLAN_IN)
    rows = -(-_labels(found, lines) // _PLAN_PER_ROW)
    total_width, total_height = (
        _LEFT_IN + width + _RIGHT_IN,
        _BOTTOM_IN + height + _GAP_IN + _LEGEND_ROW_IN * rows,
    )
    figure = empty_figure(total_width, total_height)
    place = (_LEFT_IN / total_width, _BOTTOM_IN / total_height, width / total_width, height / total_height)
    axes = add_axes(figure, place)
    if points is not None:
        style = {"color": GREY, "markersize": 2.0, "markeredgewidth": 0.0, "zorder": 1}
        axes.plot(points[:, 0], points[:, 1], ".", label="points", **style)
    _plot_loops(axes, found, lines, 1, 1)
    for line in lines:
        _plot_line(axes, line, 1, 1)
    centre, half = (low + high) / 2.0, np.array([width, height]) / inch_per_m / 2.0
    axes.set_aspect("equal", adjustable="box")  # the axes' place already has this aspect
    axes.set_xlim(centre[0] - half[0], centre[0] + half[0])
    axes.set_ylim(centre[1] - half[1], centre[1] + half[1])
    axes.set_xlabel("x, m", fontsize=9)
    axes.set_ylabel("y, m", fontsize=9)
    axes.tick_params(labelsize=8.5)
    handles, labels = axes.get_legend_handles_labels()
    kept = dict(zip(labels, handles, strict=True))
    legend = axes.legend(
        kept.values(), kept.keys(), loc="lower left", bbox_to_anchor=(0.0, 1.0), ncol=_PLAN_PER_ROW,
        frameon=False, fontsize=9, borderaxespad=0.3, handlelength=1.6, columnspacing=1.4,
    )  # fmt: skip
    for text, handle in zip(legend.get_texts(), legend.get_lines(), strict=True):
        if text.get_text() == "points":
            handle.set(markersize=6.0)  # smaller ones are not legible
    return figure


def plot_residuals(numbers: Numbers) -> Figure:
    """Plot histograms of squared Mahalanobis distances per dimension of each kind of factor, before and after."""
    kinds = [kind for kind in numbers.kinds if len(kind.after.distances) or len(kind.before.distances)]
    rows = max(-(-len(kinds) // _COLUMNS), 1)
    height = 0.65 + 2.2 * rows
    figure = empty_figure(9.2, height)
    edges = _edges(kinds)
    for number, kind in enumerate(kinds):
        row, column = divmod(number, _COLUMNS)
        bottom = (0.5 + 2.2 * (rows - 1 - row)) / height
        axes = add_axes(figure, (0.06 + column * 0.32, bottom, 0.28, 1.65 / height))
        _plot_kind(axes, kind, edges)
        if column == 0:
            axes.set_ylabel("factors", fontsize=9)
        if number + _COLUMNS >= len(kinds):
            axes.set_xlabel("squared distance per dimension", fontsize=9)
    if kinds:
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(
            handles,
            labels,
            loc="upper left",
            bbox_to_anchor=(0.055, 1.0),
            ncol=3,
            borderaxespad=0.2,
            frameon=False,
            fontsize=9,
        )
    return figure


def plot_moved(found: Optimization, numbers: Numbers) -> Figure:
    """Plot the distance between online and optimised poses over time, with ticks where used loop closures end."""
    factor, unit = _unit(max(float(each.moved_m.max()) for each in numbers.sessions))
    figure, panels = _stacked(f"position moved, {unit}", "rotation moved, degrees", with_legend=len(found.sessions) > 1)
    for number, (session, each) in enumerate(zip(found.sessions, numbers.sessions, strict=True)):
        for panel, values in zip(panels, (factor * each.moved_m, each.moved_deg), strict=True):
            _plot(panel, seconds(session), values, session.record.epoch, _colour(number), each.name)
    for panel in panels:
        panel.set_ylim(0.0, None)
    for number, session in enumerate(found.sessions):
        places = [place for loop in found.loops if not loop.refusal
                  for place in (loop.closure.reference, loop.closure.current) if place.session == number]  # fmt: skip
        if places:
            at = seconds(session)[[place.row for place in places]]
            for panel in panels:
                options = {"transform": panel.get_xaxis_transform(), "clip_on": False, "zorder": 4}
                colour = GREEN if len(found.sessions) == 1 else _colour(number)
                panel.plot(at, np.full(len(at), 0.02), "|", color=colour, markersize=5, alpha=0.7, **options)
    _finish(panels, len(found.sessions) > 1)
    return figure


def plot_sigmas(found: Optimization, numbers: Numbers) -> Figure:
    """Plot standard deviations of positions and rotations over time, online and optimised."""
    factor, unit = _unit(max(float(each.sigma_m.max()) for each in numbers.sessions))
    figure, panels = _stacked(f"sigma of position, {unit}", "sigma of rotation, degrees", with_legend=True)
    for number, (session, each) in enumerate(zip(found.sessions, numbers.sessions, strict=True)):
        colour, rows, since_s = _colour(number), session.nodes.rows, seconds(session)
        name = "optimised" if len(found.sessions) == 1 else each.name
        for panel, online, now in (
            (panels[0], factor * each.online_sigma_m, factor * each.sigma_m),
            (panels[1], each.online_sigma_deg, each.sigma_deg),
        ):
            epoch = session.record.epoch
            label = "online" if number == 0 else "_"
            _plot(panel, since_s, online, epoch, GREY if len(found.sessions) == 1 else colour, label, thin=True)
            _plot(panel, since_s[rows], now, epoch[rows], colour, name)
    for panel in panels:
        panel.set_yscale("log")
        panel.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        panel.yaxis.set_major_formatter("{x:g}")
        panel.yaxis.set_minor_locator(NullLocator())
    _finish(panels, True)
    return figure


def _lines(found: Optimization, numbers: Numbers, frame: int) -> Iterator[_Line]:
    for number, (session, each) in enumerate(zip(found.sessions, numbers.sessions, strict=True)):
        inside = np.asarray(session.frame == frame)
        if inside.any():
            columns = (each.online[:, :3, 3], session.nav_T_body[:, :3, 3])
            begins = np.append(True, np.diff(session.record.epoch) != 0)
            yield _Line(number, each.name, _colour(number), columns, inside, begins)


def _labels(found: Optimization, lines: list[_Line]) -> int:
    """Return the maximum number of labels that the legend may have."""
    judged = {not loop.refusal for loop in found.loops}
    epochs = sum(int((line.begins & line.inside).sum()) for line in lines) > len(lines)
    return len(lines) + len(judged) + epochs + 2


def _plot_line(axes: Any, line: _Line, column: int, z: int) -> None:
    positions = np.where(line.inside[:, None], line.columns[column], np.nan)
    line_positions = np.insert(positions, np.flatnonzero(line.begins), np.nan, axis=0)
    axes.plot(*line_positions[:, [0, z]].T, color=line.colour, linewidth=1.1, label=line.name, zorder=3)
    rows = np.flatnonzero(line.inside)
    again = positions[line.begins & line.inside & (np.arange(len(positions)) != rows[0])]
    if len(again):
        axes.plot(again[:, 0], again[:, z], "D", color=line.colour, markersize=5.5, label="new epoch", **_EDGE)
    for row, marker, name in ((rows[0], "o", "start"), (rows[-1], "s", "end")):
        at = positions[row]
        axes.plot(at[0], at[z], marker, color=line.colour, markersize=6, label=name, **_EDGE)


def _plot_loops(axes: Any, found: Optimization, lines: list[_Line], column: int, z: int) -> None:
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
    """Make a figure with the axes of plan and side view in each column: equal scales, limits that fit the points."""
    low, high = points.min(axis=0), points.max(axis=0)
    centre, extent = 0.5 * (low + high), 1.12 * (high - low)
    extent[0] = max(extent[0], 0.6 * extent[1], 0.1)
    extent[1] = max(extent[1], 0.35 * extent[0])
    extent[2] = max(1.3 * extent[2], 0.2 * extent[0])
    inch_per_m = min(_COLUMN_IN / extent[0], _HEIGHT_IN / (extent[1] + extent[2]))
    width, plan_in, side_in = inch_per_m * extent
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
            axes.set_xlim(centre[0] - extent[0] / 2, centre[0] + extent[0] / 2)
            axes.set_ylim(centre[z] - extent[z] / 2, centre[z] + extent[z] / 2)
            axes.tick_params(labelsize=8.5, labelbottom=z == 2, labelleft=column == 0)
            if column == 0:
                axes.set_ylabel("xyz"[z] + ", m", fontsize=9)
            plots.append(axes)
        plots[0].set_title(name, fontsize=10, loc="left")
        plots[1].set_xlabel("x, m", fontsize=9)
        plots[1].locator_params(axis="y", nbins=4)
        made.append((plots[0], plots[1]))
    return figure, made


def _edges(kinds: Sequence[Kind]) -> Float:
    """Return the edges of the bins for all kinds of factor; the outermost bins include the values beyond."""
    shown = [per_dimension(each) for kind in kinds for each in (kind.before, kind.after)]
    values = np.concatenate([np.ones(1), *shown])
    lowest, highest = np.log10(np.clip(np.quantile(values[values > 0.0], [0.005, 0.995]), _MIN_SQUARE, _MAX_SQUARE))
    low, high = min(int(np.floor(lowest)), -2), max(int(np.ceil(highest)), 2)
    return np.asarray(np.logspace(low, high, (high - low) * _BINS_PER_DECADE + 1))


def _plot_kind(axes: Any, kind: Kind, edges: Float) -> None:
    inside = (edges[0] * 1.0001, edges[-1] * 0.9999)
    before, after = (np.clip(per_dimension(each), *inside) for each in (kind.before, kind.after))
    axes.hist(after, bins=edges, color=BLUE, alpha=0.75, label="after")
    axes.hist(before, bins=edges, histtype="step", color="#f28e1c", linewidth=1.3, label="before")
    some = kind.after if len(kind.after.distances) else kind.before
    dimension = some.dimensions / len(some.distances)
    share = np.diff(chdtr(dimension, edges * dimension))
    middle = np.sqrt(edges[:-1] * edges[1:])
    axes.plot(middle, len(some.distances) * share, color="#111111", linewidth=1.1, linestyle=(0, (4, 2)),
              label="noise as assumed (chi-square)")  # fmt: skip
    axes.set_xscale("log")
    axes.set_xlim(edges[0], edges[-1])
    count = len(some.distances)
    axes.set_title(f"{kind.name}: {count} {'factor' if count == 1 else 'factors'}", fontsize=9.5, loc="left")
    axes.tick_params(labelsize=8)
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))


def _unit(max_m: float) -> tuple[float, str]:
    """Return the factor from metres to a unit of length, and the unit's name."""
    return (1e3, "mm") if max_m < 0.1 else (1.0, "m")


def _stacked(*labels: str, with_legend: bool) -> tuple[Figure, list[Any]]:
    height = 4.5 if with_legend else 4.3
    figure = empty_figure(7.6, height)
    panels = [add_axes(figure, (0.1, bottom / height, 0.87, 1.75 / height)) for bottom in (2.42, 0.5)]
    for panel, label in zip(panels, labels, strict=True):
        panel.set_ylabel(label, fontsize=9)
        panel.tick_params(labelsize=8.5)
    panels[0].tick_params(labelbottom=False)
    panels[1].set_xlabel("time since the session's start, s", fontsize=9)
    return figure, panels


def _plot(
    axes: Any, since_s: Float, values: Float, epoch: Any, colour: str, label: str,
    *, thin: bool = False,
) -> None:  # fmt: skip
    breaks = np.flatnonzero(np.diff(epoch)) + 1
    times_s, values = (np.insert(each, breaks, np.nan) for each in (since_s, values))
    style: dict[str, Any] = {"linewidth": 0.9, "linestyle": (0, (2, 1.5))} if thin else {"linewidth": 1.4}
    axes.plot(times_s, values, color=colour, label=label, **style)


def _finish(panels: Sequence[Any], with_legend: bool) -> None:
    for panel in panels:
        panel.margins(x=0.01)
    if with_legend:
        panels[0].legend(frameon=False, fontsize=8.5, ncol=4, loc="lower left", bbox_to_anchor=(0.0, 1.0),
                         borderaxespad=0.1)  # fmt: skip


def _colour(session: int) -> str:
    return _COLOURS[session % len(_COLOURS)]
