"""``scripts/benchmark faults``: how often the front-end returns a wrong motion with a small covariance.

The odometry runs on hard scenes and on simulated faults of cameras, light and cables, with vision alone and with the
IMU. Every motion that the front-end returns is compared with the truth.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.command_line import add_command, add_report_options
from benchmarks.fault_cases import CASES, WALKS, Case, hard_measurements
from benchmarks.fault_outcomes import MATERIAL_DEG, MATERIAL_M, MotionOutcome, Outcome, Run
from benchmarks.fault_scenes import CORRIDOR_S, recording
from benchmarks.motions import BREAK_STATISTIC
from benchmarks.recordings import add_data_option
from benchmarks.report import Report, log_progress, machine
from graphvio.config import Config
from graphvio.errors import GraphvioError
from graphvio.measurements.motion import Quality
from graphvio.sources import open_source
from graphvio.trajectory_files import load_trajectory
from graphvio.warmup import warm_up

AIM_SHARE = 0.001
"""Largest share of the used motions that may be wrong beyond 5 sigma."""
_MODES = {False: "Vision alone", True: "Vision and IMU"}
_HEAD = (
    "case", "framesets", "in faults", "returned", "weak", "failed", "commonest reason", "inliers a pair",
    "NEES median", "NEES mean", "> 5 sigma", "material", "used", "used, > 5 sigma", "used, material",
)  # fmt: skip
_COLUMNS = (
    "case", "imu", "second", "in_fault", "quality", "used", "nees", "error_m", "error_deg", "interval_s", "inliers",
    "points",
)  # fmt: skip


@dataclass(frozen=True)
class Task:
    """One run: name of the case, seed, duration, folder of rendered recordings, pairs to use, and configuration."""

    case: str
    seed: int
    duration_s: float
    data: Path
    pairs: tuple[int, ...] | None
    config: Config


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``faults``."""
    summary = "hard scenes and faults: the share of motions that are confident and wrong"
    parser = add_command(subparsers, "faults", summary, __doc__, main)
    parser.add_argument("--seeds", type=int, default=1, help="runs of each case, each on another walk (default: 1)")
    parser.add_argument("--duration", type=float, default=12.0, metavar="S", help="seconds of a walk (default: 12)")
    parser.add_argument("--cases", nargs="+", metavar="CASE", choices=[c.name for c in CASES], help="only these")
    parser.add_argument("--pairs", type=int, nargs="+", metavar="PAIR", help="only these pairs of the rig")
    parser.add_argument("--jobs", type=int, default=1, help="cases that are run side by side (default: 1)")
    add_report_options(parser)
    parser.add_argument("--motions", type=Path, metavar="FILE.csv", help="write a line for each motion")
    parser.add_argument("--config", metavar="NAME", help="profile or YAML file to run with (default: the defaults)")
    add_data_option(parser)


def main(args: argparse.Namespace) -> None:
    """Run all cases and report."""
    if args.seeds < 1 or args.duration <= 0.0 or args.jobs < 1:
        raise GraphvioError("--seeds, --duration and --jobs must be positive")
    names = args.cases or [case.name for case in CASES]
    pairs = tuple(args.pairs) if args.pairs else None
    config = Config.load(args.config) if args.config else Config()
    tasks = [Task(name, seed, args.duration, args.data, pairs, config) for name in names for seed in range(args.seeds)]
    for task in tasks:
        _folder(task)  # rendered here, since several processes would render the same scene twice
    outcomes: dict[str, dict[bool, Outcome]] = {name: {mode: Outcome() for mode in _MODES} for name in names}
    for task, by_mode in zip(tasks, _run_all(tasks, args.jobs), strict=True):
        for mode, outcome in by_mode.items():
            outcomes[task.case][mode].add(outcome)
    report = Report()
    report.add(machine())
    report.add(_options(args))
    _write(report, outcomes)
    report.write(args, "faults")
    if args.motions is not None:
        _list_motions(args.motions, outcomes)


def run_case(task: Task) -> dict[bool, Outcome]:
    """Run a case on the same images without the IMU (key False) and with it (key True)."""
    case, duration_s = _case(task)
    source = open_source(_folder(task))
    if task.pairs is not None:
        source = open_source(_folder(task), source.rig.with_pairs(task.pairs))
    if source.truth is None:
        raise GraphvioError(f"{source.name}: has no truth")
    trajectory = load_trajectory(source.truth)
    truth = dict(zip(trajectory.stamps_ns.tolist(), trajectory.nav_T_body, strict=True))
    warm_up(source.rig, task.config)
    runs = {with_imu: Run(source.rig, task.config, with_imu=with_imu) for with_imu in _MODES}
    for measurement, during in hard_measurements(case, task.seed, source, truth, duration_s):
        for run in runs.values():
            run.feed(measurement, during)
    return {with_imu: run.finish(truth, source.start_ns) for with_imu, run in runs.items()}


def _run_all(tasks: Sequence[Task], jobs: int) -> list[dict[bool, Outcome]]:
    results = []
    if jobs == 1:
        for task in tasks:
            results.append(run_case(task))
            log_progress(_progress(task, results[-1]))
        return results
    # A forked process would copy locks that threads hold, and wait for them for ever.
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for task, result in zip(tasks, pool.map(run_case, tasks), strict=True):
            results.append(result)
            log_progress(_progress(task, result))
    return results


def _case(task: Task) -> tuple[Case, float]:
    """Return the case of a task, and the length of its recording, seconds."""
    case = next(case for case in CASES if case.name == task.case)
    return case, CORRIDOR_S if case.scene == "corridor" else task.duration_s


def _folder(task: Task) -> Path:
    case, duration_s = _case(task)
    if case.scene is not None:
        return recording(task.data, case.scene, duration_s, task.seed)
    return recording(task.data, WALKS[task.seed % len(WALKS)], duration_s)


def _progress(task: Task, by_mode: Mapping[bool, Outcome]) -> str:
    parts = [
        f"{_MODES[mode].lower()}: {len(o.motions)} motions, {sum(m.wrong for m in o.motions)} wrong, "
        f"{sum(m.wrong for m in o.used)} of {len(o.used)} used"
        for mode, o in by_mode.items()
    ]
    return f"{task.case}, seed {task.seed}: {'; '.join(parts)}"


def _options(args: argparse.Namespace) -> str:
    """Return the options of the command line on which the results depend."""
    options = [f"`--seeds {args.seeds}`", f"`--duration {args.duration:g}`"]
    if args.cases:
        options.append(f"`--cases {' '.join(args.cases)}`")
    if args.pairs:
        options.append(f"`--pairs {' '.join(map(str, args.pairs))}`")
    options.append(f"`--config {Path(args.config).name}`" if args.config else "the default configuration")
    runs = "a run" if args.seeds == 1 else f"{args.seeds} runs"
    return (
        f"{', '.join(options)}: {runs} of each case over {args.duration:g} s (in the corridor {CORRIDOR_S:g} s), each "
        "without and with the IMU."
    )


def _write(report: Report, outcomes: Mapping[str, Mapping[bool, Outcome]]) -> None:
    report.add(
        "Every motion that the front-end returned, against the truth. *In faults* counts the framesets that a fault "
        "touched. *NEES* is the squared Mahalanobis distance of the motion from the truth (6 degrees of freedom: mean "
        "6, median 5.3 where the covariance is consistent). *> 5 sigma*: "
        f"NEES above {BREAK_STATISTIC:.1f}; *material*: and also wrong by more than {100 * MATERIAL_M:g} cm or "
        f"{MATERIAL_DEG:g} degrees. *Used*: it passed the odometry's gate; where "
        "pairs contradict each other, the motion and covariance of the consensus set that it used."
    )
    for mode, name in _MODES.items():
        report.add(f"### {name}")
        total = Outcome()
        rows = []
        for case in outcomes:
            outcome = outcomes[case][mode]
            total.add(outcome)
            rows.append(_row(next(c.title for c in CASES if c.name == case), outcome))
        rows.append(_row("**all**", total))
        report.table(_HEAD, rows)
        report.add(*_shares(total))
        report.add(_aim_result(total))


def _row(title: str, outcome: Outcome) -> list[str]:
    motions = outcome.motions
    used = outcome.used
    commonest = outcome.failures.most_common(1)
    nees = np.array([m.nees for m in motions])
    return [
        title,
        f"{outcome.framesets}",
        f"{outcome.during}",
        f"{len(motions)}",
        f"{sum(m.quality == Quality.WEAK for m in motions)}",
        f"{outcome.failures.total()}",
        f"{commonest[0][0]} ({commonest[0][1]})" if commonest else "",
        " + ".join(_mean_inliers(motions)),
        f"{np.median(nees):.2f}" if motions else "",
        f"{np.mean(nees):.2f}" if motions else "",
        f"{sum(m.wrong for m in motions)}",
        f"{sum(m.materially_wrong for m in motions)}",
        f"{len(used)}",
        f"{sum(m.wrong for m in used)}",
        f"{sum(m.materially_wrong for m in used)}",
    ]


def _mean_inliers(motions: Sequence[MotionOutcome]) -> list[str]:
    pairs = sorted({pair for motion in motions for pair in motion.inliers})
    return [f"{np.mean([motion.inliers.get(pair, 0) for motion in motions]):.0f}" for pair in pairs]


def _shares(total: Outcome) -> list[str]:
    """Return one line for each group of motions, with the shares of wrong ones."""
    groups = {
        "All returned motions": total.motions,
        "of good quality": [m for m in total.motions if m.quality == Quality.GOOD],
        "of weak quality": [m for m in total.motions if m.quality == Quality.WEAK],
        "returned while a fault lasted": [m for m in total.motions if m.during],
        "used by the odometry": total.used,
        "used while a fault lasted": [m for m in total.used if m.during],
    }
    lines = []
    for name, motions in groups.items():
        if motions:
            wrong, material = sum(m.wrong for m in motions), sum(m.materially_wrong for m in motions)
            lines.append(
                f"- {name}: {len(motions)}; beyond 5 sigma {wrong} ({100 * wrong / len(motions):.2f} %), "
                f"material {material} ({100 * material / len(motions):.2f} %)"
            )
    kinds = ", ".join(f"{kind} {count}" for kind, count in sorted(total.events.items()))
    return [*lines, f"- events: {kinds or 'none'}"]


def _aim_result(total: Outcome) -> str:
    used = total.used
    aim = f"Aim: less than {100 * AIM_SHARE:g} % of the used motions beyond 5 sigma"
    if not used:
        return f"{aim}: undetermined, none was used."
    wrong = sum(m.wrong for m in used)
    result = "met" if wrong < AIM_SHARE * len(used) else "missed"
    return f"{aim}: **{result}**, {wrong} of {len(used)} ({100 * wrong / len(used):.3f} %)."


def _list_motions(path: Path, outcomes: Mapping[str, Mapping[bool, Outcome]]) -> None:
    """Write a file with a line for each motion that was returned, and for each that was used."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(_COLUMNS)
        for case, by_mode in outcomes.items():
            for mode, outcome in by_mode.items():
                for used, motions in ((False, outcome.motions), (True, outcome.used)):
                    table.writerows(_motion_row(case, mode, m, used) for m in motions)


def _motion_row(case: str, with_imu: bool, m: MotionOutcome, used: bool) -> list[str]:
    flags = (int(m.during), m.quality, int(used))
    figures = (f"{m.nees:.1f}", f"{m.error_m:.4f}", f"{m.error_deg:.3f}", f"{m.interval_s:.2f}")
    pairs = ("+".join(map(str, counts.values())) for counts in (m.inliers, m.points))
    return [case, f"{int(with_imu)}", f"{m.since_s:.2f}", *map(str, flags), *figures, *pairs]
