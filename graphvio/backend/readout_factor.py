"""Factor of a motion measured with rolling shutters, which depends on the velocities that compensated the image lines.

A frameset is compensated with a predicted velocity, which differs from that of the solution: the factor of its motion
takes the difference into account, and so does the innovation test. Without that, an error of the velocity makes the
next motion wrong, which makes the velocity more wrong.
"""

from __future__ import annotations

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse, skew
from graphvio.measurements.motion import ByVelocities, RelativeMotion


def readout_factor(
    reference: int, newest: int, velocities: tuple[int, int], motion: RelativeMotion, noise: gtsam.noiseModel.Base
) -> gtsam.CustomFactor:
    """Return the factor of a motion that depends on velocities.

    Args:
        reference: Key of the pose from which the motion is measured.
        newest: Key of the pose at which the motion ends.
        velocities: Keys of the velocities in nav, of the newest state and of the reference.
        motion: The motion, with ``by_velocities``.
        noise: Noise of the motion.
    """
    by_velocities = motion.by_velocities
    assert by_velocities is not None
    measured = gtsam.Pose3(motion.reference_T_current)

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        poses = values.atPose3(newest), values.atPose3(reference)
        relative = poses[1].between(poses[0])
        nav_R_body = np.array([pose.rotation().matrix() for pose in poses])
        in_body = np.einsum("kji,kj->ki", nav_R_body, [values.atVector(key) for key in velocities])
        if jacobians is not None:
            for k, jacobian in enumerate(jacobians_of(relative.matrix(), by_velocities, nav_R_body, in_body)):
                jacobians[k] = jacobian
        return np.asarray(measured.localCoordinates(relative)) + _excess(by_velocities, in_body)

    return gtsam.CustomFactor(noise, [reference, newest, *velocities], error)


def jacobians_of(relative: Float, by_velocities: ByVelocities, nav_R_body: Float, in_body: Float) -> list[Float]:
    """Return the Jacobians of the error of a `readout_factor`, for small errors.

    Args:
        relative: (4, 4) motion from the reference to the newest state.
        by_velocities: Dependence of the motion on the velocities.
        nav_R_body: (2, 3, 3) attitudes of the newest state and of the reference.
        in_body: (2, 3) velocities in body, in the same order, m/s.

    Returns:
        (6, 6), (6, 6), (6, 3) and (6, 3) with respect to the poses of reference and newest state, and to the velocities
        in nav of newest state and reference.
    """
    now, then = by_velocities.derivatives
    by_reference, by_newest = -se3_adjoint(se3_inverse(relative)), np.eye(6)
    by_newest[:, :3] += now @ skew(in_body[0])
    by_reference[:, :3] += then @ skew(in_body[1])
    return [by_reference, by_newest, now @ nav_R_body[0].T, then @ nav_R_body[1].T]


def corrected(motion: RelativeMotion, by_velocities: ByVelocities, in_body: Float) -> Float:
    """Return a motion (4, 4) corrected for the velocities (2, 3) in body, now and at the reference, m/s."""
    return np.asarray(motion.reference_T_current @ se3_exp(-_excess(by_velocities, in_body)))


def _excess(by_velocities: ByVelocities, in_body: Float) -> Float:
    """Return the error (6,) of a motion that was compensated with other velocities in body than these (2, 3)."""
    return np.asarray(np.einsum("kij,kj->i", by_velocities.derivatives, in_body - by_velocities.used))
