"""Plots of a run: plan and side view of the trajectory, and its errors over time where the truth is available.

matplotlib is used without pyplot, so that a program that plots with pyplot is not affected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.errors import GraphvioError
from graphvio.evaluation import Evaluation
from graphvio.geometry import se3_inverse
from graphvio.measurements.estimate import Status
from graphvio.trajectory import Trajectory, travelled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DPI = 130
_ESTIMATE = "#1f5fbf"
_TRUTH: dict[str, Any] = {"color": "#555555", "linewidth": 1.2, "linestyle": (0, (4, 2)), "label": "truth"}
_GRID: dict[str, Any] = {"color": "#dddddd", "linewidth": 0.6}
_STATUS_COLOURS = {
    Status.INITIALISING: "#17a398",
    Status.COASTING: "#f28e1c",
    Status.LOST: "#d62728",
}
_MAP_WIDTH_IN, _MAP_HEIGHT_IN = 8.2, 8.2
_MARGIN_LEFT_IN, _MARGIN_RIGHT_IN, _MARGIN_BOTTOM_IN, _MARGIN_TOP_IN, _GAP_IN = 0.85, 0.3, 0.6, 1.05, 0.3
_LEGEND_COLUMN_IN = 1.2
_SERIES_WIDTH_IN, _SERIES_GAP_IN, _MIN_SERIES_HEIGHT_IN = 5.2, 1.0, 3.6


def plot_run(
    path: Path,
    trajectory: Trajectory,
    *,
    status: Sequence[str] = (),
    epochs: Sequence[int] = (),
    lost_ns: Sequence[int] = (),
    truth: Trajectory | None = None,
    evaluation: Evaluation | None = None,
    name: str = "",
) -> None:
    """Plot plan (x-y) and side view (x-z) of a run in nav; initialisation, coasting, losses and new epochs are marked.

    Args:
        path: image file; its suffix chooses the format.
        trajectory: N poses of body in nav.
        status: N values of `graphvio.measurements.estimate.Status`, or empty.
        epochs: N epoch numbers, or empty; a new epoch is marked and interrupts the line.
        lost_ns: stamps of framesets without a pose.
        truth: true poses of body in any frame; plotted only together with ``evaluation``, which has their alignment.
        evaluation: evaluation of this trajectory against that truth.
        name: start of the title.

    Raises:
        GraphvioError: if the file cannot be written.
    """
    positions = trajectory.positions
    true_positions = _truth_in_nav(truth, evaluation) if truth is not None and evaluation is not None else None
    breaks = np.flatnonzero(np.diff(np.asarray(epochs, dtype=np.int64))) + 1 if len(epochs) else np.empty(0, int)
    figure, plan, side = _maps(positions, true_positions, series=False)
    for axes, z in ((plan, 1), (side, 2)):
        if true_positions is not None:
            axes.plot(*true_positions[:, [0, z]].T, **_TRUTH)
        line = np.insert(positions, breaks, np.nan, axis=0)
        axes.plot(*line[:, [0, z]].T, color=_ESTIMATE, linewidth=1.6, label="estimate")
        for which, mask in _status_masks(status, breaks).items():
            marked = np.insert(np.where(mask[:, None], positions, np.nan), breaks, np.nan, axis=0)
            axes.plot(*marked[:, [0, z]].T, color=_STATUS_COLOURS[which], linewidth=3.2, label=which.value)
        _mark_lost(axes, trajectory, lost_ns, z)
        _mark_ends(axes, positions, breaks, z)
    _title(figure, plan, _run_title(name, trajectory, breaks, evaluation))
    save_figure(figure, path)


def plot_evaluation(path: Path, evaluation: Evaluation, name: str = "") -> None:
    """Plot the aligned estimate over the truth in plan and side view, and both errors over time.

    Raises:
        GraphvioError: if the file cannot be written.
    """
    estimate, truth = evaluation.aligned.positions, evaluation.truth.positions
    figure, plan, side = _maps(estimate, truth, series=True)
    for axes, z in ((plan, 1), (side, 2)):
        axes.plot(*truth[:, [0, z]].T, **_TRUTH)
        axes.plot(*estimate[:, [0, z]].T, color=_ESTIMATE, linewidth=1.6, label="estimate, aligned")
        _mark_ends(axes, estimate, np.empty(0, int), z)
    seconds = 1e-9 * (evaluation.stamps_ns - evaluation.stamps_ns[0])
    rmse_m, rmse_deg = evaluation.ate_position_m.rmse, evaluation.ate_rotation_deg.rmse
    panels = (
        (evaluation.position_error_m, rmse_m, _length(rmse_m), "position error, m", 1),
        (evaluation.rotation_error_deg, rmse_deg, f"{rmse_deg:.3g}°", "rotation error, degrees", 0),
    )
    for errors, rmse, text, label, row in panels:
        axes = _series_axes(figure, row)
        axes.plot(seconds, errors, color=_ESTIMATE, linewidth=1.2)
        axes.axhline(rmse, color=_STATUS_COLOURS[Status.COASTING], linewidth=1.2, label=f"rmse {text}")
        axes.set(ylabel=label, xlim=(0.0, max(float(seconds[-1]), 1e-3)), ylim=(0.0, None))
        axes.legend(loc="upper right", fontsize=9, framealpha=0.9)
        axes.grid(**_GRID)
        if row == 0:
            axes.set_xlabel("time, s")
    _title(figure, plan, f"{name}{': ' if name else ''}{_figures(evaluation)}")
    save_figure(figure, path)


def plot_comparison(path: Path, evaluations: Mapping[str, Evaluation]) -> None:
    """Plot over time the errors of several results against the same truth.

    Args:
        path: image file; its suffix chooses the format.
        evaluations: name of the result -> its evaluation.

    Raises:
        GraphvioError: if the file cannot be written.
    """
    head_in = 0.5 + 0.22 * len(evaluations)
    figure = new_figure(9.0, 5.6 + head_in)
    share = 5.6 / (5.6 + head_in)
    panels = [figure.add_axes((0.1, share * bottom, 0.87, share * 0.42)) for bottom in (0.56, 0.09)]
    begin = min((int(each.stamps_ns[0]) for each in evaluations.values()), default=0)
    for name, each in evaluations.items():
        seconds = 1e-9 * (each.stamps_ns - begin)
        label = f"{name}: {_length(each.ate_position_m.rmse)}, {each.ate_rotation_deg.rmse:.3g}°"
        panels[0].plot(seconds, each.position_error_m, linewidth=1.2, label=label)
        panels[1].plot(seconds, each.rotation_error_deg, linewidth=1.2)
    for panel, label in zip(panels, ("position error, m", "rotation error, degrees"), strict=True):
        panel.set(ylabel=label, ylim=(0.0, None))
        panel.grid(**_GRID)
    panels[1].set_xlabel("time, s")
    if evaluations:
        options = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.02), "borderaxespad": 0.0, "frameon": False}
        panels[0].legend(fontsize=9, title="rmse after alignment", title_fontsize=9, alignment="left", **options)
    save_figure(figure, path)


def new_figure(width_in: float, height_in: float) -> Figure:
    """Create a white figure without axes."""
    from graphvio.reporting.figures import empty_figure

    return empty_figure(width_in, height_in, _DPI)


def _truth_in_nav(truth: Trajectory, evaluation: Evaluation) -> Float:
    first, last = evaluation.stamps_ns[0], evaluation.stamps_ns[-1]
    during = (truth.stamps_ns >= first) & (truth.stamps_ns <= last)
    return truth.select(during).transformed(se3_inverse(evaluation.truth_T_nav)).positions


def _status_masks(status: Sequence[str], breaks: Any) -> dict[Status, Bool]:
    """Return a mask (N,) of the poses of each status that is marked.

    It includes the pose before the status begins, so that the step to the first pose of the status is marked, too.
    """
    masks: dict[Status, Bool] = {}
    for which in (Status.INITIALISING, Status.COASTING):
        mask = np.array([value == which for value in status], dtype=np.bool_)
        if not mask.any():
            continue
        into = mask.copy()
        into[breaks] = False
        mask[:-1] |= into[1:]
        masks[which] = mask
    return masks


def _mark_lost(axes: Any, trajectory: Trajectory, lost_ns: Sequence[int], z: int) -> None:
    """Mark the last pose before each segment without poses."""
    if not len(lost_ns) or not len(trajectory):
        return
    before = np.unique(np.searchsorted(trajectory.stamps_ns, np.asarray(lost_ns)) - 1)
    at = trajectory.positions[before[before >= 0]]
    colour = _STATUS_COLOURS[Status.LOST]
    axes.plot(*at[:, [0, z]].T, "x", color=colour, markersize=10, markeredgewidth=2.6, label="lost", zorder=6)


def _mark_ends(axes: Any, positions: Float, breaks: Any, z: int) -> None:
    if not len(positions):
        return
    edge = {"markeredgecolor": "white", "linestyle": "none", "zorder": 5}
    if len(breaks):
        at = positions[breaks]
        axes.plot(at[:, 0], at[:, z], "D", color="#8e44ad", markersize=8, label="new epoch", **edge)
    axes.plot(positions[0, 0], positions[0, z], "o", color="#2ca02c", markersize=10, label="start", **edge)
    axes.plot(positions[-1, 0], positions[-1, z], "s", color="#111111", markersize=8, label="end", **edge)


def _run_title(name: str, trajectory: Trajectory, breaks: Any, evaluation: Evaluation | None) -> str:
    begin = f"{name}: " if name else ""
    if not len(trajectory):
        return f"{begin}no pose was estimated"
    if evaluation is not None:
        return f"{begin}{_figures(evaluation)}"
    length = sum(float(travelled(part)[-1]) for part in np.split(trajectory.positions, breaks) if len(part))
    return f"{begin}path {length:.1f} m, {trajectory.duration_s:.1f} s"


def _figures(evaluation: Evaluation) -> str:
    ate = f"ATE {_length(evaluation.ate_position_m.rmse)}, {evaluation.ate_rotation_deg.rmse:.3g}°"
    return f"path {evaluation.path_length_m:.1f} m, {evaluation.duration_s:.1f} s, {ate}"


def _length(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm" if metres < 0.1 else f"{metres:.3g} m"


def _maps(first: Float, second: Float | None, series: bool) -> tuple[Figure, Axes, Axes]:
    """Create a figure with the plan above the side view, of equal x axis and scale.

    With ``series`` there is room for `_series_axes` to the right.
    """
    points = first if second is None else np.concatenate([first, second])
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (-np.ones(3), np.ones(3))
    centre, interval = 0.5 * (low + high), 1.12 * (high - low)
    interval[0] = max(interval[0], 0.6 * interval[1], 0.5)
    interval[1] = max(interval[1], 0.35 * interval[0])
    interval[2] = max(1.3 * interval[2], 0.16 * interval[0])
    inch_per_m = min(_MAP_WIDTH_IN / interval[0], _MAP_HEIGHT_IN / (interval[1] + interval[2]))
    width, plan_height, side_height = inch_per_m * interval
    right = _SERIES_GAP_IN + _SERIES_WIDTH_IN if series else 0.0
    side_room = max(side_height, _MIN_SERIES_HEIGHT_IN - plan_height - _GAP_IN) if series else side_height
    total_width = max(_MARGIN_LEFT_IN + width + right + _MARGIN_RIGHT_IN, 6.5)
    total_height = _MARGIN_BOTTOM_IN + side_room + _GAP_IN + plan_height + _MARGIN_TOP_IN
    figure = new_figure(total_width, total_height)

    def place(bottom_in: float, height_in: float) -> Any:
        left, bottom = _MARGIN_LEFT_IN / total_width, bottom_in / total_height
        return figure.add_axes((left, bottom, width / total_width, height_in / total_height))

    side = place(_MARGIN_BOTTOM_IN, side_height)
    plan = place(_MARGIN_BOTTOM_IN + side_room + _GAP_IN, plan_height)
    for axes, z, label in ((plan, 1, "y, m"), (side, 2, "z, m")):
        axes.set_aspect("equal", adjustable="box")
        axes.set_xlim(centre[0] - interval[0] / 2, centre[0] + interval[0] / 2)
        axes.set_ylim(centre[z] - interval[z] / 2, centre[z] + interval[z] / 2)
        axes.set_ylabel(label)
        axes.grid(**_GRID)
        axes.set_axisbelow(True)
    plan.tick_params(labelbottom=False)
    side.locator_params(axis="y", nbins=4)
    side.set_xlabel("x, m")
    return figure, plan, side


def _series_axes(figure: Figure, row: int) -> Any:
    """Add axes for a series over time to the right of the maps; row 0 is the lower one."""
    width, height = figure.get_size_inches()
    each = (height - _MARGIN_BOTTOM_IN - _MARGIN_TOP_IN - _GAP_IN) / 2
    left = width - _MARGIN_RIGHT_IN - _SERIES_WIDTH_IN
    bottom = _MARGIN_BOTTOM_IN + row * (each + _GAP_IN)
    axes = figure.add_axes((left / width, bottom / height, _SERIES_WIDTH_IN / width, each / height))
    if row:
        axes.tick_params(labelbottom=False)
    return axes


def _title(figure: Figure, plan: Any, text: str) -> None:
    width, height = figure.get_size_inches()
    left = _MARGIN_LEFT_IN / width
    figure.text(left, 1.0 - 0.38 / height, text, fontsize=13, fontweight="bold")
    handles, labels = plan.get_legend_handles_labels()
    if handles:
        figure.legend(
            handles,
            labels,
            loc="upper left",
            bbox_to_anchor=(left, 1.0 - 0.5 / height),
            ncol=min(len(labels), int((width - _MARGIN_LEFT_IN) / _LEGEND_COLUMN_IN)),
            frameon=False,
            fontsize=9.5,
            borderaxespad=0.0,
            handlelength=1.6,
            columnspacing=1.4,
        )


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure; the suffix chooses the format.

    Raises:
        GraphvioError: if the file cannot be written.
    """
    try:
        figure.savefig(path, metadata={"Software": None} if path.suffix.lower() == ".png" else None)
    except OSError as error:
        raise GraphvioError(f"{path}: cannot be written ({error.strerror}); choose another place") from None
    except ValueError as error:
        raise GraphvioError(f"{path}: cannot be plotted ({error}); end its name in .png, .pdf or .svg") from None
