"""``graphvio benchmark``: runs the sequences of a public data set and compares with published figures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graphvio.cli import completion, options
from graphvio.cli.json_output import publish
from graphvio.cli.shared import EXIT_INCOMPLETE, ends_at_interrupt, warn

if TYPE_CHECKING:
    from graphvio.benchmark.table import Benchmark

_PLAIN_WIDTH = 160  # characters; width of a table outside a terminal, where no column has to be cut


def benchmark(
    dataset: Annotated[
        str,
        typer.Argument(
            help="Data set: euroc, tum-vi, uzh-fpv, kitti, hilti-2022 or monado.",
            metavar="DATASET",
            autocompletion=completion.dataset,
        ),
    ],
    folder: Annotated[Path, typer.Argument(help="Folder that contains the sequences, in any subfolder.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for the results, new or empty.  [default: results/benchmark-DATASET-N]"),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs", help="Number of sequences that run at the same time.  [default: half of the cores]", min=1
        ),
    ] = None,
    sequences: Annotated[
        str | None, typer.Option("--sequences", help="Run only these sequences, such as MH_01,V1_01.  [default: all]")
    ] = None,
    rig: options.RigFile = None,
    config: options.ConfigName = "default",
    no_imu: options.NoImu = False,
    to_s: options.ToS = None,
) -> None:
    """Run the sequences of a public data set in a folder, and compare the results with published figures.

    Prints a table as papers have it: ATE of each sequence, completion and time, next to published figures of other
    systems and their sources. If a sequence fails, its row says why. The results include a report, report.html, with a
    page for each sequence.

    The exit code is 0; 2 if no sequence is found; 3 if a sequence failed.

    Examples:

        graphvio benchmark euroc EuRoC --jobs 2

        graphvio benchmark kitti dataset --sequences 00,05 --json
    """
    import os

    from rich.console import Console

    from graphvio.benchmark.datasets import dataset_of, find_sequences
    from graphvio.benchmark.report import write_report
    from graphvio.benchmark.run import run_sequences
    from graphvio.benchmark.table import Benchmark
    from graphvio.cli.warming import warm_up_visibly
    from graphvio.config import Config
    from graphvio.errors import BenchmarkError
    from graphvio.results import ResultWriter
    from graphvio.simulation import default_rig
    from graphvio.wording import listed

    chosen = dataset_of(dataset)
    settings = Config.load(config)
    found = find_sequences(chosen, folder, rig)
    if sequences is not None:
        wanted = [name.strip() for name in sequences.split(",")]
        names = [each.name for each in found]
        for name in wanted:
            if name not in names:
                raise BenchmarkError(f"--sequences {name}: {folder} holds {listed(names)}")
        found = [each for each in found if each.name in wanted]
    results = out if out is not None else ResultWriter.new_folder(Path("results"), f"benchmark-{chosen.key}")
    at_once = min(jobs if jobs is not None else max(1, (os.cpu_count() or 1) // 2), len(found))
    warm_up_visibly(default_rig(), settings)  # once, so that no sequence's time includes it
    passed = ["--config", config] + (["--no-imu"] if no_imu else []) + ([] if to_s is None else ["--to", str(to_s)])
    with ends_at_interrupt(f"interrupted; what was finished is in {results}"):
        outcomes = run_sequences(
            found,
            results,
            passed,
            jobs=at_once,
            on_done=lambda each: warn(f"{each.sequence}: {each.reason or 'done'}"),
        )
    measured = Benchmark(chosen, str(folder), config, at_once, outcomes)
    page = write_report(measured, results)
    publish(measured.as_dict() | {"report": str(page)})
    console = Console(soft_wrap=True)
    if not console.is_terminal:
        console.width = _PLAIN_WIDTH
    console.print(_table(measured))
    for line in measured.notes():
        typer.echo(line)
    typer.echo(f"report: {page}")
    if any(outcome.has_failed for outcome in outcomes):
        raise typer.Exit(EXIT_INCOMPLETE)


def _table(measured: Benchmark) -> object:
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=f"{measured.dataset.title}: ATE", title_justify="left")
    for number, column in enumerate(measured.head()):
        table.add_column(column, justify="right" if number else "left", no_wrap=True)
    for row in measured.rows():
        table.add_row(*map(escape, row))
    return table
