"""All that a report tells, computed once: page, pictures and summary take their numbers from here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import OptimizationError
from graphvio.optimization.optimize import Optimization
from graphvio.optimization.report.calibration import SessionCalibration, calibrations
from graphvio.optimization.report.measures import (
    STAGES,
    Accuracy,
    Part,
    Spread,
    accuracies_or_why_not,
    loop_distances,
    loop_errors,
    moved,
    online_in_frame,
    parts,
    path_length_m,
    sigmas,
)
from graphvio.optimization.solver import Residuals
from graphvio.rig import Rig
from graphvio.trajectory import Trajectory

_ORDER = ("imu", "motion", "view", "rest", "walk", "start", "calibration", "loop")


@dataclass(frozen=True, eq=False)
class SessionNumbers:
    """Of one session.

    Attributes:
        name: of it.
        framesets: that have a pose.
        completion: share of those that could have one; None if it is not known.
        states: of the graph.
        duration_s: from the first pose to the last.
        length_m: along the optimised positions.
        accuracy: ATE by stage, or None.
        no_accuracy: why there is none, or empty.
        online: (F, 4, 4) online poses in the optimised frames.
        moved_m: (F,) from the online position to the optimised one.
        moved_deg: (F,) the same of rotations.
        sigma_m: (N,) of the states' positions, all axes together.
        sigma_deg: (N,) of the states' rotations.
        online_sigma_m: (F,) as the odometry told them.
        online_sigma_deg: (F,) as the odometry told them.
    """

    name: str
    framesets: int
    completion: float | None
    states: int
    duration_s: float
    length_m: float
    accuracy: Mapping[str, Accuracy] | None
    no_accuracy: str
    online: Float
    moved_m: Float
    moved_deg: Float
    sigma_m: Float
    sigma_deg: Float
    online_sigma_m: Float
    online_sigma_deg: Float


@dataclass(frozen=True, eq=False)
class Kind:
    """The factors of one kind, before and after; of loop closures, before are those within one epoch."""

    name: str
    before: Residuals
    after: Residuals


@dataclass(frozen=True, eq=False)
class Numbers:
    """Of an optimisation.

    Attributes:
        sessions: in their order.
        parts: their epochs.
        kinds: of factors.
        used: loop closures that are.
        refused: loop closures that are not.
        loop_errors: of the used ones by stage.
        calibrations: what is found of each session's rig file, or None where it was no unknown.
        unknowns: of the solution, all states' dimensions.
    """

    sessions: Sequence[SessionNumbers]
    parts: Sequence[Part]
    kinds: Sequence[Kind]
    used: int
    refused: int
    loop_errors: Mapping[str, Spread]
    calibrations: Sequence[SessionCalibration | None]
    unknowns: int

    @property
    def frames(self) -> int:
        """In which the sessions are."""
        return len({part.frame for part in self.parts})

    @property
    def dimensions(self) -> int:
        """Of all factors in the solution."""
        return sum(kind.after.dimensions for kind in self.kinds)

    @property
    def expected_per_dimension(self) -> float:
        """Mean squared residual over all kinds in the solution, were the noise as assumed: unknowns follow some."""
        return max(1.0 - self.unknowns / self.dimensions, 0.0) if self.dimensions else 0.0

    @property
    def per_dimension(self) -> float:
        """What it is."""
        squares = sum(float(kind.after.distances.sum()) for kind in self.kinds)
        return squares / self.dimensions if self.dimensions else 0.0


def per_dimension(residuals: Residuals) -> Float:
    """Squared Mahalanobis distance of each factor over its dimension; factors of a kind have the same."""
    count = len(residuals.distances)
    return np.asarray(residuals.distances / (residuals.dimensions / count)) if count else np.zeros(0)


def median_sigmas(residuals: Residuals | None) -> float | None:
    """Median error of the factors, standard deviations per dimension: a few that are far off do not move it."""
    values = np.zeros(0) if residuals is None else per_dimension(residuals)
    return float(np.sqrt(np.median(values))) if len(values) else None


def numbers_of(
    found: Optimization,
    truths: Sequence[Trajectory | None],
    rigs: Sequence[Rig | None],
    completions: Sequence[float | None],
) -> Numbers:
    """Compute them.

    Args:
        found: the optimisation.
        truths: of each session, or None.
        rigs: of each session, as its file has it, or None.
        completions: of each session, the share of its framesets that have a pose, or None.

    Raises:
        OptimizationError: if there is not one truth, or None, for each session.
    """
    if len(truths) != len(found.sessions):
        raise OptimizationError(
            f"report: {len(truths)} truths for {len(found.sessions)} sessions; give None for one that has none"
        )
    is_used = np.array([not loop.refusal for loop in found.loops], dtype=bool)
    return Numbers(
        sessions=_sessions(found, truths, completions),
        parts=parts(found),
        kinds=_kinds(found),
        used=int(is_used.sum()),
        refused=int((~is_used).sum()),
        loop_errors={stage: Spread.of(loop_errors(found, stage)[is_used]) for stage in STAGES},
        calibrations=calibrations(found, rigs),
        unknowns=int(found.values.dim()),
    )


def _sessions(
    found: Optimization, truths: Sequence[Trajectory | None], completions: Sequence[float | None]
) -> list[SessionNumbers]:
    made = []
    columns = zip(found.sessions, truths, completions, online_in_frame(found), strict=True)
    for session, truth, completion, online in columns:
        record = session.record
        accuracy, why_not = accuracies_or_why_not(session, truth)
        made.append(
            SessionNumbers(
                record.name,
                len(record.stamps_ns),
                completion,
                len(session.nodes.rows),
                float(record.stamps_ns[-1] - record.stamps_ns[0]) * 1e-9,
                path_length_m(session),
                accuracy,
                why_not,
                online,
                *moved(session, online),
                *sigmas(session.covariance),
                *sigmas(record.covariance),
            )
        )
    return made


def _kinds(found: Optimization) -> list[Kind]:
    nothing = Residuals(np.zeros(0), 0)
    names = [*_ORDER, *sorted({*found.before, *found.after} - {*_ORDER})]
    made = [
        Kind(name, found.before.get(name, nothing), found.after.get(name, nothing))
        for name in names
        if name in found.before or name in found.after
    ]
    distances = loop_distances(found, "smoothed")
    loops = Residuals(distances, 6 * len(distances))
    return [Kind(kind.name, loops, kind.after) if kind.name == "loop" else kind for kind in made]
