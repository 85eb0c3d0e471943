"""The result of a benchmark as JSON values, and as a table as in papers, beside published figures of other systems."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib import resources
from typing import Any

import yaml

from graphvio.benchmark.datasets import Dataset
from graphvio.benchmark.run import Outcome
from graphvio.version import __version__

ALIGNMENT = "rmse of positions after SE(3) alignment of the whole causal trajectory, without scale"
_WHOLE_SHARE = 0.8  # share of a sequence's length from which on the result is comparable with published figures


@dataclass(frozen=True)
class Published:
    """Published figures of one system on one data set."""

    system: str
    method: str  # odometry or SLAM, and with which sensors
    source: str  # paper and table
    read_from: str  # document from which the figures were read: the paper, or a copy of its table
    ate_m: Mapping[str, float]  # sequence -> rmse of positions after SE(3) alignment


def published_on(key: str) -> list[Published]:
    """Return the published figures on the data set with a key; empty if none could be verified."""
    return [Published(**each) for each in _document().get(key, {}).get("systems", [])]


def lengths_m(key: str) -> dict[str, float]:
    """Return the path lengths of whole sequences of the data set with a key, as far as they are known."""
    return dict(_document().get(key, {}).get("lengths_m", {}))


@cache
def _document() -> Any:
    return yaml.safe_load(resources.files("graphvio.benchmark").joinpath("published.yaml").read_text(encoding="utf-8"))


@dataclass(frozen=True, eq=False)
class Benchmark:
    """All outcomes on one data set."""

    dataset: Dataset
    folder: str
    config: str
    jobs: int
    outcomes: Sequence[Outcome]

    @property
    def published(self) -> list[Published]:
        """Published figures of the systems that have a figure on any of the sequences that were run."""
        names = {outcome.sequence for outcome in self.outcomes}
        return [each for each in published_on(self.dataset.key) if names.intersection(each.ate_m)]

    @property
    def absent(self) -> list[str]:
        """Sequences of the data set that the folder does not hold."""
        names = {outcome.sequence.split("-")[0] for outcome in self.outcomes}
        return [name for name in self.dataset.sequences if name not in names]

    def note(self, outcome: Outcome) -> str:
        """Return a note on a row: why it failed, or that it covers only a part of its sequence; empty if neither."""
        if outcome.reason or outcome.evaluation is None:
            return outcome.reason
        whole_m = lengths_m(self.dataset.key).get(outcome.sequence)
        length_m = outcome.evaluation.path_length_m
        if whole_m is not None and length_m < _WHOLE_SHARE * whole_m:
            return f"{length_m:.1f} of {whole_m:.0f} m only: published figures are of the whole sequence"
        return ""

    def as_dict(self) -> dict[str, Any]:
        """Convert to JSON values."""
        return {
            "dataset": self.dataset.key,
            "folder": self.folder,
            "graphvio_version": __version__,
            "config": self.config,
            "jobs": self.jobs,
            "ate": ALIGNMENT,
            "sequences": [self._row(outcome) for outcome in self.outcomes],
            "absent": self.absent,
            "published": [asdict(each) for each in self.published],
        }

    def _row(self, outcome: Outcome) -> dict[str, Any]:
        summary, found = outcome.summary or {}, outcome.evaluation
        return {
            "sequence": outcome.sequence,
            "recording": str(outcome.recording),
            "results": str(outcome.results),
            "failed": outcome.has_failed,
            "note": self.note(outcome),
            **{
                name: summary.get(name)
                for name in ("framesets", "duration_s", "completion", "wall_s", "realtime_factor")
            },
            "length_m": None if found is None else found.path_length_m,
            "ate_m": outcome.ate_m,
            "ate_rotation_deg": None if found is None else found.ate_rotation_deg.rmse,
            "poses_with_truth": None if found is None else found.associated,
            "kitti_percent": None if found is None else found.kitti_percent,
            "kitti_deg_per_m": None if found is None else found.kitti_deg_per_m,
        }

    def head(self) -> list[str]:
        """Return the column headings of `rows`."""
        segments = ["t, %", "r, deg/100 m"] if self.dataset.has_segments else []
        systems = [each.system for each in self.published]
        return ["sequence", "length, m", "graphvio, m", *segments, "completion, %", "time, s", "x real time", *systems]

    def rows(self) -> list[list[str]]:
        """Return the cells of the table: a row for each sequence, then the means over the sequences with a figure."""
        rows = [self._cells(outcome) for outcome in self.outcomes]
        if len(rows) < 2:
            return rows
        means = [_mean([outcome.ate_m for outcome in self.outcomes])]
        blanks = [""] * (5 if self.dataset.has_segments else 3)
        for each in self.published:
            means.append(_mean([each.ate_m.get(outcome.sequence) for outcome in self.outcomes]))
        return [*rows, ["mean of those", "", means[0], *blanks, *means[1:]]]

    def _cells(self, outcome: Outcome) -> list[str]:
        row = self._row(outcome)
        deg_per_m = row["kitti_deg_per_m"]
        per_100_m = None if deg_per_m is None else 100.0 * deg_per_m
        segments = [_text(row["kitti_percent"], 2), _text(per_100_m, 3)] if self.dataset.has_segments else []
        completion = None if row["completion"] is None else 100.0 * row["completion"]
        return [
            outcome.sequence,
            _text(row["length_m"], 1),
            "failed" if outcome.has_failed else _text(row["ate_m"], 4),
            *segments,
            _text(completion, 1),
            _text(row["wall_s"], 1),
            _text(row["realtime_factor"], 2),
            *(_text(each.ate_m.get(outcome.sequence), 3) for each in self.published),
        ]

    def notes(self) -> list[str]:
        """Return the lines below the table: notes on rows, absent sequences, and the sources of all figures."""
        lines = [f"{outcome.sequence}: {note}" for outcome in self.outcomes if (note := self.note(outcome))]
        load = "one sequence at a time" if self.jobs == 1 else f"{self.jobs} sequences at once"
        lines.append(f"graphvio: ATE, {ALIGNMENT}; times with {load}")
        if self.absent:
            lines.append(f"not in the folder: {', '.join(self.absent)}")
        for each in self.published:
            lines.append(f"{each.system}: {each.method}; {each.source} (read from {each.read_from})")
        if not self.published:
            lines.append("no published figures of other systems could be verified for these sequences")
        return lines


def _mean(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{sum(known) / len(known):.3f} ({len(known)})" if known else ""


def _text(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
