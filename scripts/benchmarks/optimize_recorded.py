"""Accuracy of optimised recordings, and the time of each stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np

from benchmarks.report import Report, log_progress
from graphvio.arrays import Bool, Float
from graphvio.config import Config
from graphvio.errors import GraphvioError
from graphvio.evaluation import MAX_GAP_S, evaluate
from graphvio.geometry import se3_inverse, se3_log
from graphvio.optimization.graph import poses_of
from graphvio.optimization.nodes import spread
from graphvio.optimization.optimize import Optimization
from graphvio.optimization.pipeline import Session, optimize_sessions
from graphvio.optimization.report.numbers import loop_errors
from graphvio.sources import open_source
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory
from graphvio.warmup import warm_up

AIM_CLOSURE_M, AIM_ATE = 0.05, 2.0
AIMED_AT = "loop"
WRONG_M, WRONG_DEG = 0.1, 2.0
STAGES = ("calibration", "odometry", "features", "loops", "graph", "map")
_SOLVING = ("without loops", "with loops")


@dataclass(frozen=True, eq=False)
class Optimized:
    """A recording that was optimised.

    Attributes:
        folder: folder of the results, with the database of features.
        session: the recording.
        truth: true trajectory of the recording.
        found: result of the optimisation.
        stage_s: name of the stage -> time in seconds.
    """

    folder: Path
    session: Session
    truth: Trajectory
    found: Optimization
    stage_s: dict[str, float]

    @property
    def used(self) -> Bool:
        """Whether each loop closure (L,) is used."""
        return np.array([not loop.refusal for loop in self.found.loops], dtype=bool)

    @property
    def across(self) -> Bool:
        """Whether each loop closure (L,) is between different pairs."""
        return np.array([any(a != b for a, b in loop.closure.pairs) for loop in self.found.loops], dtype=bool)

    def ate_m(self, poses: Float) -> float:
        """Return the ATE of poses (F, 4, 4) of all framesets."""
        stamps_ns = self.found.sessions[0].record.stamps_ns
        return evaluate(Trajectory(stamps_ns, poses), self.truth).ate_position_m.rmse

    def ates_m(self) -> tuple[float, float, float, float]:
        """Return the ATEs of the online, the smoothed, and the optimised trajectory without and with loop closures."""
        session = self.found.sessions[0]
        alone = spread(session.nodes, poses_of(self.found.alone, len(session.nodes.rows)))
        poses = (session.record.online, session.record.smoothed, alone, session.nav_T_body)
        online, smoothed, without, with_loops = (self.ate_m(each) for each in poses)
        return online, smoothed, without, with_loops

    def closures_off(self) -> Float:
        """Return the errors of all loop closures, (L, 2) metres and degrees; NaN where the truth is not known."""
        made = np.full((len(self.found.loops), 2), np.nan)
        record = self.found.sessions[0].record
        for number, loop in enumerate(self.found.loops):
            motion = self._true(record.stamps_ns[[loop.closure.reference.row, loop.closure.current.row]].tolist())
            if motion is not None:
                error = se3_log(se3_inverse(motion) @ loop.closure.reference_T_current)
                made[number] = np.linalg.norm(error[3:]), np.rad2deg(np.linalg.norm(error[:3]))
        return made

    def ends_off_m(self, poses: Float) -> Float:
        """Return, for each used closure with known truth, the error in metres of the position of one end relative to
        the other, by the poses (F, 4, 4)."""
        made = []
        record = self.found.sessions[0].record
        for loop in (loop for loop in self.found.loops if not loop.refusal):
            first, second = loop.closure.reference.row, loop.closure.current.row
            motion = self._true(record.stamps_ns[[first, second]].tolist())
            if motion is not None:
                estimated = se3_inverse(np.ascontiguousarray(poses[first])) @ poses[second]
                made.append(float(np.linalg.norm(estimated[:3, 3] - motion[:3, 3])))
        return np.array(made)

    def _true(self, stamps_ns: Sequence[int]) -> Float | None:
        known, _ = self.truth.at(np.array(stamps_ns, dtype=np.int64), MAX_GAP_S)
        if len(known) < len(stamps_ns):
            return None
        first, second = known.nav_T_body
        return np.asarray(se3_inverse(np.ascontiguousarray(first)) @ second)


def optimized(folder: Path, name: str, out: Path, pairs: tuple[int, ...] | None = None) -> Optimized:
    """Optimise a recording.

    Args:
        folder: folder of the recording.
        name: name of the recording in the results.
        out: folder of the results.
        pairs: indices of the pairs to use; None for all.

    Raises:
        GraphvioError: if the recording cannot be read or has no truth.
    """
    source = open_source(folder)
    if pairs is not None:
        source = open_source(folder, source.rig.with_pairs(pairs))
    if source.truth is None:
        raise GraphvioError(f"{folder}: holds no true trajectory, which the accuracy needs")
    config = Config()
    warm_up(source.rig, config)
    spent = dict.fromkeys(STAGES, 0.0)
    latest = perf_counter()

    def note(stage: str) -> None:
        nonlocal latest
        now = perf_counter()
        spent[stage] += now - latest
        latest = now

    session = Session(source.name, source)
    found = optimize_sessions([source], out, config, on_progress=lambda what, *_: note(_stage(what)))
    note("map")  # time of the map and of the report
    made = Optimized(out, session, load_trajectory(source.truth), found, spent)
    log_progress(
        f"  {name}: {sum(spent.values()):.0f} s, {int(made.used.sum())} of {len(made.used)} closures used, ATE "
        f"{100 * made.ates_m()[-1]:.2f} cm"
    )
    return made


def _stage(what: str) -> str:
    return "graph" if what in _SOLVING else what.split(" of ")[0].split(":")[0]


def add_recordings(report: Report, runs: dict[str, Optimized]) -> None:
    """Add the tables of errors, closures and times."""
    report.add("### Recordings", f"All pairs and the IMU; ATE in cm. {_lengths(runs)}")
    rows = []
    for name, run in runs.items():
        ates = run.ates_m()
        gain = ates[0] / ates[-1]
        aim = f"{AIM_ATE:g}: {'met' if gain >= AIM_ATE else 'missed'}" if name == AIMED_AT else ""
        rows.append([name, *(f"{100 * ate:.2f}" for ate in ates), f"{gain:.2f}", aim])
    head = ["recording", "online", "smoothed", "without loops", "with loops", "online / with loops", "aim"]
    report.table(head, rows)
    report.add(
        "Closures: *wrong* ones are off from the truth by more than "
        f"{100 * WRONG_M:g} cm or {WRONG_DEG:g} degrees. *Error* is the median of the used ones, in mm: by how much "
        "the relative position of a closure's ends differs from the true one, by the online and by the optimised "
        "poses; *from the closure* is the same difference from the closure's own measurement; *its own* is the error "
        "of the closures themselves."
    )
    rows = []
    for name, run in runs.items():
        used, off = run.used, run.closures_off()
        wrong = (off[:, 0] > WRONG_M) | (off[:, 1] > WRONG_DEG)
        right = np.isfinite(off[:, 0]) & ~wrong
        record, optimised = run.found.sessions[0].record, run.found.sessions[0].nav_T_body
        after = run.ends_off_m(optimised)
        aim = ""
        if name == AIMED_AT:
            is_met = len(after) and float(np.median(after)) < AIM_CLOSURE_M
            aim = f"{1e3 * AIM_CLOSURE_M:g}: {'met' if is_met else 'missed'}"
        rows.append(
            [
                name,
                f"{len(used)}",
                f"{used.sum()}",
                f"{(used & wrong).sum()}",
                f"{(~used & right).sum()}",
                _median_mm(run.ends_off_m(record.online)),
                _median_mm(after),
                aim,
                _median_mm(loop_errors(run.found, "online")[used, 0]),
                _median_mm(loop_errors(run.found, "optimized")[used, 0]),
                _median_mm(off[used, 0]),
            ]
        )
    report.table(
        ["recording", "found", "used", "wrong used", "right refused", "error, online", "optimised", "aim",
         "from the closure, online", "optimised", "its own"],
        rows,
    )  # fmt: skip
    report.add("Seconds by stage; *map* holds the export to COLMAP and the report.")
    rows = [
        [name, *(f"{run.stage_s[stage]:.1f}" for stage in STAGES), f"{sum(run.stage_s.values()):.1f}"]
        for name, run in runs.items()
    ]
    report.table(["recording", *STAGES, "all"], rows)


def add_pairs(report: Report, runs: dict[str, Optimized]) -> None:
    """Add the table of one recording by the pairs that are used; ``runs`` is name of the pairs -> run."""
    report.add(
        "### Pairs of the loop",
        "The loop with each pair alone and with both. *Across pairs* are closures by points of one pair which the "
        "other saw, as where a way is walked back. ATE in cm.",
    )
    rows = []
    for name, run in runs.items():
        used, across, ates = run.used, run.across, run.ates_m()
        counts = [f"{len(used)}", f"{across.sum()}", f"{used.sum()}", f"{(used & across).sum()}"]
        rows.append([name, *counts, *(f"{100 * ate:.2f}" for ate in (ates[0], *ates[2:]))])
    head = ["pairs", "found", "across pairs", "used", "across pairs", "ATE online", "without loops", "with loops"]
    report.table(head, rows)


def _lengths(runs: dict[str, Optimized]) -> str:
    parts = []
    for name, run in runs.items():
        whole = evaluate(
            Trajectory(run.found.sessions[0].record.stamps_ns, run.found.sessions[0].nav_T_body), run.truth
        )
        parts.append(f"{name} {whole.path_length_m:.0f} m, {whole.duration_s:.0f} s")
    return f"Lengths: {', '.join(parts)}."


def _median_mm(errors_m: Float) -> str:
    known = errors_m[np.isfinite(errors_m)]
    return f"{1e3 * np.median(known):.2f}" if len(known) else "-"
