"""Derivatives of a motion with respect to the angular and linear velocities that compensate rolling shutters."""

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.frontend.motion.blocks import POINTS, in_blocks, lane_by_lane
from graphvio.frontend.motion.cost import camera_motions
from graphvio.frontend.motion.linearisation import allocate_points, linearise, relinearise_points
from graphvio.frontend.motion.observations import Observations, RigArrays
from graphvio.geometry import se3_adjoint
from graphvio.kernels import kernel
from graphvio.linear_algebra import solve_rows

_SCALE = 10.0  # of the cost, in standard deviations: inliers get nearly equal weights
_PRIOR = 1e-2  # information of a motion's rotation and translation, so that some directions may be unknown


def derivatives_by_readout(
    rig: RigArrays, observations: Observations, inlier: Bool, cur_T_ref: Float, sigma_px: float, seconds: Float
) -> Float:
    """Return the derivatives of a motion with respect to the velocities of the readouts now and at the reference.

    A line that is exposed some time after the stamp sees points from the camera's position at that time. An error of
    the velocity, multiplied by that time, shifts the line's points as a translation would, and an error of the angular
    velocity turns them. In a narrow view, different shifts at the top and at the bottom look like a rotation of the
    camera, and the error of the motion is larger than that of the displacement within the readout.

    Args:
        rig: calibration of P pairs.
        observations: N points of any subset of them.
        inlier: (N,) the points that the motion explains.
        cur_T_ref: (4, 4) motion of body.
        sigma_px: standard deviation of the pixel noise.
        seconds: (2, N) from the stamp until a point's line was exposed, now and at the reference.

    Returns:
        (2, 6, 6) derivatives with respect to ``[angular velocity, velocity]`` of body; those with respect to the
        velocity are the derivatives of `graphvio.measurements.motion.ByVelocities`.
    """
    motion = np.ascontiguousarray(cur_T_ref)
    information, now, then = _moments(rig, observations, inlier.astype(np.float64), motion, sigma_px, seconds)
    shifts = np.array([now, -then @ se3_adjoint(motion)])
    return np.array([solve_rows(information + _PRIOR * np.eye(6), np.ascontiguousarray(each.T)).T for each in shifts])


@kernel
def _moments(
    rig: RigArrays, observations: Observations, counted: Float, cur_T_ref: Float, sigma_px: float, seconds: Float
) -> tuple[Float, Float, Float]:
    """Return three normal matrices (6, 6) of a motion: of its points, and of these weighted with either time."""
    blocks, motions = in_blocks(observations), camera_motions(cur_T_ref, rig)
    points_at, sigmas_px = allocate_points(blocks), np.full(len(rig.focal_px), sigma_px)
    relinearise_points(motions, rig, blocks, sigmas_px, points_at)
    found = np.zeros((3, 6, 6))
    gradient, errors2 = np.empty(6), np.empty((len(blocks.pair), POINTS))
    for k in range(3):
        weights = counted if k == 0 else counted * seconds[k - 1]
        lanes = lane_by_lane(blocks, weights)
        linearise(motions, rig, blocks, points_at, lanes, _SCALE, found[k], gradient, errors2)
    return found[0], found[1], found[2]
