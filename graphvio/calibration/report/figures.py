"""Figures of the calibration of two cameras."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from graphvio.calibration.consistency import LIMIT
from graphvio.calibration.pair_calibration import PairCalibration
from graphvio.reporting.figures import BLUE, GREY, GRID, RED, empty_figure, single

_AXES = ("#d62728", "#2ca02c", "#1f5fbf")
_NS_PER_S = 1e9


def alignment_errors(each: PairCalibration) -> Figure:
    """Plot a histogram of alignment errors, as in the paper's figure 4."""
    by_frame = len(each.frames) > 0
    errors = 1e3 * (each.frame_errors_m if by_frame else each.alignment_errors_m)
    inlier = each.frame_inlier if by_frame else each.inlier
    figure, axes = single(6.4, 3.6)
    highest = max(float(np.quantile(errors, 0.995)), 1e-6) * 1.05
    bins = np.linspace(0.0, highest, 60)
    shown = [np.minimum(errors[which], highest) for which in (inlier, ~inlier)]
    axes.hist(shown, bins=bins, stacked=True, color=[BLUE, RED], label=["fits", "outlier"])
    mean = float(errors[inlier].mean())
    axes.axvline(mean, color="black", linewidth=1.2, linestyle=(0, (4, 2)), label=f"mean {mean:.2f} mm")
    over = "from frame to frame" if by_frame else "of all segments of time used"
    axes.set(xlabel="alignment error, mm", ylabel="motions", xlim=(0.0, highest))
    axes.set_title(f"{inlier.sum()} of {len(inlier)} motions {over} fit", fontsize=10, loc="left")
    axes.legend(frameon=False, fontsize=9)
    return figure


def residuals(each: PairCalibration) -> Figure:
    """Plot errors over time, in standard deviations, with outliers marked."""
    figure, axes = single(6.4, 3.2)
    since_s = (0.5 * (each.pairs.start_ns + each.pairs.end_ns) - each.pairs.start_ns[0]) / _NS_PER_S
    size = np.sqrt(each.solution.squares / 6.0)
    limit = float(np.sqrt(LIMIT / 6.0))
    top = max(1.15 * limit, min(float(size.max()), 3.0 * limit))
    axes.plot(since_s[each.inlier], size[each.inlier], ".", color=BLUE, markersize=4, label="fits")
    outside = ~each.inlier
    if outside.any():
        axes.plot(since_s[outside], np.minimum(size[outside], top), "x", color=RED, markersize=6, label="outlier")
    axes.axhline(limit, color=GREY, linewidth=1.0, linestyle=(0, (4, 2)), label="limit")
    axes.set(xlabel="time, s", ylabel="error, sigma (rms of 6)", ylim=(0.0, 1.05 * top))
    axes.legend(frameon=False, fontsize=9, loc="upper right", ncol=3)
    return figure


def turning(each: PairCalibration) -> Figure:
    """Plot the axes about which the rig turned, in the first left camera, on the sphere of directions."""
    figure = empty_figure(6.4, 3.6)
    axes: Any = figure.add_axes((0.04, 0.05, 0.78, 0.85), projection="mollweide")
    turns = each.pairs.rotations_rad / ((each.pairs.end_ns - each.pairs.start_ns) / _NS_PER_S)[:, None]
    speed = np.linalg.norm(turns, axis=1)
    moving = speed > 1e-6
    x, y, z = (turns[moving] / speed[moving, None]).T
    deg_s = np.rad2deg(speed[moving])
    longitude, latitude = np.arctan2(x, z), np.arcsin(np.clip(-y, -1.0, 1.0))
    points = axes.scatter(
        longitude, latitude, c=deg_s, s=10 + 40 * deg_s / max(deg_s.max(), 1e-9), cmap="viridis", alpha=0.8
    )
    for name, at in {"forward": (0, 0), "right": (np.pi / 2, 0), "left": (-np.pi / 2, 0)}.items():
        axes.annotate(name, at, color=RED, fontsize=8, ha="center", va="bottom")
        axes.plot(*at, "+", color=RED, markersize=6)
    for name, pole in {"up": np.pi / 2, "down": -np.pi / 2}.items():
        axes.annotate(name, (0, pole), color=RED, fontsize=8, ha="center", va="top" if pole > 0 else "bottom")
    axes.set_xticklabels([])
    axes.set_yticklabels([])
    axes.grid(**GRID)
    bar = figure.colorbar(points, cax=figure.add_axes((0.86, 0.15, 0.025, 0.65)))
    bar.set_label("turning, degrees/s", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    return figure


def growth(each: PairCalibration, count: int, unit: str) -> Figure:
    """Plot the results from increasing parts of the recording, with sigmas, over the count of framesets or poses."""
    figure = empty_figure(6.4, 5.0)
    panels = [figure.add_axes((0.13, bottom, 0.83, 0.38)) for bottom in (0.57, 0.1)]
    begin, end = int(each.pairs.start_ns[0]), int(each.pairs.end_ns[-1])
    counts = np.array([count * (grown.end_ns - begin) / max(end - begin, 1) for grown in each.growth])
    apart = np.array([-each.apart(grown.left2_T_left1) for grown in each.growth]).reshape(-1, 6)
    sigmas = np.array([np.sqrt(np.diag(grown.covariance)) for grown in each.growth]).reshape(-1, 6)
    units = np.repeat([np.rad2deg(1.0), 1e3], 3)
    for panel, columns, label in (
        (panels[0], (0, 1, 2), "angle about, degrees"),
        (panels[1], (3, 4, 5), "offset along, mm"),
    ):
        for colour, column, name in zip(_AXES, columns, "xyz", strict=True):
            middle, spread = units[column] * apart[:, column], units[column] * sigmas[:, column]
            panel.plot(counts, middle, "o-", color=colour, markersize=3.5, linewidth=1.2, label=name)
            panel.fill_between(counts, middle - spread, middle + spread, color=colour, alpha=0.13, linewidth=0)
        panel.axhline(0.0, color=GREY, linewidth=0.8)
        panel.set_xscale("log")
        panel.set_xticks(counts, [f"{count:.0f}" for count in counts])
        panel.xaxis.set_minor_locator(NullLocator())
        panel.set_ylabel(label)
        if len(counts) > 1:
            scaled, bands = (np.abs(units * each)[:, list(columns)] for each in (apart, sigmas))
            bound = 1.1 * max(scaled.max(), (scaled + bands)[1:].max())
            panel.set_ylim(-bound, bound)
        panel.grid(**GRID)
        panel.legend(frameon=False, fontsize=8, ncol=3, loc="upper right")
    panels[1].set_xlabel(f"{unit} used; difference from the result of all, with one sigma")
    return figure
