"""Residuals against what chance would make of them, and over time how far poses moved and how well they are known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator
from scipy.stats import chi2

from graphvio.arrays import Float
from graphvio.optimization.optimize import Optimization
from graphvio.optimization.report.maps import session_colour
from graphvio.optimization.report.measures import seconds
from graphvio.optimization.report.numbers import Kind, Numbers, per_dimension
from graphvio.reporting.figures import BLUE, GREEN, GREY, add_axes, empty_figure

_COLUMNS = 3
_LEAST, _MOST = 1e-4, 1e6  # squared distances per dimension that are told apart
_BINS_PER_DECADE = 5


def draw_residuals(numbers: Numbers) -> Figure:
    """Squared Mahalanobis distances per dimension of each kind of factor, before and after, by powers of ten."""
    kinds = [kind for kind in numbers.kinds if len(kind.after.distances) or len(kind.before.distances)]
    rows = max(-(-len(kinds) // _COLUMNS), 1)
    height = 0.65 + 2.2 * rows
    figure = empty_figure(9.2, height)
    edges = _edges(kinds)
    for number, kind in enumerate(kinds):
        row, column = divmod(number, _COLUMNS)
        bottom = (0.5 + 2.2 * (rows - 1 - row)) / height
        axes = add_axes(figure, (0.06 + column * 0.32, bottom, 0.28, 1.65 / height))
        _draw_kind(axes, kind, edges)
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


def draw_moved(found: Optimization, numbers: Numbers) -> Figure:
    """How far optimised poses are from online ones, over time; ticks below where used loop closures end."""
    factor, unit = _unit(max(float(told.moved_m.max()) for told in numbers.sessions))
    figure, panels = _stacked(f"position moved, {unit}", "rotation moved, degrees", with_legend=len(found.sessions) > 1)
    for number, (session, told) in enumerate(zip(found.sessions, numbers.sessions, strict=True)):
        for panel, values in zip(panels, (factor * told.moved_m, told.moved_deg), strict=True):
            _plot(panel, seconds(session), values, session.record.epoch, session_colour(number), told.name)
    for panel in panels:
        panel.set_ylim(0.0, None)
    for number, session in enumerate(found.sessions):
        places = [place for loop in found.loops if not loop.refusal
                  for place in (loop.closure.reference, loop.closure.current) if place.session == number]  # fmt: skip
        if places:
            at = seconds(session)[[place.row for place in places]]
            for panel in panels:
                options = {"transform": panel.get_xaxis_transform(), "clip_on": False, "zorder": 4}
                colour = GREEN if len(found.sessions) == 1 else session_colour(number)
                panel.plot(at, np.full(len(at), 0.02), "|", color=colour, markersize=5, alpha=0.7, **options)
    _finish(panels, len(found.sessions) > 1)
    return figure


def draw_sigmas(found: Optimization, numbers: Numbers) -> Figure:
    """Standard deviations of positions and rotations over time, as they are now and as the odometry told them."""
    factor, unit = _unit(max(float(told.sigma_m.max()) for told in numbers.sessions))
    figure, panels = _stacked(f"sigma of position, {unit}", "sigma of rotation, degrees", with_legend=True)
    for number, (session, told) in enumerate(zip(found.sessions, numbers.sessions, strict=True)):
        colour, rows, since_s = session_colour(number), session.nodes.rows, seconds(session)
        name = "optimised" if len(found.sessions) == 1 else told.name
        for panel, online, now in (
            (panels[0], factor * told.online_sigma_m, factor * told.sigma_m),
            (panels[1], told.online_sigma_deg, told.sigma_deg),
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


def _edges(kinds: Sequence[Kind]) -> Float:
    """Of bins, for all kinds; what lies outside is counted in the outermost."""
    shown = [per_dimension(each) for kind in kinds for each in (kind.before, kind.after)]
    values = np.concatenate([np.ones(1), *shown])
    lowest, highest = np.log10(np.clip(np.quantile(values[values > 0.0], [0.005, 0.995]), _LEAST, _MOST))
    low, high = min(int(np.floor(lowest)), -2), max(int(np.ceil(highest)), 2)
    return np.asarray(np.logspace(low, high, (high - low) * _BINS_PER_DECADE + 1))


def _draw_kind(axes: Any, kind: Kind, edges: Float) -> None:
    inside = (edges[0] * 1.0001, edges[-1] * 0.9999)
    before, after = (np.clip(per_dimension(each), *inside) for each in (kind.before, kind.after))
    axes.hist(after, bins=edges, color=BLUE, alpha=0.75, label="after")
    axes.hist(before, bins=edges, histtype="step", color="#f28e1c", linewidth=1.3, label="before")
    some = kind.after if len(kind.after.distances) else kind.before
    dimension = some.dimensions / len(some.distances)
    share = np.diff(chi2.cdf(edges * dimension, dimension))
    middle = np.sqrt(edges[:-1] * edges[1:])
    axes.plot(middle, len(some.distances) * share, color="#111111", linewidth=1.1, linestyle=(0, (4, 2)),
              label="noise as assumed (chi-square)")  # fmt: skip
    axes.set_xscale("log")
    axes.set_xlim(edges[0], edges[-1])
    count = len(some.distances)
    axes.set_title(f"{kind.name}: {count} {'factor' if count == 1 else 'factors'}", fontsize=9.5, loc="left")
    axes.tick_params(labelsize=8)
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))


def _unit(most_m: float) -> tuple[float, str]:
    """What metres are multiplied by, and the unit then."""
    return (1e3, "mm") if most_m < 0.1 else (1.0, "m")


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
    drawn_s, drawn = (np.insert(each, breaks, np.nan) for each in (since_s, values))
    style: dict[str, Any] = {"linewidth": 0.9, "linestyle": (0, (2, 1.5))} if thin else {"linewidth": 1.4}
    axes.plot(drawn_s, drawn, color=colour, label=label, **style)


def _finish(panels: Sequence[Any], with_legend: bool) -> None:
    for panel in panels:
        panel.margins(x=0.01)
    if with_legend:
        panels[0].legend(frameon=False, fontsize=8.5, ncol=4, loc="lower left", bbox_to_anchor=(0.0, 1.0),
                         borderaxespad=0.1)  # fmt: skip
