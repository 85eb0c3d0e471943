"""Common scale of a single camera's depths, which no motion that is measured by them shows.

Depths from motion are as wrong as the length of the motions that they were computed from, all of a camera together.
Taken for independent errors of its points, they would let yesterday's length of a step decide on today's: small biases
of the tracks add up to a scale that pairs know better. So the scale of each single camera's depths is one more unknown.

A factor ``1 + s`` of all inverse depths of a camera changes what it sees as a translation of the camera that is longer
by that factor does: the derivative with respect to s is that with respect to the motion, along the direction d of the
camera's translation.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.config.stages import MotionConfig
from graphvio.frontend.motion.blocks import POINTS, in_blocks, lane_by_lane
from graphvio.frontend.motion.cost import camera_motions
from graphvio.frontend.motion.linearisation import allocate_points, linearise, relinearise_points
from graphvio.frontend.motion.observations import Observations, RigArrays
from graphvio.frontend.motion.refinement import Refined
from graphvio.frontend.thresholds import THRESHOLDS
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse
from graphvio.kernels import kernel
from graphvio.measurements.motion import RelativeMotion

_SIGMA = 0.01  # of a common scale, relative: wide next to what a good pair knows of a step, narrow next to the IMU
_WEAKEST_SIGMA = 10.0  # rad and m, of directions that no point constrains
_DIRECTION_SHARE = 0.1  # of the error of a length, by which the direction is off: not all depths have one factor


def with_unknown_scales(rig: RigArrays, observations: Observations, refined: Refined, config: MotionConfig) -> Refined:
    """Add one unknown scale of the depths of each single camera to a refined motion: the corrected motion.

    Args:
        rig: P pairs and single cameras.
        observations: N points of any subset of them.
        refined: The solution with all scales 1.
        config: Configuration of the motion stage.
    """
    singles = [j for j in observations.pairs if rig.is_single[j]]
    if not singles:
        return refined
    n = 6 + len(singles)
    information, right_hand_side = np.zeros((n, n)), np.zeros(n)
    settings = config.pixel_sigma_px, config.cauchy_scale_px / config.pixel_sigma_px
    information[:6, :6], _ = _normal_equations(refined.cur_T_ref, rig, observations, refined.inlier, *settings)
    information[:6, :6] += _WEAKEST_SIGMA**-2 * np.eye(6)
    for k, j in enumerate(singles, start=6):
        of_camera = observations.of_pair(j)
        hessian, gradient = _normal_equations(
            refined.cur_T_ref, rig, of_camera, refined.inlier[observations.pair == j], *settings
        )
        along = _along_translation(rig, j, refined.cur_T_ref)
        information[:6, k] = information[k, :6] = hessian @ along
        information[k, k] = along @ hessian @ along + _SIGMA**-2
        right_hand_side[k] = along @ gradient
    covariance = np.linalg.inv(information)
    known = np.linalg.inv(information[:6, :6])
    noise = float(np.trace(refined.covariance @ information[:6, :6])) / 6.0  # over the modelled one
    gained = noise * (covariance[:6, :6] - known)
    step = covariance[:6] @ right_hand_side
    return replace(
        refined,
        cur_T_ref=se3_exp(step) @ refined.cur_T_ref,
        covariance=refined.covariance + gained,
        shared_covariance=refined.shared_covariance + gained,
    )


def is_of_singles(rig: RigArrays, observations: Observations, refined: Refined) -> bool:
    """Return whether a motion explains points of single cameras only, so that its length is that of their depths."""
    return bool(rig.is_single[observations.pair[refined.inlier]].all())


def with_free_length(
    rig: RigArrays, observations: Observations, refined: Refined, motion: RelativeMotion, predicted: Float | None
) -> RelativeMotion:
    """Let the length of a motion be unknown that single cameras alone have measured; another one stays as it is.

    The depths are those of motions that the same cameras measured alone: an error of the scale would go on in them.

    Args:
        rig: P pairs and single cameras.
        observations: N points.
        refined: The solution for them.
        motion: The same, with its covariance.
        predicted: ``cur_T_ref`` (4, 4) of body by the state, or None where it is not known.
    """
    if not is_of_singles(rig, observations, refined):
        return motion
    singles = np.unique(observations.pair[refined.inlier]).tolist()
    along = np.array([_along_translation(rig, single, refined.cur_T_ref) for single in singles])
    scale_covariance = along.T @ along
    motion = replace(
        motion,
        covariance=motion.covariance + scale_covariance,
        shared_covariance=motion.shared_covariance + scale_covariance,
    )
    if predicted is None:
        return motion
    slack_m = THRESHOLDS.quality.max_excess_speed_m_s * motion.duration_s
    return _with_possible_length(rig, int(observations.pair[refined.inlier][0]), motion, predicted, slack_m)


def _with_possible_length(
    rig: RigArrays, single: int, motion: RelativeMotion, predicted: Float, slack_m: float
) -> RelativeMotion:
    """Return a motion of single cameras with a length that the rig can have: while no depth is known, any fits.

    Soon after a standstill, depths are anything: the motion may be several times too long, and bends with them.

    Args:
        rig: P pairs and single cameras.
        single: The camera, or one of several.
        motion: With any length.
        predicted: ``cur_T_ref`` (4, 4) of body.
        slack_m: By how much a translation may be longer than the predicted one.
    """
    body_T_cam = np.ascontiguousarray(rig.body_T_left[single])
    cam_T_body = se3_inverse(body_T_cam)
    measured = cam_T_body @ se3_inverse(motion.reference_T_current) @ body_T_cam
    translation, expected = measured[:3, 3].copy(), (cam_T_body @ predicted @ body_T_cam)[:3, 3]
    length, expected_length = float(np.linalg.norm(translation)), float(np.linalg.norm(expected))
    longest = expected_length + slack_m
    if length > longest:
        measured[:3, 3] = translation * max(float(expected @ translation), 0.0) / length**2
        share = np.diag(np.repeat([1.0, longest / length], 3))  # the direction is as uncertain as before
        scaled = se3_adjoint(body_T_cam) @ share @ se3_adjoint(cam_T_body)
        motion = replace(
            motion,
            reference_T_current=se3_inverse(body_T_cam @ measured @ cam_T_body),
            covariance=scaled @ motion.covariance @ scaled.T,
            shared_covariance=scaled @ motion.shared_covariance @ scaled.T,
        )
    bent_m = _DIRECTION_SHARE * (min(length, longest) - expected_length)
    bent = np.diag([0.0] * 3 + [bent_m] * 3) ** 2
    return replace(motion, covariance=motion.covariance + bent, shared_covariance=motion.shared_covariance + bent)


def with_scale_of_depths(rig: RigArrays, single: int, motion: Refined) -> Refined:
    """Enlarge the covariance of a single camera's own motion by what is not known of its depths' scale."""
    along = _SIGMA * _along_translation(rig, single, motion.cur_T_ref)
    scale_covariance = np.outer(along, along)
    return replace(
        motion,
        covariance=motion.covariance + scale_covariance,
        shared_covariance=motion.shared_covariance + scale_covariance,
    )


def _along_translation(rig: RigArrays, single: int, cur_T_ref: Float) -> Float:
    """Return the derivative (6,) of the motion of body with respect to a factor of a camera's translation."""
    body_T_cam = np.ascontiguousarray(rig.body_T_left[single])
    translation = (se3_inverse(body_T_cam) @ cur_T_ref @ body_T_cam)[:3, 3]
    return np.asarray(se3_adjoint(body_T_cam)[:, 3:] @ translation)


@kernel
def _normal_equations(
    cur_T_ref: Float, rig: RigArrays, observations: Observations, inlier: Bool, sigma_px: float, scale: float
) -> tuple[Float, Float]:
    """Return the information (6, 6) and gradient (6,) of the inliers of N points at a motion."""
    blocks, motions = in_blocks(observations), camera_motions(cur_T_ref, rig)
    points_at = allocate_points(blocks)
    relinearise_points(motions, rig, blocks, np.full(len(rig.focal_px), sigma_px), points_at)
    hessian, gradient = np.empty((6, 6)), np.empty(6)
    active = lane_by_lane(blocks, inlier.astype(np.float64))
    linearise(motions, rig, blocks, points_at, active, scale, hessian, gradient, np.empty((len(blocks.pair), POINTS)))
    return hessian, gradient
