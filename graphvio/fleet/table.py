"""The table of all sessions of a fleet run: status, key figures and errors, as CSV and as an HTML page."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from graphvio.fleet.storage import Storage
from graphvio.reporting.html import render

STAGES = ("odometry", "features", "loops", "graph")
FIGURES = (
    "duration_s", "path_length_m", "framesets", "completion", "epochs", "resets", "loops_found", "loops_used",
    "cost_before", "cost_after", "frames", "ate_odometry_m", "ate_m",
)  # fmt: skip
COLUMNS = ("name", "status", *FIGURES, *(f"{stage}_wall_s" for stage in STAGES), "failed_in", "error", "recording")


@dataclass(frozen=True)
class Outcome:
    """The result of one session: its figures, or the stage and error that it failed with."""

    name: str  # session name
    recording: str  # path or URL
    figures: Mapping[str, Any]  # name -> value or None, from the finished stages
    wall_s: Mapping[str, float]  # stage -> wall time of its tasks, in the run that executed them
    failed_in: str  # stage that failed, or empty
    error: str  # error of that stage in one line, or empty

    @property
    def status(self) -> str:
        """``optimized`` or ``failed``."""
        return "failed" if self.error else "optimized"


def write_tables(outcomes: Sequence[Outcome], storage: Storage) -> None:
    """Write ``summary.csv`` and ``summary.html``, each whole or not at all."""
    rows = [_row(outcome) for outcome in outcomes]
    storage.write("summary.csv", _csv(rows).encode())
    storage.write("summary.html", render("fleet/summary.html", rows=rows, columns=COLUMNS).encode())


def _row(outcome: Outcome) -> dict[str, str]:
    values: dict[str, Any] = {name: outcome.figures.get(name) for name in FIGURES}
    values |= {f"{stage}_wall_s": outcome.wall_s.get(stage) or None for stage in STAGES}
    row = {name: _text(value) for name, value in values.items()}
    row |= {"name": outcome.name, "status": outcome.status, "recording": outcome.recording}
    return row | {"failed_in": outcome.failed_in, "error": outcome.error}


def _text(value: float | int | None) -> str:
    if value is None:
        return ""
    return str(value) if isinstance(value, int) else f"{value:.6g}"


def _csv(rows: Sequence[Mapping[str, str]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
