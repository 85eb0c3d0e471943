"""``graphvio compare``: compares several results with a true trajectory, or with each other."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graphvio.cli import options
from graphvio.cli.json_output import publish
from graphvio.cli.shared import EXIT_ABOVE_LIMIT, names_of, result_trajectory, true_trajectory, warn

if TYPE_CHECKING:
    from graphvio.evaluation import Compared


def compare(
    results: Annotated[
        list[Path],
        typer.Argument(
            help="Result folders of `graphvio run` and `graphvio optimize`, or trajectory files, or BAG:TOPIC."
        ),
    ],
    truth: Annotated[
        Path | None,
        typer.Option(
            "--truth",
            help="True trajectory, or a recording that has one.  [default: the first result is the reference]",
        ),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option("--plot", help="Plot all errors over time: .png, .pdf or .svg.", metavar="FILE")
    ] = None,
    smoothed: Annotated[
        bool, typer.Option("--smoothed", help="For result folders, use the smoothed poses instead of the causal ones.")
    ] = False,
    max_ate: Annotated[
        float | None,
        typer.Option(
            "--max-ate", help="Exit with code 4 if an ATE exceeds these metres.", callback=options.not_negative
        ),
    ] = None,
    times: options.Times = None,
) -> None:
    """Compare several results: ATE, RPE, drift and completion, and the ratio of each ATE to the first one.

    The exit code is 4 if --max-ate is exceeded, or a result cannot be compared.

    Examples:

        graphvio compare results/walk-1 results/walk-2 --truth truth.txt --plot compared.png

        graphvio compare results/nightly --truth truth.txt --max-ate 0.05
    """
    from rich.console import Console

    from graphvio.errors import GraphvioError
    from graphvio.evaluation import compare as compare_all
    from graphvio.trajectory_files import load_trajectory

    names, trajectories = (
        names_of(results),
        [load_trajectory(result_trajectory(path, smoothed), times) for path in results],
    )
    if truth is None and len(results) < 2:
        raise GraphvioError("one result and no truth: there is nothing to compare; give --truth FILE or more results")
    reference = true_trajectory(truth, times) if truth is not None else trajectories[0]
    first = 0 if truth is not None else 1
    compared = compare_all(names[first:], trajectories[first:], reference)
    publish(
        {
            "reference": str(truth) if truth is not None else names[0],
            "results": [
                {
                    "name": each.name,
                    "ate_ratio": each.ate_ratio,
                    "why_not": each.why_not,
                    "evaluation": None if each.evaluation is None else each.evaluation.as_dict(),
                }
                for each in compared
            ],
        }
    )
    Console(soft_wrap=True).print(_table(compared))
    for each in compared:
        if each.evaluation is None:
            warn(f"{each.name}: {each.why_not}")
    if plot is not None:
        from graphvio.results.plotting import plot_comparison

        plot_comparison(plot, {each.name: each.evaluation for each in compared if each.evaluation is not None})
    above = [each.name for each in compared if max_ate is not None and each.ate_m > max_ate]
    if above:
        warn(f"ATE above {max_ate:g} m: {', '.join(above)}")
    if above or any(each.evaluation is None for each in compared):
        raise typer.Exit(EXIT_ABOVE_LIMIT)


def _table(compared: list[Compared]) -> object:
    from rich.table import Table

    table = Table()
    table.add_column("result", overflow="fold")
    for column in ("ATE, m", "over first", "deg", "RPE 1 s, m", "drift, %", "poses"):
        table.add_column(column, justify="right", no_wrap=True)
    for each in compared:
        found = each.evaluation
        if found is None:
            table.add_row(each.name, *["-"] * 6)
            continue
        rpe = found.rpe.get("1 s")
        table.add_row(
            each.name,
            f"{found.ate_position_m.rmse:.4f}",
            "" if each.ate_ratio is None else f"{each.ate_ratio:.2f}",
            f"{found.ate_rotation_deg.rmse:.3f}",
            "" if rpe is None else f"{rpe.position_m.rmse:.4f}",
            "" if found.drift_percent is None else f"{found.drift_percent:.2f}",
            f"{found.associated}/{found.estimates}",
        )
    return table
