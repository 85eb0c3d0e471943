"""The numbers of an optimisation's report, computed once for page, figures and summary."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import OptimizationError, RigError, TrajectoryError
from graphvio.evaluation import evaluate
from graphvio.evaluation.measures import angle_between
from graphvio.geometry import se3_inverse, se3_log
from graphvio.optimization.loops.closures import LoopClosure
from graphvio.optimization.optimize import Optimization, OptimizedSession
from graphvio.optimization.report.calibration import SessionCalibration, calibrations
from graphvio.optimization.session_calibration import session_findings
from graphvio.optimization.solver import Residuals
from graphvio.rig import Rig
from graphvio.rig_files import load_rig
from graphvio.trajectory import Trajectory, travelled

STAGES = ("online", "smoothed", "optimized")
"""Compared poses: as emitted, as the odometry's smoother left them, and optimised."""

_KINDS = ("imu", "motion", "view", "zero_velocity", "walk", "start", "calibration", "loop")  # in the report's order


@dataclass(frozen=True)
class Part:
    """An epoch of a session, and the frame that it is in."""

    session: int  # number of the session
    epoch: int  # number of the epoch in the session
    frame: int  # number of the frame
    framesets: int  # number of framesets with a pose in the epoch
    begin_s: float  # time of its first pose, in seconds since the session's first pose
    end_s: float  # time of its last pose, likewise


@dataclass(frozen=True)
class Accuracy:
    """ATE rmse of a trajectory, in metres and degrees."""

    position_m: float
    rotation_deg: float


@dataclass(frozen=True, eq=False)
class Spread:
    """Statistics of relative-pose errors, in metres and degrees; None if there are no errors."""

    count: int
    rmse_m: float | None
    median_m: float | None
    max_m: float | None
    rmse_deg: float | None
    median_deg: float | None
    max_deg: float | None

    @staticmethod
    def of(errors: Float) -> Spread:
        """Summarise errors (L, 2) in metres and degrees, without rows that hold NaN."""
        known = errors[np.isfinite(errors).all(axis=1)]
        if not len(known):
            return Spread(0, None, None, None, None, None, None)
        rmse, median, largest = np.sqrt((known**2).mean(axis=0)), np.median(known, axis=0), known.max(axis=0)
        metres, degrees = ((float(rmse[k]), float(median[k]), float(largest[k])) for k in (0, 1))
        return Spread(len(known), *metres, *degrees)


@dataclass(frozen=True, eq=False)
class SessionNumbers:
    """Numbers of one session."""

    name: str  # name of the session
    framesets: int  # number of framesets with a pose
    completion: float | None  # their share of the framesets that could have one; None if unknown
    states: int  # number of states in the graph
    duration_s: float  # time from the first pose to the last
    length_m: float  # length of the path along the optimised positions
    accuracy: Mapping[str, Accuracy] | None  # ATE by stage, or None
    no_accuracy: str  # why there is no ATE, or empty
    calibration: Sequence[str]  # sentences on what was found before the odometry; empty if it was not calibrated
    online: Float  # (F, 4, 4) online poses in the optimised frames
    moved_m: Float  # (F,) distance between online and optimised positions
    moved_deg: Float  # (F,) angle between online and optimised rotations
    sigma_m: Float  # (N,) standard deviations of the states' positions, all axes combined
    sigma_deg: Float  # (N,) standard deviations of the states' rotations, all axes combined
    online_sigma_m: Float  # (F,) those of the online positions
    online_sigma_deg: Float  # (F,) those of the online rotations


@dataclass(frozen=True, eq=False)
class Kind:
    """Residuals of one kind of factor before and after; before, of loop closures only those within an epoch."""

    name: str
    before: Residuals
    after: Residuals


@dataclass(frozen=True, eq=False)
class Numbers:
    """Numbers of an optimisation."""

    sessions: Sequence[SessionNumbers]  # in the order of the optimisation
    parts: Sequence[Part]  # epochs of all sessions
    kinds: Sequence[Kind]  # residuals by kind of factor
    used: int  # number of loop closures that are used
    refused: int  # number of loop closures that are refused
    loop_errors: Mapping[str, Spread]  # errors of the used loop closures, by stage
    calibrations: Sequence[SessionCalibration | None]  # of each session; None where it was not estimated
    unknowns: int  # dimension of the solution

    @property
    def frames(self) -> int:
        """Number of frames that the sessions are in."""
        return len({part.frame for part in self.parts})

    @property
    def dimensions(self) -> int:
        """Dimension of all factors of the solution."""
        return sum(kind.after.dimensions for kind in self.kinds)

    @property
    def expected_per_dimension(self) -> float:
        """Expected mean squared residual if the noise is as assumed; each fitted unknown lowers it."""
        return max(1.0 - self.unknowns / self.dimensions, 0.0) if self.dimensions else 0.0

    @property
    def per_dimension(self) -> float:
        """Mean squared residual over all factors of the solution."""
        squares = sum(float(kind.after.distances.sum()) for kind in self.kinds)
        return squares / self.dimensions if self.dimensions else 0.0


def per_dimension(residuals: Residuals) -> Float:
    """Compute each factor's squared Mahalanobis distance per dimension; factors of a kind have equal dimensions."""
    count = len(residuals.distances)
    return np.asarray(residuals.distances / (residuals.dimensions / count)) if count else np.zeros(0)


def median_sigmas(residuals: Residuals | None) -> float | None:
    """Compute the factors' median error in standard deviations per dimension, which outliers do not move."""
    values = np.zeros(0) if residuals is None else per_dimension(residuals)
    return float(np.sqrt(np.median(values))) if len(values) else None


def numbers_of(found: Optimization, truths: Sequence[Trajectory | None], folder: Path) -> Numbers:
    """Compute all numbers of a report, with the odometry's results in ``folder/NAME/odometry`` if they are there."""
    if len(truths) != len(found.sessions):
        raise OptimizationError(
            f"report: {len(truths)} truths for {len(found.sessions)} sessions; give None for one that has none"
        )
    is_used = np.array([not loop.refusal for loop in found.loops], dtype=bool)
    return Numbers(
        sessions=[
            _session_numbers(session, truth, folder, online)
            for session, truth, online in zip(found.sessions, truths, _online_in_frame(found), strict=True)
        ],
        parts=_parts(found),
        kinds=_kinds(found),
        used=int(is_used.sum()),
        refused=int((~is_used).sum()),
        loop_errors={stage: Spread.of(loop_errors(found, stage)[is_used]) for stage in STAGES},
        calibrations=calibrations(found, [rig_of(folder, session.record.name) for session in found.sessions]),
        unknowns=int(found.values.dim()),
    )


def completion(folder: Path, session: str) -> float | None:
    """Read a session's share of framesets with a pose from the odometry's summary; None if it cannot be read."""
    try:
        summary = json.loads((folder / session / "odometry" / "summary.json").read_text(encoding="utf-8"))
        return float(summary["completion"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def rig_of(folder: Path, session: str) -> Rig | None:
    """Read the rig file that a session's odometry used; None if it cannot be read."""
    try:
        return load_rig(folder / session / "odometry" / "rig.yaml")
    except RigError:
        return None


def seconds(session: OptimizedSession) -> Float:
    """Compute the times (F,) of a session's poses since the first, in seconds."""
    stamps = session.record.stamps_ns
    return np.asarray((stamps - stamps[0]) * 1e-9)


def loop_errors(found: Optimization, stage: str) -> Float:
    """Compute by how much each loop closure differs from the poses of a stage: (L, 2) in metres and degrees.

    NaN where the poses share no frame: before the optimisation, those of different epochs or sessions.
    """
    errors = np.full((len(found.loops), 2), np.nan)
    for number, loop in enumerate(found.loops):
        error = _loop_error(found, loop.closure, stage)
        if error is not None:
            angle = angle_between(np.eye(3)[None], error[None, :3, :3])[0]
            errors[number] = np.linalg.norm(error[:3, 3]), np.rad2deg(angle)
    return errors


def _session_numbers(
    session: OptimizedSession, truth: Trajectory | None, folder: Path, online: Float
) -> SessionNumbers:
    record = session.record
    accuracy, no_accuracy = _accuracy(session, truth)
    breaks = np.flatnonzero(np.diff(record.epoch)) + 1
    moved_m = np.linalg.norm(session.nav_T_body[:, :3, 3] - online[:, :3, 3], axis=1)
    moved_deg = np.rad2deg(angle_between(online[:, :3, :3], session.nav_T_body[:, :3, :3]))
    return SessionNumbers(
        record.name,
        len(record.stamps_ns),
        completion(folder, record.name),
        len(session.nodes.rows),
        float(record.stamps_ns[-1] - record.stamps_ns[0]) * 1e-9,
        float(sum(travelled(part)[-1] for part in np.split(session.nav_T_body[:, :3, 3], breaks))),
        accuracy,
        no_accuracy,
        session_findings(folder / record.name),
        online,
        np.asarray(moved_m),
        np.asarray(moved_deg),
        *_sigmas(session.covariance),
        *_sigmas(record.covariance),
    )


def _accuracy(session: OptimizedSession, truth: Trajectory | None) -> tuple[dict[str, Accuracy] | None, str]:
    """Compute the ATE by stage and an empty text; or return None and the reason."""
    if truth is None:
        return None, "no ground truth"
    accuracy = {}
    try:
        for stage in STAGES:
            evaluation = evaluate(Trajectory(session.record.stamps_ns, _poses(session, stage)), truth)
            accuracy[stage] = Accuracy(evaluation.ate_position_m.rmse, evaluation.ate_rotation_deg.rmse)
    except TrajectoryError as error:
        return None, str(error)
    return accuracy, ""


def _sigmas(covariance: Float) -> tuple[Float, Float]:
    """Compute the roots of the traces of position and rotation covariances: metres (N,), degrees (N,)."""
    variances = np.maximum(np.einsum("nii->ni", covariance), 0.0)
    return np.sqrt(variances[:, 3:].sum(axis=1)), np.rad2deg(np.sqrt(variances[:, :3].sum(axis=1)))


def _parts(found: Optimization) -> list[Part]:
    parts = []
    for fragment, frame in zip(found.fragments, found.frames, strict=True):
        session = found.sessions[fragment.session]
        rows = np.flatnonzero(session.record.epoch == fragment.epoch)
        begin, end = seconds(session)[rows[[0, -1]]].tolist()
        parts.append(Part(fragment.session, fragment.epoch, int(frame), len(rows), begin, end))
    return parts


def _online_in_frame(found: Optimization) -> list[Float]:
    """Transform the online poses (F, 4, 4) of each session into the frames of the optimised ones.

    An epoch that defines its frame stays as it is; another one is aligned at its first pose.
    """
    online = [session.record.online.copy() for session in found.sessions]
    defined: set[int] = set()
    for fragment, frame in zip(found.fragments, found.frames, strict=True):
        if frame not in defined:
            defined.add(frame)
            continue
        session = found.sessions[fragment.session]
        rows = np.flatnonzero(session.record.epoch == fragment.epoch)
        frame_T_nav = session.nav_T_body[rows[0]] @ se3_inverse(np.ascontiguousarray(session.record.smoothed[rows[0]]))
        online[fragment.session][rows] = frame_T_nav @ session.record.online[rows]
    return online


def _kinds(found: Optimization) -> list[Kind]:
    none = Residuals(np.zeros(0), 0)
    kinds = []
    for name in (*_KINDS, *sorted({*found.before, *found.after} - {*_KINDS})):
        if name in found.before or name in found.after:
            before = _loop_residuals(found) if name == "loop" else found.before.get(name, none)
            kinds.append(Kind(name, before, found.after.get(name, none)))
    return kinds


def _loop_residuals(found: Optimization) -> Residuals:
    """Compute the residuals of the used loop closures within an epoch, for the smoothed poses."""
    distances = []
    for loop in found.loops:
        error = None if loop.refusal else _loop_error(found, loop.closure, "smoothed")
        if error is not None:
            tangent = se3_log(se3_inverse(error))
            distances.append(float(tangent @ np.linalg.solve(loop.closure.covariance, tangent)))
    return Residuals(np.array(distances), 6 * len(distances))


def _loop_error(found: Optimization, closure: LoopClosure, stage: str) -> Float | None:
    """Compute a closure's error ``measured_T_current`` (4, 4) from a stage's poses; None if these share no frame."""
    first, second = closure.reference, closure.current
    one, other = found.sessions[first.session], found.sessions[second.session]
    if stage == "optimized":
        is_common = bool(one.frame[first.row] == other.frame[second.row])
    else:
        is_common = one is other and bool(one.record.epoch[first.row] == one.record.epoch[second.row])
    if not is_common:
        return None
    reference = np.ascontiguousarray(_poses(one, stage)[first.row])
    current = _poses(other, stage)[second.row]
    return np.asarray(se3_inverse(closure.reference_T_current) @ se3_inverse(reference) @ current)


def _poses(session: OptimizedSession, stage: str) -> Float:
    record = session.record
    return {"online": record.online, "smoothed": record.smoothed, "optimized": session.nav_T_body}[stage]
