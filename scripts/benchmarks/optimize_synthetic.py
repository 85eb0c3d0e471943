"""Optimisation of synthetic sessions without images: time and memory by length, accuracy by share of false closures."""

from __future__ import annotations

import resource
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import pairwise, product
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter, process_time
from typing import NamedTuple

import numpy as np
from synthetic_session import SyntheticSession, make_session

from benchmarks.report import Report, log_progress
from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.evaluation import evaluate
from graphvio.optimization.loops.closures import LoopClosure
from graphvio.optimization.optimize import Optimization, optimize
from graphvio.rig import Imu
from graphvio.trajectory import Trajectory

AIM_S, AIM_MB, AIM_GROWTH = 300.0, 4096.0, 1.25
AIM_ATE = 1.1
LOOPS_AN_HOUR, FALSE_SHARE = 200, 0.3
_BLOCK = 15  # variables of a state: pose, velocity, biases
_WALK_S, _RIGHT = 315.0, 42
_FALSE = (0, 5, 18, 42, 63)
"""Numbers of false closures; together with the true ones, they are 0, 10, 30, 50 and 60 % of all closures."""
_AIMED_AT = 18
_ANYWHERE = 0.0
_SHIFTS_M = (_ANYWHERE, 2.0, 0.1)


class _Hour(NamedTuple):
    minutes: float
    states: int
    right: int
    right_used: int
    false: int
    false_used: int
    before_m: float
    after_m: float
    seconds: float
    processor_s: float
    reference_s: float
    memory_mb: float

    @property
    def ratio(self) -> float:
        """Processor time over that of the reference."""
        return self.processor_s / self.reference_s


def add_hour(report: Report, minutes: Sequence[float]) -> None:
    """Measure sessions of the given lengths, and add the tables."""
    runs = []
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        for length in sorted(minutes):
            run = pool.submit(_hour, length).result()
            log_progress(f"  {run.minutes:g} minutes: {run.seconds:.1f} s, {run.memory_mb:.0f} MB")
            runs.append(run)
    report.add(
        "### An hour",
        f"{LOOPS_AN_HOUR} closures an hour, {100 * FALSE_SHARE:.0f} % of them false and anywhere. *Time* is that of "
        "`optimize()` by the clock, which other load lengthens; *processor* that of all cores. *Reference* is the "
        f"processor's time for a chain of as many states, blocks of {_BLOCK} variables, factored and solved in plain "
        "numpy before and after it in the same process: where *ratio*, processor over reference, stays constant, the "
        "work is linear in the length. *Memory* is the process's maximum, sampling the session included.",
    )
    report.table(
        ["minutes", "states", "right used", "false used", "ATE before, m", "after, m", "time, s", "processor, s",
         "reference, s", "ratio", "memory, MB"],
        [
            [f"{run.minutes:g}", f"{run.states}", f"{run.right_used} / {run.right}", f"{run.false_used} / {run.false}",
             f"{run.before_m:.2f}", f"{run.after_m:.3f}", f"{run.seconds:.1f}", f"{run.processor_s:.1f}",
             f"{run.reference_s:.2f}", f"{run.ratio:.1f}", f"{run.memory_mb:.0f}"]
            for run in runs
        ],
    )  # fmt: skip
    last = runs[-1]
    rows = []
    if last.minutes <= 60.0:
        rows.append([f"time of {last.minutes:g} minutes, s", f"{last.seconds:.1f}", _aim_result(last.seconds, AIM_S)])
        rows.append([f"memory of {last.minutes:g} minutes, MB", f"{last.memory_mb:.0f}",
                     _aim_result(last.memory_mb, AIM_MB)])  # fmt: skip
    for shorter, longer in pairwise(runs):
        names = f"{longer.minutes:g} and {shorter.minutes:g} minutes"
        length = longer.minutes / shorter.minutes
        rows.append([f"time, {names}: {length:g} would be linear", f"{longer.seconds / shorter.seconds:.2f}", ""])
        growth = longer.ratio / shorter.ratio
        rows.append([f"ratio, {names}: 1 would be linear", f"{growth:.2f}", _aim_result(growth, AIM_GROWTH)])
    report.table(["what", "value", "aim"], rows)


def _hour(minutes: float) -> _Hour:
    imu = Imu()
    session = make_session(60.0 * minutes, 1, imu, round(LOOPS_AN_HOUR * minutes / 60.0), FALSE_SHARE)
    warm = make_session(5.0, 1, imu, 0)
    optimize([warm.record], [imu], [], Config())  # so that compilation and imports are not timed
    states = round(5.0 * 60.0 * minutes)
    reference_s = _reference_s(states)
    start, start_processor = perf_counter(), process_time()
    found = optimize([session.record], [imu], session.closures, Config())
    seconds, processor_s = perf_counter() - start, process_time() - start_processor
    reference_s = 0.5 * (reference_s + _reference_s(states))
    right_used, false_used = _used(session, found)
    return _Hour(
        minutes,
        len(found.sessions[0].nodes.rows),
        len(session.closures) - session.false,
        right_used,
        session.false,
        false_used,
        _ate_m(session, session.record.online),
        _ate_m(session, found.sessions[0].nav_T_body),
        seconds,
        processor_s,
        reference_s,
        _peak_mb(),
    )


def _reference_s(states: int) -> float:
    """Return the processor time for a chain of states, factored forwards and solved backwards block by block."""
    rng = np.random.default_rng(0)
    coupling = 0.2 * rng.standard_normal((_BLOCK, _BLOCK))
    own = 10.0 * np.eye(_BLOCK) + coupling @ coupling.T
    start = process_time()
    factors, below, right = [], [], []
    block, vector = own, np.ones(_BLOCK)
    for _ in range(states):
        factor = np.linalg.cholesky(block)
        tied = np.linalg.solve(factor, coupling)
        solved = np.linalg.solve(factor, vector)
        factors.append(factor)
        below.append(tied)
        right.append(solved)
        block, vector = own - tied.T @ tied, np.ones(_BLOCK) - tied.T @ solved
    after = np.zeros(_BLOCK)
    for factor, tied, solved in zip(factors[::-1], below[::-1], right[::-1], strict=True):
        after = np.linalg.solve(factor.T, solved - tied @ after)
    return process_time() - start


class _Case(NamedTuple):
    seed: int
    shift_m: float
    false: int


class _Result(NamedTuple):
    online_m: float
    ate_m: float
    right_used: int
    false_used: int


def add_false_closures(report: Report, seeds: int, jobs: int) -> None:
    """Measure the effect of false closures on a walk, and add the table."""
    clean = [_Case(seed, _ANYWHERE, 0) for seed in range(1, seeds + 1)]
    cases = clean + [_Case(seed, *kind) for kind in product(_SHIFTS_M, _FALSE[1:]) for seed in range(1, seeds + 1)]
    results = {}
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for case, result in zip(cases, pool.map(_judged, cases), strict=True):
            results[case] = result
            if case.seed == seeds:
                log_progress(f"  {_kind(case.shift_m)}, {case.false} false and {_RIGHT} true ones: done")
    rows, aims = [], []
    for shift_m, false in [(_ANYWHERE, 0), *product(_SHIFTS_M, _FALSE[1:])]:
        found = [results[_Case(each.seed, shift_m, false)] for each in clean]
        ratios = np.array([one.ate_m / results[each].ate_m for one, each in zip(found, clean, strict=True)])
        aim = _aim_result(float(ratios.max()), AIM_ATE) if false == _AIMED_AT else ""
        aims.append(aim)
        rows.append(
            [
                f"{100 * false / (false + _RIGHT):.0f}",
                _kind(shift_m) if false else "",
                f"{np.median(ratios):.3f}",
                f"{ratios.max():.3f}",
                f"{sum(one.false_used for one in found)} / {seeds * false}",
                f"{seeds * _RIGHT - sum(one.right_used for one in found)} / {seeds * _RIGHT}",
                aim,
            ]
        )
    online, after = (np.median([getattr(results[each], name) for each in clean]) for name in ("online_m", "ate_m"))
    report.add(
        "### False closures",
        f"A walk of {_WALK_S:g} s with {_RIGHT} right closures and more and more false ones, {seeds} seeds. "
        "*Anywhere*: between any two places and off by metres. *All alike*: of places that are seen again, all off by "
        "the same transform along the way, as where a pattern repeats: "
        f"{_SHIFTS_M[1]:g} m is more than the odometry can be off by here, {_SHIFTS_M[2]:g} m is not. The ATE is given "
        f"as its ratio to that of the right ones alone (in the median {100 * after:.1f} cm, online "
        f"{100 * online:.0f} cm); closures are counted over all seeds.",
    )
    head = ["false, %", "which", "ATE ratio, median", "worst", "false used", "right refused", "aim for the worst"]
    report.table(head, rows)


def _judged(case: _Case) -> _Result:
    imu = Imu()
    if case.shift_m == _ANYWHERE:
        loops = _RIGHT + case.false
        session = make_session(_WALK_S, case.seed, imu, loops, case.false / loops)
    else:
        session = _all_alike(make_session(_WALK_S, case.seed, imu, _RIGHT + case.false), case.shift_m, case.false)
    found = optimize([session.record], [imu], session.closures, Config())
    return _Result(
        _ate_m(session, session.record.online), _ate_m(session, found.sessions[0].nav_T_body), *_used(session, found)
    )


def _all_alike(session: SyntheticSession, shift_m: float, false: int) -> SyntheticSession:
    """Return the session with its last ``false`` closures off by ``shift_m`` metres along the way."""
    shift = np.eye(4)
    shift[0, 3] = shift_m

    def moved(closure: LoopClosure) -> LoopClosure:
        return replace(closure, reference_T_current=shift @ closure.reference_T_current)

    right = len(session.closures) - false
    closures = [each if k < right else moved(each) for k, each in enumerate(session.closures)]
    return replace(session, closures=closures, false=false)


def _used(session: SyntheticSession, found: Optimization) -> tuple[int, int]:
    """Return the numbers of used closures that are right and that are false."""
    used = [not loop.refusal for loop in found.loops]
    right = len(used) - session.false
    return sum(used[:right]), sum(used[right:])


def _ate_m(session: SyntheticSession, poses: Float) -> float:
    return evaluate(Trajectory(session.record.stamps_ns, poses), session.truth).ate_position_m.rmse


def _kind(shift_m: float) -> str:
    return "anywhere" if shift_m == _ANYWHERE else f"all alike, {shift_m:g} m"


def _aim_result(value: float, most: float) -> str:
    return f"{most:g}: {'met' if value <= most else 'missed'}"


def _peak_mb() -> float:
    """Return the peak memory of this process, MB."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024.0
