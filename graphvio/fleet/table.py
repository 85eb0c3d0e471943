"""All sessions with the figures of their health, as a table for programs and a page for people."""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from graphvio.fleet.storage import Storage

STAGES = ("odometry", "features", "loops", "graph")
FIGURES = (
    "duration_s", "path_length_m", "framesets", "completion", "epochs", "resets", "loops_found", "loops_used",
    "cost_before", "cost_after", "frames", "ate_odometry_m", "ate_m",
)  # fmt: skip
COLUMNS = ("name", "status", *FIGURES, *(f"{stage}_wall_s" for stage in STAGES), "failed_in", "error", "recording")

_STYLE = """
body { font: 14px/1.4 sans-serif; margin: 2em; color: #222; }
table { border-collapse: collapse; }
th, td { padding: 0.25em 0.7em; border-bottom: 1px solid #ddd; text-align: right; white-space: nowrap; }
th { position: sticky; top: 0; background: #f4f4f4; vertical-align: bottom; }
td.text { text-align: left; white-space: normal; }
tr.failed { background: #fde9e7; }
"""


@dataclass(frozen=True)
class Outcome:
    """What became of a session.

    Attributes:
        name: of it.
        recording: path or URL.
        figures: name -> value or None; of the stages that were finished.
        wall_s: stage -> seconds that its tasks took, of the run that did it.
        failed_in: stage that it was given up in, or empty.
        error: why, in one line, or empty.
    """

    name: str
    recording: str
    figures: Mapping[str, Any]
    wall_s: Mapping[str, float]
    failed_in: str
    error: str

    @property
    def status(self) -> str:
        """``optimized`` or ``failed``."""
        return "failed" if self.error else "optimized"


def write_tables(outcomes: Sequence[Outcome], storage: Storage) -> None:
    """Write ``summary.csv`` and ``summary.html``, each whole or not at all.

    Args:
        outcomes: rows, in their order.
        storage: the folder of all results.

    Raises:
        FleetError: if they cannot be written.
    """
    rows = [_row(outcome) for outcome in outcomes]
    storage.write("summary.csv", _csv(rows).encode())
    storage.write("summary.html", _page(rows).encode())


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


def _page(rows: Sequence[Mapping[str, str]]) -> str:
    failed = sum(row["status"] == "failed" for row in rows)
    heads = "".join(f"<th>{html.escape(name.replace('_', ' '))}</th>" for name in COLUMNS)
    body = "\n".join(_table_row(row) for row in rows)
    return (
        "<!DOCTYPE html>\n"
        '<html lang="en"><head><meta charset="utf-8"><title>graphvio fleet</title>'
        f"<style>{_STYLE}</style></head><body>\n"
        f"<h1>{len(rows)} sessions, {len(rows) - failed} optimised, {failed} failed</h1>\n"
        f"<table><thead><tr>{heads}</tr></thead><tbody>\n{body}\n</tbody></table>\n"
        "</body></html>\n"
    )


def _table_row(row: Mapping[str, str]) -> str:
    words = ("name", "status", "failed_in", "error", "recording")
    cells = "".join(
        f'<td class="{"text" if name in words else "number"}">{html.escape(row[name])}</td>' for name in COLUMNS
    )
    return f'<tr class="{row["status"]}">{cells}</tr>'
