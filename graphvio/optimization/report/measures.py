"""What a report tells of an optimisation beyond what the solution holds: errors, lengths, how far it moved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import TrajectoryError
from graphvio.evaluation import evaluate
from graphvio.evaluation.measures import angle_between
from graphvio.geometry import se3_inverse, se3_log
from graphvio.optimization.loops.closures import LoopClosure
from graphvio.optimization.optimize import Optimization, OptimizedSession
from graphvio.trajectory import Trajectory, travelled

STAGES = ("online", "smoothed", "optimized")
"""What is compared: poses as emitted, as the odometry's smoother left them, and as they are now."""


@dataclass(frozen=True)
class Part:
    """An epoch of a session, and the frame that it is in.

    Attributes:
        session: its number.
        epoch: of the session.
        frame: number of the frame.
        framesets: in it.
        begin_s: seconds since the session's first pose.
        end_s: the same, of its last pose.
    """

    session: int
    epoch: int
    frame: int
    framesets: int
    begin_s: float
    end_s: float


@dataclass(frozen=True)
class Accuracy:
    """ATE rmse of one trajectory: metres, and degrees."""

    position_m: float
    rotation_deg: float


@dataclass(frozen=True, eq=False)
class Spread:
    """Errors of several relative poses: rmse, median and largest, metres and degrees; None of none."""

    count: int
    rmse_m: float | None
    median_m: float | None
    max_m: float | None
    rmse_deg: float | None
    median_deg: float | None
    max_deg: float | None

    @staticmethod
    def of(errors: Float) -> Spread:
        """Of errors (L, 2), metres and degrees; rows with NaN are left out."""
        known = errors[np.isfinite(errors).all(axis=1)]
        if not len(known):
            return Spread(0, None, None, None, None, None, None)
        rmse, median, most = np.sqrt((known**2).mean(axis=0)), np.median(known, axis=0), known.max(axis=0)
        metres, degrees = ((float(rmse[k]), float(median[k]), float(most[k])) for k in (0, 1))
        return Spread(len(known), *metres, *degrees)


def seconds(session: OptimizedSession) -> Float:
    """(F,) since the session's first pose."""
    stamps = session.record.stamps_ns
    return np.asarray((stamps - stamps[0]) * 1e-9)


def parts(found: Optimization) -> list[Part]:
    """The epochs of all sessions."""
    made = []
    for fragment, frame in zip(found.fragments, found.frames, strict=True):
        session = found.sessions[fragment.session]
        rows = np.flatnonzero(session.record.epoch == fragment.epoch)
        begin, end = seconds(session)[rows[[0, -1]]].tolist()
        made.append(Part(fragment.session, fragment.epoch, int(frame), len(rows), begin, end))
    return made


def path_length_m(session: OptimizedSession) -> float:
    """Along the optimised positions, within epochs."""
    breaks = np.flatnonzero(np.diff(session.record.epoch)) + 1
    return float(sum(travelled(part)[-1] for part in np.split(session.nav_T_body[:, :3, 3], breaks)))


def online_in_frame(found: Optimization) -> list[Float]:
    """Online poses (F, 4, 4) of each session, in the frames of the optimised ones.

    An epoch that defines its frame is left as it is; another one is laid so that it begins where it begins now.
    """
    made = [session.record.online.copy() for session in found.sessions]
    defined: set[int] = set()
    for fragment, frame in zip(found.fragments, found.frames, strict=True):
        if frame not in defined:
            defined.add(frame)
            continue
        session = found.sessions[fragment.session]
        rows = np.flatnonzero(session.record.epoch == fragment.epoch)
        frame_T_nav = session.nav_T_body[rows[0]] @ se3_inverse(np.ascontiguousarray(session.record.smoothed[rows[0]]))
        made[fragment.session][rows] = frame_T_nav @ session.record.online[rows]
    return made


def moved(session: OptimizedSession, online: Float) -> tuple[Float, Float]:
    """How far the optimised poses are from the online ones (F, 4, 4) of the same frame: metres (F,), degrees (F,)."""
    metres = np.linalg.norm(session.nav_T_body[:, :3, 3] - online[:, :3, 3], axis=1)
    degrees = np.rad2deg(angle_between(online[:, :3, :3], session.nav_T_body[:, :3, :3]))
    return np.asarray(metres), np.asarray(degrees)


def sigmas(covariance: Float) -> tuple[Float, Float]:
    """Standard deviations of poses with covariances (N, 6, 6): metres (N,), degrees (N,), of all three axes together.

    The sum of the three variances does not depend on the axes in which they are told.
    """
    variances = np.maximum(np.einsum("nii->ni", covariance), 0.0)
    return np.sqrt(variances[:, 3:].sum(axis=1)), np.rad2deg(np.sqrt(variances[:, :3].sum(axis=1)))


def accuracies(session: OptimizedSession, truth: Trajectory) -> dict[str, Accuracy]:
    """ATE by stage.

    Raises:
        TrajectoryError: if too few poses have a true one.
    """
    record = session.record
    made = {}
    for stage, poses in zip(STAGES, (record.online, record.smoothed, session.nav_T_body), strict=True):
        evaluation = evaluate(Trajectory(record.stamps_ns, poses), truth)
        made[stage] = Accuracy(evaluation.ate_position_m.rmse, evaluation.ate_rotation_deg.rmse)
    return made


def accuracies_or_why_not(
    session: OptimizedSession, truth: Trajectory | None
) -> tuple[dict[str, Accuracy] | None, str]:
    """ATE by stage, or None and the reason."""
    if truth is None:
        return None, "no ground truth"
    try:
        return accuracies(session, truth), ""
    except TrajectoryError as error:
        return None, str(error)


def loop_errors(found: Optimization, stage: str) -> Float:
    """What each loop closure and the poses of a stage differ by: (L, 2) metres and degrees.

    NaN where the two poses are in no common frame: before the optimisation, those of two epochs or sessions.
    """
    made = np.full((len(found.loops), 2), np.nan)
    for number, loop in enumerate(found.loops):
        error = _difference(found, loop.closure, stage)
        if error is not None:
            turned = angle_between(np.eye(3)[None], error[None, :3, :3])[0]
            made[number] = np.linalg.norm(error[:3, 3]), np.rad2deg(turned)
    return made


def loop_distances(found: Optimization, stage: str) -> Float:
    """Squared Mahalanobis distances (U,) of the used loop closures from the poses of a stage.

    Those whose two poses are in no common frame are left out.
    """
    made = []
    for loop in found.loops:
        error = None if loop.refusal else _difference(found, loop.closure, stage)
        if error is not None:
            tangent = se3_log(se3_inverse(error))
            made.append(float(tangent @ np.linalg.solve(loop.closure.covariance, tangent)))
    return np.array(made)


def _difference(found: Optimization, closure: LoopClosure, stage: str) -> Float | None:
    """Current place's body (4, 4) by a stage's poses, seen from where the closure puts it; None in no common frame."""
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
