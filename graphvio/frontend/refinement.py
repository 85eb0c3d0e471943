"""Iterative refinement of a motion on the points of all pairs, and its covariance (section 3, 3.1, 5).

Levenberg-Marquardt minimises the Cauchy cost of whitened reprojection errors. A point's error in both images is one
vector of four, whose covariance is that of the pixels plus that of the triangulated point as it is seen from here,
``S = sigma^2 (1 + J_X C_X J_X^T)``: near points, whose depth is known well, count for more.
"""

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.config import MotionConfig
from graphvio.frontend.cost import left_motions
from graphvio.frontend.observations import Observations, RigArrays
from graphvio.geometry import se3_exp
from graphvio.kernels import kernel

_ROUNDS = 3
_STEPS_PER_ROUND = 6
_CONVERGED = 1e-7
_MIN_VARIANCE_FACTOR = 0.05
_WEAK_DIRECTION_SIGMA = 10.0


@dataclass(frozen=True, eq=False)
class Refined:
    """A refined motion.

    Attributes:
        cur_T_ref: (4, 4) of body.
        covariance: (6, 6), tangent ``[rotation, translation]`` in the body frame at the current instant.
        inlier: (N,) the points that it explains.
        cost: its final robust cost.
    """

    cur_T_ref: Float
    covariance: Float
    inlier: Bool
    cost: float


def refine(rig: RigArrays, observations: Observations, cur_T_ref: Float, config: MotionConfig) -> Refined:
    """Minimise the robust cost from a start (4, 4); directions that no point constrains get a large variance."""
    sigma = config.pixel_sigma_px
    scale = config.cauchy_scale_px / sigma
    pose, hessian, errors2, cost = _levenberg_marquardt(cur_T_ref, rig, observations, sigma, scale)
    inlier = errors2 < (config.max_error_px / sigma) ** 2
    # Backward propagation of the reprojection covariance: the inverse of the robustly weighted normal matrix,
    # scaled by what the residuals say of the noise. The small prior keeps unconstrained directions finite.
    covariance = np.linalg.inv(hessian + np.eye(6) / _WEAK_DIRECTION_SIGMA**2)
    covariance *= config.sigma_inflation**2 * _variance_factor(errors2[inlier], scale, observations.has_right[inlier])
    return Refined(pose, 0.5 * (covariance + covariance.T), inlier, cost)


def explained(rig: RigArrays, observations: Observations, cur_T_ref: Float, config: MotionConfig) -> Bool:
    """The points (N,) that a motion (4, 4) explains to within ``max_error_px``, their own uncertainty allowed for."""
    errors2 = _squared_errors(cur_T_ref, rig, observations, config.pixel_sigma_px)
    return np.asarray(errors2 < (config.max_error_px / config.pixel_sigma_px) ** 2)


def _variance_factor(errors2: Float, scale: float, has_right: Bool) -> float:
    """How much larger the inliers' weighted squared errors are than the noise model says."""
    weights = 1.0 / (1.0 + errors2 / scale**2)
    dimensions = float(np.sum(weights * np.where(has_right, 4.0, 2.0))) - 6.0
    if dimensions <= 0.0:
        return 1.0
    return max(float(np.sum(weights * errors2)) / dimensions, _MIN_VARIANCE_FACTOR)


@kernel
def _squared_errors(cur_T_ref: Float, rig: RigArrays, observations: Observations, sigma: float) -> Float:
    """Whitened squared errors (N,)."""
    motions = left_motions(cur_T_ref, rig)
    errors2 = np.empty(len(observations.pair))
    _linearise(
        motions, rig, observations, _whiteners(motions, rig, observations, sigma), 1.0,
        np.empty((6, 6)), np.empty(6), errors2,
    )  # fmt: skip
    return errors2


@kernel
def _levenberg_marquardt(
    cur_T_ref: Float, rig: RigArrays, observations: Observations, sigma: float, scale: float
) -> tuple[Float, Float, Float, float]:
    """Pose, normal matrix (6, 6), whitened squared errors (N,) and cost at the minimum."""
    pose = cur_T_ref.copy()
    n = len(observations.pair)
    hessian, gradient, errors2 = np.zeros((6, 6)), np.zeros(6), np.empty(n)
    cost = 0.0
    for _ in range(_ROUNDS):
        motions = left_motions(pose, rig)
        whiteners = _whiteners(motions, rig, observations, sigma)
        cost = _linearise(motions, rig, observations, whiteners, scale, hessian, gradient, errors2)
        damping = 1e-6
        moved = 0.0
        for _ in range(_STEPS_PER_ROUND):
            damped = hessian.copy()
            for k in range(6):
                damped[k, k] += damping * hessian[k, k] + 1e-9
            step = np.linalg.solve(damped, gradient)
            candidate = se3_exp(step) @ pose  # type: ignore[arg-type]
            new_hessian, new_gradient, new_errors2 = np.zeros((6, 6)), np.zeros(6), np.empty(n)
            new_cost = _linearise(
                left_motions(candidate, rig), rig, observations, whiteners, scale,
                new_hessian, new_gradient, new_errors2,
            )  # fmt: skip
            size = np.max(np.abs(step))
            if new_cost <= cost:
                pose, cost = candidate, new_cost
                hessian, gradient, errors2 = new_hessian, new_gradient, new_errors2
                damping *= 0.1
                moved = max(moved, size)
            else:
                damping = max(damping * 10.0, 1e-4)
            if size < _CONVERGED:
                break
        if moved < 1e-4:
            break  # the weights S would not change any more
    return pose, hessian, errors2, cost


@kernel
def _whiteners(motions: Float, rig: RigArrays, observations: Observations, sigma: float) -> Float:
    """Inverse Cholesky factors (N, 4, 4) of the covariances S of the points' errors in both images, pixels."""
    whiteners = np.empty((len(observations.pair), 4, 4))
    for i in range(len(observations.pair)):
        j = observations.pair[i]
        _whitener(motions[j], observations.points[i], observations.covariances[i], rig.focal_px[j], sigma, whiteners[i])
    return whiteners


@kernel
def _whitener(motions: Float, point: Float, covariance: Float, focal_px: Float, sigma: float, inverse_l: Float) -> None:
    """Fill one point's inverse Cholesky factor (4, 4)."""
    jacobian = np.zeros((4, 3))
    for side in range(2):
        m = motions[side]
        a, b, w = point[0], point[1], point[2]
        z = max(m[2, 0] * a + m[2, 1] * b + m[2, 2] + w * m[2, 3], 1e-3)
        u = (m[0, 0] * a + m[0, 1] * b + m[0, 2] + w * m[0, 3]) / z
        v = (m[1, 0] * a + m[1, 1] * b + m[1, 2] + w * m[1, 3]) / z
        for c in range(3):
            k = c if c < 2 else 3
            jacobian[2 * side, c] = focal_px[side] * (m[0, k] - u * m[2, k]) / z
            jacobian[2 * side + 1, c] = focal_px[side] * (m[1, k] - v * m[2, k]) / z
    s = np.empty((4, 4))
    for i in range(4):
        for j in range(i + 1):
            total = 1.0 if i == j else 0.0
            for c in range(3):
                for d in range(3):
                    total += jacobian[i, c] * covariance[c, d] * jacobian[j, d]
            s[i, j] = sigma * sigma * total
    lower = np.zeros((4, 4))
    for i in range(4):
        for j in range(i + 1):
            total = s[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = np.sqrt(total) if i == j else total / lower[j, j]
    inverse_l[:] = 0.0
    for j in range(4):
        inverse_l[j, j] = 1.0 / lower[j, j]
        for i in range(j + 1, 4):
            total = 0.0
            for k in range(j, i):
                total -= lower[i, k] * inverse_l[k, j]
            inverse_l[i, j] = total / lower[i, i]


@kernel
def _linearise(
    motions: Float,
    rig: RigArrays,
    observations: Observations,
    whiteners: Float,
    scale: float,
    hessian: Float,
    gradient: Float,
    errors2: Float,
) -> float:
    """Fill the normal equations for a perturbation ``exp(d) cur_T_ref`` and return the robust cost."""
    hessian[:] = 0.0
    gradient[:] = 0.0
    cost = 0.0
    residual = np.empty(4)
    jacobian = np.empty((4, 6))
    white = np.empty(4)
    white_jacobian = np.empty((4, 6))
    inverse_scale2 = 1.0 / (scale * scale)
    focal_px = rig.focal_px
    for i in range(len(observations.pair)):
        j = observations.pair[i]
        a, b, w = observations.points[i]
        behind = False
        rows = 4 if observations.has_right[i] else 2
        for side in range(rows // 2):
            m = motions[j, side]
            x = m[0, 0] * a + m[0, 1] * b + m[0, 2] + w * m[0, 3]
            y = m[1, 0] * a + m[1, 1] * b + m[1, 2] + w * m[1, 3]
            z = m[2, 0] * a + m[2, 1] * b + m[2, 2] + w * m[2, 3]
            if z < 1e-3:
                behind = True
                break
            u, v = x / z, y / z
            seen = observations.left[i] if side == 0 else observations.right[i]
            residual[2 * side] = focal_px[j, side] * (seen[0] - u)
            residual[2 * side + 1] = focal_px[j, side] * (seen[1] - v)
            # d cam point = R_cam_body (-[p]x d_rotation + w d_translation), p the homogeneous point in body now
            r = rig.cam_T_body[j, side]
            qx, qy, qz = x - w * r[0, 3], y - w * r[1, 3], z - w * r[2, 3]
            px = r[0, 0] * qx + r[1, 0] * qy + r[2, 0] * qz
            py = r[0, 1] * qx + r[1, 1] * qy + r[2, 1] * qz
            pz = r[0, 2] * qx + r[1, 2] * qy + r[2, 2] * qz
            for k in range(2):
                at = u if k == 0 else v
                g0 = focal_px[j, side] * (r[k, 0] - at * r[2, 0]) / z
                g1 = focal_px[j, side] * (r[k, 1] - at * r[2, 1]) / z
                g2 = focal_px[j, side] * (r[k, 2] - at * r[2, 2]) / z
                row = 2 * side + k
                jacobian[row, 0] = -g1 * pz + g2 * py
                jacobian[row, 1] = g0 * pz - g2 * px
                jacobian[row, 2] = -g0 * py + g1 * px
                jacobian[row, 3], jacobian[row, 4], jacobian[row, 5] = w * g0, w * g1, w * g2
        if behind:
            errors2[i] = np.inf
            cost += np.log1p(1e6)
            continue
        e2 = 0.0
        for p in range(rows):
            total = 0.0
            for q in range(p + 1):
                total += whiteners[i, p, q] * residual[q]
            white[p] = total
            e2 += total * total
            for c in range(6):
                value = 0.0
                for q in range(p + 1):
                    value += whiteners[i, p, q] * jacobian[q, c]
                white_jacobian[p, c] = value
        errors2[i] = e2
        cost += np.log1p(e2 * inverse_scale2)
        weight = 1.0 / (1.0 + e2 * inverse_scale2)
        for p in range(rows):
            for c in range(6):
                gradient[c] += weight * white_jacobian[p, c] * white[p]
                for d in range(c + 1):
                    hessian[c, d] += weight * white_jacobian[p, c] * white_jacobian[p, d]
    for c in range(6):
        for d in range(c):
            hessian[d, c] = hessian[c, d]
    return cost
