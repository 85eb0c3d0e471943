"""Alignment of trajectories, statistics of errors, and errors of relative motions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.geometry import se3
from graphvio.trajectory import Trajectory

RPE_SECONDS = (1.0,)
RPE_METRES = (1.0, 5.0, 10.0, 20.0)
KITTI_METRES = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
_RPE_TOLERANCE = 0.1
_LEVER_M = 1.0
_MIN_SPREAD_M = 0.01
_NS_PER_S = 1e9


@dataclass(frozen=True)
class Stats:
    """Summary of a list of errors, in the unit of the errors."""

    rmse: float
    mean: float
    median: float
    max: float

    @staticmethod
    def of(errors: Float) -> Stats:
        """Compute the statistics of errors (N,), N at least 1."""
        return Stats(
            rmse=float(np.sqrt(np.mean(errors**2))),
            mean=float(errors.mean()),
            median=float(np.median(errors)),
            max=float(errors.max()),
        )


@dataclass(frozen=True)
class RelativeError:
    """Relative pose error (RPE) over one distance or duration."""

    pairs: int  # number of motions
    position_m: Stats  # metres
    rotation_deg: Stats  # degrees
    percent: float | None  # mean position error in percent of the distance; None for a duration
    deg_per_m: float | None  # mean rotation error per distance; None for a duration


def umeyama_se3(source: Float, target: Float) -> Float:
    """Compute least-squares ``target_T_source`` (4, 4), without scale, of corresponding points (N, 3).

    If all points lie on one line, the rotation about it is undefined: see `align`.
    Reference: S. Umeyama, *Least-squares estimation of transformation parameters between two point patterns*,
    PAMI 13(4), 1991.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    rotation = _nearest_rotation((target - target_mean).T @ (source - source_mean))
    return np.asarray(se3(rotation, target_mean - rotation @ source_mean))


def align(estimate: Trajectory, truth: Trajectory) -> Float:
    """Compute ``truth_T_nav`` (4, 4) by Umeyama's method from poses of equal stamps.

    If the truth deviates from one line by less than 1 cm (rms), the positions do not define a rotation, and
    `align_with_rotations` is used.
    """
    centred = truth.positions - truth.positions.mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(truth))
    if spread[1] < _MIN_SPREAD_M:
        return align_with_rotations(estimate, truth)
    return umeyama_se3(estimate.positions, truth.positions)


def align_with_rotations(estimate: Trajectory, truth: Trajectory) -> Float:
    """Compute ``truth_T_nav`` (4, 4) from positions and rotations of poses of equal stamps.

    A pose's rotation counts like points 1 m along the body's axes, so that the result is defined at standstill, too.
    """
    p, q = estimate.positions, truth.positions
    p_mean, q_mean = p.mean(axis=0), q.mean(axis=0)
    spread = (q - q_mean).T @ (p - p_mean)
    rotations = np.einsum("nij,nkj->ik", truth.rotations, estimate.rotations)
    rotation = _nearest_rotation(spread + _LEVER_M**2 * rotations)
    return np.asarray(se3(rotation, q_mean - rotation @ p_mean))


def align_scale(aligned: Float, truth: Float) -> tuple[float, float] | tuple[None, None]:
    """Compute the scale of Umeyama's Sim(3) alignment, which has the same rotation as the alignment without scale.

    Args:
        aligned: (N, 3) estimated positions after the alignment without scale.
        truth: (N, 3) true positions.

    Returns:
        By how much the estimate's lengths are too long, in percent, and the rmse of positions in metres after alignment
        with the scale; None for both if the estimate stays at one place, or its scale would be negative.
    """
    from_mean, true_from_mean = aligned - aligned.mean(axis=0), truth - truth.mean(axis=0)
    along = float((from_mean * true_from_mean).sum())
    if along <= 0.0:
        return None, None
    scale = along / float((from_mean**2).sum())
    left = scale * from_mean - true_from_mean
    return 100.0 * (1.0 / scale - 1.0), float(np.sqrt((left**2).sum(axis=1).mean()))


def _nearest_rotation(correlation: Float) -> Float:
    """Return the rotation R (3, 3) that maximises trace(R^T C) for a matrix C (3, 3)."""
    u, _, vt = np.linalg.svd(correlation)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    return np.ascontiguousarray((u * sign) @ vt)


def angle_between(first: Float, second: Float) -> Float:
    """Compute angles (N,) between rotations (N, 3, 3), radians; unlike angles from the trace, precise near zero."""
    chord = np.linalg.norm(first - second, axis=(1, 2))
    return np.asarray(2.0 * np.arcsin(np.minimum(chord / np.sqrt(8.0), 1.0)))


def relative_errors(estimate: Trajectory, truth: Trajectory) -> tuple[dict[str, RelativeError], Float]:
    """Compute relative errors of poses with equal stamps.

    Returns:
        RPE by the name of the distance or duration, and errors (M, 2) of KITTI's segments: position error in percent,
        and rotation error in degrees per metre.
    """
    seconds = (truth.stamps_ns - truth.stamps_ns[0]) / _NS_PER_S
    distances = truth.distances
    errors: dict[str, RelativeError] = {}
    kitti = [np.empty((0, 2))]
    for length in RPE_SECONDS:
        pairs = _pairs(seconds, length)
        pairs = pairs[seconds[pairs[:, 0]] + length <= seconds[-1] + 1e-6]
        position, rotation = _motion_errors(estimate, truth, pairs)
        if len(position):
            errors[f"{length:g} s"] = RelativeError(len(position), Stats.of(position), Stats.of(rotation), None, None)
    for length in (m for m in RPE_METRES + KITTI_METRES if m <= distances[-1]):
        pairs = _pairs(distances, length)
        position, rotation = _motion_errors(estimate, truth, pairs)
        if not len(position):
            continue
        travelled_m = distances[pairs[:, 1]] - distances[pairs[:, 0]]
        percent, deg_per_m = 100.0 * position / travelled_m, rotation / travelled_m
        errors[f"{length:g} m"] = RelativeError(
            len(position), Stats.of(position), Stats.of(rotation), float(percent.mean()), float(deg_per_m.mean())
        )
        if length in KITTI_METRES:
            kitti.append(np.column_stack([percent, deg_per_m]))
    return errors, np.concatenate(kitti)


def _pairs(along: Float, length: float) -> Int:
    """Return indices (N, 2) of poses that are ``length`` apart along an increasing measure (M,), one per first pose."""
    goal = along + length
    after = np.clip(np.searchsorted(along, goal), 1, len(along) - 1)
    nearest = np.where(goal - along[after - 1] <= along[after] - goal, after - 1, after)
    nearest = np.searchsorted(along, along[nearest])  # the first of those at the same position
    begin = np.arange(len(along))
    good = (nearest > begin) & (np.abs(along[nearest] - goal) <= _RPE_TOLERANCE * length)
    return np.column_stack([begin[good], nearest[good]])


def _motion_errors(estimate: Trajectory, truth: Trajectory, pairs: Int) -> tuple[Float, Float]:
    """Compute the errors of the motions between poses with indices (N, 2): metres (N,) and degrees (N,)."""
    if not len(pairs):
        return np.empty(0), np.empty(0)
    first, last = pairs[:, 0], pairs[:, 1]

    def motion(trajectory: Trajectory) -> tuple[Float, Float]:
        to_body = trajectory.rotations[first].transpose(0, 2, 1)
        step = trajectory.positions[last] - trajectory.positions[first]
        return (to_body @ step[:, :, None])[:, :, 0], to_body @ trajectory.rotations[last]

    (step, turn), (true_step, true_turn) = motion(estimate), motion(truth)
    return np.linalg.norm(step - true_step, axis=1), np.rad2deg(angle_between(true_turn, turn))
