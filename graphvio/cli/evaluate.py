"""``graphvio evaluate``: compares one trajectory with the true one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graphvio.cli import options
from graphvio.cli.json_output import publish
from graphvio.cli.shared import result_trajectory, true_trajectory

if TYPE_CHECKING:
    from rich.table import Table

    from graphvio.evaluation import Evaluation, Stats


def evaluate(
    trajectory: Annotated[
        Path, typer.Argument(help="Estimated trajectory: result folder, TUM, EuRoC, KITTI, or BAG:TOPIC.")
    ],
    truth: Annotated[
        Path, typer.Argument(help="True trajectory: a file in one of these formats, or a recording that has one.")
    ],
    plot: Annotated[
        Path | None, typer.Option(help="Plot both, and the error over time: .png, .pdf or .svg.", metavar="FILE")
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--save-json", help="Write all figures here.", metavar="FILE")
    ] = None,
    max_gap: Annotated[
        float,
        typer.Option(help="Longest gap of the truth that is interpolated, seconds.", callback=options.not_negative),
    ] = 0.25,
    times: options.Times = None,
) -> None:
    """Compare a trajectory with the truth: ATE, RPE, drift and loop-closure error.

    The truth is interpolated to the estimate's stamps, and the estimate is aligned with it by a rotation and a
    translation.

    Examples:

        graphvio evaluate results/corridor-1/trajectory.txt data/corridor

        graphvio evaluate walk.bag:/odometry truth.bag:/vicon

        graphvio evaluate results/mh01-1/trajectory.txt mav0/state_groundtruth_estimate0/data.csv --plot mh01.png
    """
    import json

    from rich.console import Console

    from graphvio.errors import GraphvioError, writing
    from graphvio.evaluation import evaluate as measure
    from graphvio.trajectory_files import load_trajectory

    figures = measure(
        load_trajectory(result_trajectory(trajectory), times), true_trajectory(truth, times), max_gap_s=max_gap
    )
    publish(figures.as_dict())
    Console().print(_table(figures))
    if json_file is not None:
        with writing(json_file, GraphvioError, "choose another place"):
            json_file.write_text(json.dumps(figures.as_dict(), indent=2) + "\n", encoding="utf-8")
    if plot is not None:
        from graphvio.results.plotting import plot_evaluation

        plot_evaluation(plot, figures, trajectory.stem)


def _table(figures: Evaluation) -> Table:
    from rich.table import Table

    table = Table(
        title=f"{figures.associated} of {figures.estimates} poses have a true one: "
        f"{figures.path_length_m:.2f} m in {figures.duration_s:.1f} s",
        title_justify="left",
    )
    table.add_column("figure")
    for column in ("rmse", "median", "max", "of path"):
        table.add_column(column, justify="right")
    table.add_row("ATE, position", *_stats(figures.ate_position_m, " m"), _percent(figures.ate_percent))
    if figures.ate_scaled_m is not None and figures.scale_error_percent is not None:
        table.add_row("ATE, position, scale aligned", f"{figures.ate_scaled_m:.4f} m", "", "", "")
        table.add_row("scale error", f"{figures.scale_error_percent:+.3f} %", "", "", "")
    table.add_row("ATE, rotation", *_stats(figures.ate_rotation_deg, "°"), "", end_section=True)
    for over, error in figures.rpe.items():
        table.add_row(f"RPE over {over}, position", *_stats(error.position_m, " m"), _percent(error.percent))
        table.add_row(f"RPE over {over}, rotation", *_stats(error.rotation_deg, "°"), "")
    table.add_section()
    if figures.kitti_percent is not None:
        table.add_row("segments of 100 to 800 m", "", "", "", _percent(figures.kitti_percent))
    drift = f"{figures.drift_m:.3f} m"
    table.add_row("drift: end, aligned at the start", drift, "", "", _percent(figures.drift_percent))
    if figures.loop_closure is not None:
        loop = figures.loop_closure
        table.add_row("loop closure", f"{loop.error_m:.3f} m", "", "", _percent(loop.error_percent))
    return table


def _stats(stats: Stats, unit: str) -> tuple[str, str, str]:
    return f"{stats.rmse:.4f}{unit}", f"{stats.median:.4f}{unit}", f"{stats.max:.4f}{unit}"


def _percent(value: float | None) -> str:
    return "" if value is None else f"{value:.3f} %"
