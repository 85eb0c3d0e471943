"""Common scale of a single camera's depths, which motions that are measured with these depths do not show.

Depths from motion have the relative error of the motions that they were computed from, which is common to all points of
a camera. Treated as independent errors of the points, it would let the length of an earlier motion determine that of
the current one: small biases of the tracks would add up to an error of the scale, which pairs know better. So the scale
of each single camera's depths is one more unknown.

A factor ``1 + s`` of all inverse depths of a camera changes its image in the same way as a translation of the camera
that is longer by that factor: the derivative with respect to s is that with respect to the motion, along the direction
d of the camera's translation.
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

_SIGMA = 0.01  # of a common scale, relative: large against a good pair's error of a step, small against the IMU's
_WEAKEST_SIGMA = 10.0  # rad and m, of directions that no point constrains
_DIRECTION_SHARE = 0.1  # of a length's error, added in all directions: not all depths have one factor


def with_unknown_scales(rig: RigArrays, observations: Observations, refined: Refined, config: MotionConfig) -> Refined:
    """Correct a refined motion and its covariance for one unknown scale of the depths of each single camera.

    Args:
        rig: Calibration of P pairs and single cameras.
        observations: N points of any subset of them.
        refined: The motion, estimated with all scales 1.
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
    noise = float(np.trace(refined.covariance @ information[:6, :6])) / 6.0  # variance over the modelled one
    gained = noise * (covariance[:6, :6] - known)
    step = covariance[:6] @ right_hand_side
    return replace(
        refined,
        cur_T_ref=se3_exp(step) @ refined.cur_T_ref,
        covariance=refined.covariance + gained,
        shared_covariance=refined.shared_covariance + gained,
    )


def is_of_singles(rig: RigArrays, observations: Observations, refined: Refined) -> bool:
    """Return whether a motion explains points of single cameras only, so that its length comes from their depths."""
    return bool(rig.is_single[observations.pair[refined.inlier]].all())


def with_free_length(
    rig: RigArrays, observations: Observations, refined: Refined, motion: RelativeMotion, predicted: Float | None
) -> RelativeMotion:
    """Make the length of a motion unknown if single cameras alone have measured it; other motions stay as they are.

    The depths come from motions that the same cameras measured alone, so that an error of the scale would persist.

    Args:
        rig: Calibration of P pairs and single cameras.
        observations: N points.
        refined: The motion estimated from them.
        motion: The same as a measurement, with its covariance.
        predicted: ``cur_T_ref`` (4, 4) of body as the state predicts it, or None where it is not known.
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
    """Limit the length of a motion by single cameras to what is possible: while no depth is known, any length fits.

    Soon after a standstill, depths may be far off: the motion may be several times too long, and its direction is off
    with them.

    Args:
        rig: Calibration of P pairs and single cameras.
        single: Index of the camera, or of one of several.
        motion: The motion, of any length.
        predicted: ``cur_T_ref`` (4, 4) of body as the state predicts it.
        slack_m: By how much the translation may be longer than the predicted one.
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
    """Enlarge the covariance of a single camera's own motion by the uncertainty of its depths' scale."""
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
