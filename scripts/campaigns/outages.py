"""``scripts/campaign outages``: estimates when images or the IMU fail, for a while or for good.

The whole odometry with its default configuration runs on the simulated room, once for each case. A table shows the
status of the estimates during the fault, how far they jumped, when vision was used again, and the error of the motion.
"""

from __future__ import annotations

import argparse
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from benchmarks.command_line import Subparsers, add_command, add_report_options
from benchmarks.recordings import add_data_option, simulated
from benchmarks.report import Report, log_progress, machine
from scipy.stats import chi2

from campaigns.outage_cases import BEGIN_S, CASES, Case, Delivery
from graphvio.arrays import Float
from graphvio.errors import GraphvioError
from graphvio.geometry import se3_inverse, se3_log
from graphvio.measurements.estimate import Estimate, Status
from graphvio.measurements.events import Event
from graphvio.odometry import Odometry
from graphvio.sources import open_source
from graphvio.trajectory_files import load_trajectory

_SCENE = "room"
_BEFORE_S, _AFTER_S = 1.0, 3.0
_WARM_UP_S = 2.0  # errors of motions are measured only after this time, since the tilt is least certain at first
_MAX_SIGMA = 3.0
_MAX_STATISTIC = float(chi2.isf(chi2.sf(_MAX_SIGMA**2, 1), 6))  # with the same probability in 6 dimensions
_BY_VISION = (Status.TRACKING, Status.INITIALISING)
_HEAD = ("case", "poses, %", "while it lasts", "largest jump, mm", "at return", "recovery, s", "error, cm",
         "epochs", "events")  # fmt: skip
_EXPLANATION = (
    f"The fault begins after {BEGIN_S:g} s of the {_SCENE} unless stated otherwise. Poses: of the delivered "
    "framesets, those whose estimate has one. Largest jump: the most by which a step from one frameset to the next, "
    "within an epoch, is off the true one, at return or elsewhere. At return: the Mahalanobis distance of such a step "
    "from coasting to vision, rotation included, under the covariance of the pose before. Recovery: from the end of "
    f"the fault until vision is used. Error: of the position by the motion from {_BEFORE_S:g} s before to "
    f"{_AFTER_S:g} s after, or to the end; where an epoch began meanwhile, from its first pose on."
)


def add_parser(subparsers: Subparsers) -> None:
    """Add ``outages``."""
    parser = add_command(subparsers, "outages", "blackouts and faults of the data, and how each ends", __doc__, main)
    parser.add_argument("--jobs", type=int, default=2, help="runs side by side (default: 2)")
    add_report_options(parser)
    add_data_option(parser)


def main(args: argparse.Namespace) -> None:
    """Run all cases and report."""
    if args.jobs < 1:
        raise GraphvioError("--jobs must be 1 or more")
    folder = simulated(args.data, _SCENE)
    report = Report()
    report.add(machine())
    rows, broken = [], []
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        tasks = [pool.submit(run_case, number, folder) for number in range(len(CASES))]
        for number, (case, task) in enumerate(zip(CASES, tasks, strict=True)):
            cells, missed = task.result()
            rows.append([case.name, *cells])
            broken += [f"- {case.name}: {words}" for words in missed]
            log_progress(f"case {number + 1} of {len(CASES)}")
    report.add("### Required", "In all cases, time never goes back and there is no pose while lost.")
    report.table(("case", "required"), [(case.name, case.requirement) for case in CASES])
    report.add("### Results", _EXPLANATION)
    report.table(_HEAD, rows)
    report.add(
        "Required of every case: each delivered frameset has an estimate, stamps increase, there is no pose while "
        f"lost, and no return within an epoch is beyond {np.sqrt(_MAX_STATISTIC):.1f}, which is as improbable of a "
        f"pose as {_MAX_SIGMA:g} sigma are of a number: " + ("**missed**." if broken else "**met**.")
    )
    if broken:
        report.add(*broken)
    report.write(args, "outages")


def run_case(number: int, folder: Path) -> tuple[list[str], list[str]]:
    """Run one of the cases on a recording; return its cells of the table, and the requirements that it missed."""
    outcome = outcome_of(CASES[number], folder)
    return outcome.cells(), outcome.missed()


def outcome_of(case: Case, folder: Path) -> Outcome:
    """Run a case on a recording, and return its outcome."""
    source = open_source(folder, to_s=case.length_s)
    assert source.truth is not None
    truth = load_trajectory(source.truth)
    odometry, delivery = Odometry(source.rig), Delivery(case, source, source.start_ns)
    estimates = [estimate for measurement in delivery if (estimate := odometry.process(measurement)) is not None]
    estimates += odometry.finish()
    stamps = [case.true_ns(estimate.stamp_ns, source.start_ns) for estimate in estimates]
    times_s = (np.array(stamps, dtype=np.int64) - source.start_ns) * 1e-9
    at = np.searchsorted(truth.stamps_ns, stamps)
    assert np.array_equal(truth.stamps_ns[at], stamps)
    events = odometry.take_events()
    return Outcome(case, estimates, np.asarray(times_s), truth.nav_T_body[at], delivery.framesets, events)


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of one case.

    Attributes:
        case: the case.
        estimates: the N estimates, in the order in which they were reported.
        times_s: (N,) times of their images, seconds after the first frameset of the recording.
        world_T_body: (N, 4, 4) true poses.
        given: number of framesets that were delivered.
        events: all events.
    """

    case: Case
    estimates: list[Estimate]
    times_s: Float
    world_T_body: Float
    given: int
    events: list[Event]

    def cells(self) -> list[str]:
        """Return the cells of the table after the case's name."""
        estimates = self.estimates
        distances = self.return_distances()
        lasts = (self.times_s >= self.case.begin_s - 1e-3) & (self.times_s < self.case.over_s - 1e-3)
        statuses = Counter(str(e.status) for e, during in zip(estimates, lasts, strict=True) if during)
        kinds = Counter(event.kind for event in self.events)
        return [
            f"{100 * sum(e.nav_T_body is not None for e in estimates) / self.given:.1f}",
            _counts(statuses),
            f"{1e3 * np.nanmax([np.linalg.norm(self._error(i, i + 1)[3:]) for i in range(len(estimates) - 1)]):.1f}",
            f"{max(distances):.1f}" if distances else "-",
            _figure(self.recovery_s(), 2),
            _figure(100 * self.error_m(), 2),
            str(len({e.epoch for e in estimates})),
            _counts(kinds),
        ]

    def missed(self) -> list[str]:
        """Return those requirements for all cases that this one missed."""
        stamps = [e.stamp_ns for e in self.estimates]
        most = max(self.return_distances(), default=0.0)
        requirements = {
            f"{len(stamps)} estimates of {self.given} framesets": len(stamps) == self.given,
            "stamps do not increase": stamps == sorted(set(stamps)),
            "a pose while lost": all(e.nav_T_body is None for e in self.estimates if e.status is Status.LOST),
            f"a return by {most:.1f}": most**2 <= _MAX_STATISTIC,
        }
        return [words for words, held in requirements.items() if not held]

    def return_distances(self) -> list[float]:
        """Return the Mahalanobis distances of the steps from coasting to vision, by the covariance before each step."""
        distances = []
        for i, (before, after) in enumerate(pairwise(self.estimates)):
            returned = before.status is Status.COASTING and after.status in _BY_VISION
            if returned and before.covariance is not None and before.epoch == after.epoch:
                error = self._error(i, i + 1)
                distances.append(float(np.sqrt(error @ np.linalg.solve(before.covariance, error))))
        return distances

    def recovery_s(self) -> float:
        """Return the time from the end of the fault until vision is used again, seconds; NaN if that never happens."""
        after = self.times_s >= self.case.over_s - 1e-3
        used = [e.status in _BY_VISION and e.nav_T_body is not None for e in self.estimates]
        times_s = self.times_s[after & np.array(used)]
        return float(times_s[0] - self.case.over_s) if len(times_s) else np.nan

    def error_m(self) -> float:
        """Return the position error of the motion from before to after the fault; NaN if there is no pose after it."""
        end = int(np.searchsorted(self.times_s, self.case.over_s + _AFTER_S + 1e-3)) - 1
        start_s = max(self.case.begin_s - _BEFORE_S, _WARM_UP_S) - 1e-3
        of_epoch = [e.epoch == self.estimates[end].epoch and e.nav_T_body is not None for e in self.estimates]
        start = int(np.flatnonzero((self.times_s >= start_s) & np.array(of_epoch))[0])
        return float(np.linalg.norm(self._error(start, end)[3:]))

    def _error(self, i: int, j: int) -> Float:
        """Return the error (6,) of the motion between two estimates, a tangent in the earlier body.

        NaN where the estimates are of different epochs or one has no pose.
        """
        start, end = self.estimates[i], self.estimates[j]
        if start.nav_T_body is None or end.nav_T_body is None or start.epoch != end.epoch:
            return np.full(6, np.nan)
        motion = se3_inverse(start.nav_T_body) @ end.nav_T_body
        true = se3_inverse(self.world_T_body[i]) @ self.world_T_body[j]
        return np.asarray(se3_log(motion @ se3_inverse(true)))


def _counts(counter: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counter.most_common()) or "-"


def _figure(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "-"
