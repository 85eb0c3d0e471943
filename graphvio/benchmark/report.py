"""Writer of a benchmark's report: a page with the table, and a page for each sequence."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from graphvio.benchmark.run import Outcome
from graphvio.benchmark.table import Benchmark
from graphvio.errors import BenchmarkError, writing
from graphvio.reporting.figures import BLUE, add_axes, empty_figure, png
from graphvio.reporting.files import replace_file
from graphvio.reporting.html import render
from graphvio.results.plotting import plot_evaluation

_MAX_EVENTS = 200


def write_report(benchmark: Benchmark, folder: Path) -> Path:
    """Write ``report.html``, and ``SEQUENCE.html`` for each sequence with a result.

    Returns:
        The path of the first page.

    Raises:
        BenchmarkError: if the folder cannot be written.
    """
    pages = {outcome.sequence: f"{outcome.sequence}.html" for outcome in benchmark.outcomes if not outcome.has_failed}
    with writing(folder, BenchmarkError, "choose another place"):
        for outcome in benchmark.outcomes:
            if not outcome.has_failed:
                replace_file(folder / pages[outcome.sequence], _sequence_page(benchmark, outcome))
        index = folder / "report.html"
        replace_file(
            index,
            render(
                "benchmark/index.html",
                title=f"graphvio on {benchmark.dataset.title}",
                head=benchmark.head(),
                rows=benchmark.rows(),
                notes=benchmark.notes(),
                pages=pages,
            ),
        )
    return index


def _sequence_page(benchmark: Benchmark, outcome: Outcome) -> str:
    lines = (outcome.results / "events.jsonl").read_text(encoding="utf-8").splitlines()
    events = [json.loads(line) for line in lines]
    begin_ns = min((event["stamp_ns"] for event in events), default=0)
    if outcome.evaluation is not None:
        begin_ns = int(outcome.evaluation.stamps_ns[0])
        picture = outcome.results / "evaluation.png"
        plot_evaluation(picture, outcome.evaluation, outcome.sequence)
    else:
        picture = outcome.results / "trajectory.png"
    rows = [(f"{1e-9 * (each['stamp_ns'] - begin_ns):.2f}", each["kind"], each["detail"]) for each in events]
    return render(
        "benchmark/sequence.html",
        title=f"{outcome.sequence}: graphvio on {benchmark.dataset.title}",
        head=benchmark.head(),
        rows=[row for row in benchmark.rows() if row[0] == outcome.sequence],
        note=benchmark.note(outcome),
        trajectory=picture.read_bytes(),
        timeline=_timeline(events, begin_ns, outcome) if events else None,
        events=rows[:_MAX_EVENTS],
        more=max(len(rows) - _MAX_EVENTS, 0),
        calibration=(outcome.summary or {}).get("calibration", []),
        results=outcome.results.name,
    )


def _timeline(events: list[dict[str, Any]], begin_ns: int, outcome: Outcome) -> bytes:
    """Plot the times of the events, one row per kind, as PNG."""
    kinds = sorted({event["kind"] for event in events})
    height_in = 0.9 + 0.28 * len(kinds)
    figure = empty_figure(8.6, height_in)
    axes = add_axes(figure, (0.24, 0.55 / height_in, 0.73, 1.0 - 0.7 / height_in))
    seconds = [1e-9 * (event["stamp_ns"] - begin_ns) for event in events]
    axes.plot(seconds, [kinds.index(event["kind"]) for event in events], "|", color=BLUE, markersize=11, mew=1.4)
    axes.set_yticks(range(len(kinds)), kinds)
    axes.set_ylim(len(kinds) - 0.5, -0.5)
    if outcome.evaluation is not None:
        last_s = 1e-9 * float(outcome.evaluation.stamps_ns[-1] - begin_ns)
        axes.set_xlim(min(0.0, *np.clip(seconds, -5.0, None)), max(last_s, *np.clip(seconds, None, last_s + 5.0)))
    axes.set_xlabel("time since the first pose, s")
    return png(figure)
