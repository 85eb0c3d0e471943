"""The measures that `graphvio.evaluation` is made of: alignment, statistics, errors of relative motions."""

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
        """Of errors (N,), N at least 1."""
        return Stats(
            rmse=float(np.sqrt(np.mean(errors**2))),
            mean=float(errors.mean()),
            median=float(np.median(errors)),
            max=float(errors.max()),
        )


@dataclass(frozen=True)
class RelativeError:
    """Error of the motion over one distance.

    Attributes:
        pairs: number of motions compared.
        position_m: metres.
        rotation_deg: degrees.
        percent: mean position error in percent of the distance walked; None for a distance in time.
        deg_per_m: mean rotation error by distance walked; None for a distance in time.
    """

    pairs: int
    position_m: Stats
    rotation_deg: Stats
    percent: float | None
    deg_per_m: float | None


def umeyama_se3(source: Float, target: Float) -> Float:
    """Least-squares ``target_T_source`` (4, 4), without scale, of corresponding points (N, 3).

    Points on one line leave the turn around it undefined: see `align`.
    Reference: S. Umeyama, *Least-squares estimation of transformation parameters between two point patterns*,
    PAMI 13(4), 1991.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    rotation = _nearest_rotation((target - target_mean).T @ (source - source_mean))
    return np.asarray(se3(rotation, target_mean - rotation @ source_mean))


def align(estimate: Trajectory, truth: Trajectory) -> Float:
    """``truth_T_nav`` (4, 4) by Umeyama's method over poses of equal stamps.

    Where truth stays within a centimetre of one line, positions do not define a rotation: the rotations then
    help, as in `align_with_rotations`.
    """
    centred = truth.positions - truth.positions.mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(truth))
    if spread[1] < _MIN_SPREAD_M:
        return align_with_rotations(estimate, truth)
    return umeyama_se3(estimate.positions, truth.positions)


def align_with_rotations(estimate: Trajectory, truth: Trajectory) -> Float:
    """``truth_T_nav`` (4, 4) by positions and rotations of poses of equal stamps.

    A rotation counts like points 1 m along the body's axes, so that the result is defined even at rest.
    """
    p, q = estimate.positions, truth.positions
    p_mean, q_mean = p.mean(axis=0), q.mean(axis=0)
    spread = (q - q_mean).T @ (p - p_mean)
    turn = np.einsum("nij,nkj->ik", truth.rotations, estimate.rotations)
    rotation = _nearest_rotation(spread + _LEVER_M**2 * turn)
    return np.asarray(se3(rotation, q_mean - rotation @ p_mean))


def _nearest_rotation(correlation: Float) -> Float:
    """Rotation R (3, 3) with the greatest trace(R^T C)."""
    u, _, vt = np.linalg.svd(correlation)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    return np.ascontiguousarray((u * sign) @ vt)


def angle_between(first: Float, second: Float) -> Float:
    """Angles (N,) between rotations (N, 3, 3), radians; precise near zero, where the trace is not."""
    chord = np.linalg.norm(first - second, axis=(1, 2))
    return np.asarray(2.0 * np.arcsin(np.minimum(chord / np.sqrt(8.0), 1.0)))


def relative_errors(estimate: Trajectory, truth: Trajectory) -> tuple[dict[str, RelativeError], Float]:
    """RPE by distance, and (percent, degrees per metre) of all of KITTI's segments (N, 2)."""
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
        walked = distances[pairs[:, 1]] - distances[pairs[:, 0]]
        percent, deg_per_m = 100.0 * position / walked, rotation / walked
        errors[f"{length:g} m"] = RelativeError(
            len(position), Stats.of(position), Stats.of(rotation), float(percent.mean()), float(deg_per_m.mean())
        )
        if length in KITTI_METRES:
            kitti.append(np.column_stack([percent, deg_per_m]))
    return errors, np.concatenate(kitti)


def _pairs(along: Float, length: float) -> Int:
    """Indices (N, 2) of poses ``length`` apart on an increasing measure (M,): one pair for each beginning."""
    goal = along + length
    after = np.clip(np.searchsorted(along, goal), 1, len(along) - 1)
    nearest = np.where(goal - along[after - 1] <= along[after] - goal, after - 1, after)
    nearest = np.searchsorted(along, along[nearest])  # of poses at one place, the first
    begin = np.arange(len(along))
    good = (nearest > begin) & (np.abs(along[nearest] - goal) <= _RPE_TOLERANCE * length)
    return np.column_stack([begin[good], nearest[good]])


def _motion_errors(estimate: Trajectory, truth: Trajectory, pairs: Int) -> tuple[Float, Float]:
    """Metres (N,) and degrees (N,) by which the motions of pairs (N, 2) differ."""
    if not len(pairs):
        return np.empty(0), np.empty(0)
    began, ended = pairs[:, 0], pairs[:, 1]

    def motion(trajectory: Trajectory) -> tuple[Float, Float]:
        to_body = trajectory.rotations[began].transpose(0, 2, 1)
        step = trajectory.positions[ended] - trajectory.positions[began]
        return (to_body @ step[:, :, None])[:, :, 0], to_body @ trajectory.rotations[ended]

    (step, turn), (true_step, true_turn) = motion(estimate), motion(truth)
    return np.linalg.norm(step - true_step, axis=1), np.rad2deg(angle_between(true_turn, turn))
