"""Runs ``graphvio run`` for each sequence in its own process, several at once, and evaluates the results."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from graphvio.benchmark.datasets import Sequence as Recorded
from graphvio.errors import BenchmarkError, GraphvioError, TrajectoryError, writing
from graphvio.evaluation import MAX_GAP_S, Evaluation, evaluate
from graphvio.rig_files import load_rig
from graphvio.sources import open_source
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory

RUN = (sys.executable, "-m", "graphvio", "run")
"""Command that runs a sequence in its own process."""
_NS_PER_S = 1e9
_INCOMPLETE = 3  # exit code of ``graphvio run`` where less than 90 % of the framesets have a pose


@dataclass(frozen=True, eq=False)
class Outcome:
    """The outcome of one sequence: its results and evaluation, or the reason of its failure."""

    sequence: str
    recording: Path
    results: Path  # folder of `graphvio.results`, absent or incomplete after a failure
    summary: dict[str, Any] | None  # contents of ``summary.json``, or None if the run failed
    evaluation: Evaluation | None  # None if the run failed or could not be evaluated
    reason: str  # why the run failed, is incomplete or could not be evaluated; or empty

    @property
    def has_failed(self) -> bool:
        """Whether there is no result."""
        return self.summary is None

    @property
    def ate_m(self) -> float | None:
        """Rmse of the positions after SE(3) alignment, metres; None without an evaluation."""
        return None if self.evaluation is None else self.evaluation.ate_position_m.rmse


def run_sequences(
    sequences: Sequence[Recorded],
    out: Path,
    options: Sequence[str] = (),
    *,
    jobs: int = 1,
    on_done: Callable[[Outcome], None] = lambda outcome: None,
) -> list[Outcome]:
    """Run the odometry on all sequences; one that fails does not affect the others.

    Args:
        sequences: the sequences to run.
        out: new or empty folder, in which each sequence gets a result folder and a log.
        options: options of ``graphvio run``, the same for all sequences.
        jobs: number of sequences that run at once.
        on_done: called with each outcome, in the order of the sequences, in the calling thread.

    Returns:
        The outcomes, in the order of the sequences.

    Raises:
        BenchmarkError: if the folder is not empty or cannot be written.
    """
    with writing(out, BenchmarkError, "name another folder"):
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            raise BenchmarkError(f"{out}: is not empty, and results are never overwritten; name another folder")
    processes = _Processes()
    outcomes = []
    with ThreadPoolExecutor(jobs) as pool:
        try:
            waiting = [pool.submit(_run, each, out, options, processes) for each in sequences]
            for each in waiting:
                outcomes.append(each.result())
                on_done(outcomes[-1])
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            processes.terminate()
            raise
    return outcomes


class _Processes:
    """The running processes, so that an interrupt can end them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[str]] = set()
        self._is_ended = False

    def run(self, command: Sequence[str]) -> tuple[int, str]:
        """Run a command; return its exit code and what it wrote to stderr."""
        with self._lock:
            if self._is_ended:
                return 1, ""
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
            self._running.add(process)
        _, errors = process.communicate()
        with self._lock:
            self._running.discard(process)
        return process.returncode, errors

    def terminate(self) -> None:
        """End all processes, and let `run` begin no others."""
        with self._lock:
            self._is_ended = True
            for process in self._running:
                process.terminate()


def _run(each: Recorded, out: Path, options: Sequence[str], processes: _Processes) -> Outcome:
    results = out / each.name
    command = [*RUN, str(each.recording), "--out", str(results), *options]
    command += ["--rig", str(each.rig)] if each.rig is not None else []
    code, errors = processes.run(command)
    (out / f"{each.name}.log").write_text(errors, encoding="utf-8")
    if code not in (0, _INCOMPLETE):
        return Outcome(each.name, each.recording, results, None, None, _reason(errors, code))
    summary = json.loads((results / "summary.json").read_text(encoding="utf-8"))
    reason = "" if code == 0 else f"only {100 * summary['completion']:.0f} % of the framesets have a pose"
    try:
        evaluation = _evaluate(each, results)
    except GraphvioError as error:
        return Outcome(each.name, each.recording, results, summary, None, reason or str(error))
    return Outcome(each.name, each.recording, results, summary, evaluation, reason)


def _reason(errors: str, code: int) -> str:
    """Return the error of a failed run: the last line that it wrote."""
    lines = [line.strip() for line in errors.splitlines() if line.strip()]
    return lines[-1].removeprefix("graphvio: ") if lines else f"ended with exit code {code}, and said nothing"


def _evaluate(each: Recorded, results: Path) -> Evaluation:
    truth = each.truth
    if truth is None:
        truth = open_source(each.recording, load_rig(results / "rig.yaml")).truth
    if truth is None:
        raise TrajectoryError("no true trajectory is there")
    return evaluate_with(load_trajectory(results / "trajectory.txt"), load_trajectory(truth))


def evaluate_with(estimate: Trajectory, truth: Trajectory) -> Evaluation:
    """Evaluate an estimate; if the truth is too sparse to be interpolated, the estimate is interpolated to it.

    Such a truth, with intervals of more than 0.25 s (median), consists of surveyed points.

    Raises:
        TrajectoryError: if fewer than 3 poses can be associated.
    """
    if len(truth) > 1 and np.median(np.diff(truth.stamps_ns)) > MAX_GAP_S * _NS_PER_S:
        estimate, _ = estimate.at(truth.stamps_ns, MAX_GAP_S)
    return evaluate(estimate, truth)
