"""Pose pairs of two cameras on one rig, and an independent closed form for their relative pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.calibration.camera_motions import CameraMotions
from graphvio.calibration.pose_pairs import PosePairs
from graphvio.geometry import quat_wxyz_from_rotation, rotation_from_quat_wxyz, se3, se3_exp, se3_inverse
from graphvio.measurements.motion import RelativeMotion

PERIOD_NS = 50_000_000
FRAMES = 240
SIGMAS = np.repeat([3e-4, 5e-4], 3)
Walk = Callable[[float], Float]
LEFT2_T_LEFT1 = se3_exp(np.array([0.05, 3.0, 0.1, 0.3345, 0.0667, -0.1138]))  # back to back, as the paper's


@dataclass(frozen=True)
class SyntheticPairs:
    """Pose pairs and which of them are outliers (N,)."""

    pairs: PosePairs
    outlier: Bool


def synthetic_pairs(
    count: int,
    rng: np.random.Generator,
    rotation_sigma: float = 0.0,
    translation_sigma_m: float = 0.0,
    outlier_share: float = 0.0,
    left2_T_left1: Float = LEFT2_T_LEFT1,
    turns: tuple[float, float, float] = (0.1, 0.1, 0.1),
    steps: tuple[float, float, float] = (0.05, 0.05, 0.05),
) -> SyntheticPairs:
    """Random motions of a rig, as both of its cameras measure them.

    Args:
        count: number of pose pairs.
        rng: source of motions and errors.
        rotation_sigma: of each motion's rotation, rad.
        translation_sigma_m: of its translation.
        outlier_share: of pose pairs whose second motion has nothing to do with the first.
        left2_T_left1: (4, 4).
        turns: standard deviations of the first camera's rotation about its axes, rad.
        steps: of its translation along its axes, metres.
    """
    spread = np.array([*turns, *steps])
    sigmas = np.repeat([max(rotation_sigma, 1e-4), max(translation_sigma_m, 1e-4)], 3)
    noise = np.repeat([rotation_sigma, translation_sigma_m], 3)
    one = [se3_exp(spread * rng.standard_normal(6)) for _ in range(count)]
    outlier = rng.random(count) < outlier_share
    other = [
        se3_exp(np.repeat([0.15, 0.1], 3) * rng.standard_normal(6))
        if is_outlier
        else left2_T_left1 @ motion @ se3_inverse(left2_T_left1)
        for motion, is_outlier in zip(one, outlier, strict=True)
    ]
    motion_1, motion_2 = (
        np.array([motion @ se3_exp(noise * rng.standard_normal(6)) for motion in motions]) for motions in (one, other)
    )
    covariance = np.broadcast_to(np.diag(sigmas**2), (count, 6, 6)).copy()
    start_ns = np.arange(count) * PERIOD_NS
    return SyntheticPairs(
        PosePairs(start_ns, start_ns + PERIOD_NS, motion_1, covariance, motion_2, covariance), outlier
    )


def turning(time_s: float) -> Float:
    """A walk with turns about all axes."""
    waves = np.sin(np.array([1.1, 0.7, 0.4, 0.5, 0.3, 0.6]) * time_s + np.arange(6))
    return se3_exp(np.array([0.3, 0.5, 0.8, 0.4, 0.8, 0.6]) * waves)


def planar(time_s: float) -> Float:
    """A cart: it turns about the camera's y axis, which is vertical, and moves on the floor."""
    turned = se3_exp(np.array([0.0, 0.9 * np.sin(0.5 * time_s), 0.0, 0.0, 0.0, 0.0]))
    turned[:3, 3] = [np.sin(0.4 * time_s), 0.0, 0.5 * np.cos(0.3 * time_s)]
    return turned


def straight(time_s: float) -> Float:
    moved = np.eye(4)
    moved[:3, 3] = [0.3 * np.sin(time_s), 0.2 * np.cos(0.7 * time_s), 0.5 * time_s]
    return moved


def motions(
    walk: Walk, to_camera: Float, rng: np.random.Generator, moved: Float | None = None, period_ns: int = PERIOD_NS
) -> CameraMotions:
    """Motions that a camera on the walk measures from frame to frame.

    Args:
        walk: poses of the first camera at times.
        to_camera: pose of the camera in the first one.
        rng: source of errors.
        moved: pose in the first camera from the middle of the walk on, if it was moved on the rig.
        period_ns: between frames, of a walk of the same duration.
    """
    stamps = list(range(0, FRAMES * PERIOD_NS, period_ns))
    measured = []
    for k in range(1, len(stamps)):
        place = to_camera if moved is None or k < len(stamps) // 2 else moved
        one, other = (walk(stamps[i] * 1e-9) @ place for i in (k - 1, k))
        motion = np.linalg.inv(one) @ other @ se3_exp(SIGMAS * rng.standard_normal(6))
        measured.append(RelativeMotion(stamps[k - 1], stamps[k], motion, np.diag(SIGMAS**2), np.zeros((6, 6)), 200))
    return CameraMotions(stamps, measured, np.eye(4))


def by_dual_quaternions(pairs: PosePairs) -> Float:
    """``left2_T_left1`` (4, 4) by K. Daniilidis, *Hand-Eye Calibration Using Dual Quaternions*, IJRR 18(3), 1999: with
    ``A_i X = X B_i`` for motions A of the second and B of the first camera."""
    rows = []
    for motion_1, motion_2 in zip(pairs.motion_1, pairs.motion_2, strict=True):
        (a, a_dual), (b, b_dual) = _dual(motion_2), _dual(motion_1)
        block = np.zeros((6, 8))
        block[:3, 0], block[:3, 1:4] = (a - b)[1:], _cross((a + b)[1:])
        block[3:, 0], block[3:, 1:4] = (a_dual - b_dual)[1:], _cross((a_dual + b_dual)[1:])
        block[3:, 4], block[3:, 5:8] = (a - b)[1:], _cross((a + b)[1:])
        rows.append(block)
    _, _, vectors = np.linalg.svd(np.concatenate(rows))
    (u1, v1), (u2, v2) = ((v[:4], v[4:]) for v in vectors[-2:])
    # lambda_1 (u1, v1) + lambda_2 (u2, v2) with a unit real part that is orthogonal to the dual one.
    best: tuple[float, Float, Float] | None = None
    quadratic = np.array([u1 @ v1, u1 @ v2 + u2 @ v1, u2 @ v2])
    shares = [(ratio.real, 1.0) for ratio in np.roots(quadratic) if abs(ratio.imag) < 1e-6]
    shares += [(1.0, 0.0)] if abs(quadratic[0]) < 1e-9 else []
    for first, second in shares:
        real, dual = first * u1 + second * u2, first * v1 + second * v2
        norm = float(np.linalg.norm(real)) / float(np.hypot(first, second))
        if best is None or norm > best[0]:
            best = norm, real / np.linalg.norm(real), dual / np.linalg.norm(real)
    assert best is not None
    _, real, dual = best
    translation = 2.0 * _product(dual, real * np.array([1.0, -1.0, -1.0, -1.0]))[1:]
    return np.asarray(se3(rotation_from_quat_wxyz(real), np.ascontiguousarray(translation)))


def _dual(motion: Float) -> tuple[Float, Float]:
    """Real and dual part of a motion's dual quaternion."""
    real = quat_wxyz_from_rotation(np.ascontiguousarray(motion[:3, :3]))
    return real, 0.5 * _product(np.array([0.0, *motion[:3, 3]]), real)


def _product(p: Float, q: Float) -> Float:
    scalar = p[0] * q[0] - p[1:] @ q[1:]
    return np.array([scalar, *(p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:]))])


def _cross(v: Float) -> Float:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
