"""What errors of the calibration add to the covariance of a motion's innovation, vision against the IMU."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3_adjoint, se3_inverse, so3_log
from graphvio.rig import Rig
from graphvio.self_calibration.imu_model import ACCEL_MATRIX, GYRO_MATRIX, TIME_OFFSET
from graphvio.self_calibration.parameters import about_origin, depths_of_pair, extrinsics_of, n_camera_parameters
from graphvio.self_calibration.prior import extrinsic_covariances

_ERROR_SHARE = 0.2  # isotropic share added, since depth errors away from the image centre act in other directions


class InnovationErrors:
    """Effect of errors of cameras, extrinsics, gyro matrix and time offset on the innovation of a motion.

    The innovation is the motion of body by vision less that by the IMU. To a motion M of body, an error d of the
    cameras' extrinsics adds ``(Ad(M^-1) - I) d``, and an error D of the gyro's matrix adds the rotation ``D phi`` with
    M's rotation vector phi. An error of the time offset adds the motion of body within that time at the end, less that
    at the beginning. Errors within a pair act by wrong depths, see `graphvio.frontend.motion.depth_errors`. All are
    taken as independent.

    Args:
        covariance: (C, C) covariance of the calibration of the cameras and the IMU.
        rig: Rig that it belongs to.
    """

    def __init__(self, covariance: Float, rig: Rig) -> None:
        n, to_origin = n_camera_parameters(rig), about_origin(rig, 0)
        imu = covariance[n:, n:]
        self._covariance_in_body = to_origin @ covariance[extrinsics_of(rig, 0), extrinsics_of(rig, 0)] @ to_origin.T
        self._relative_covariances = extrinsic_covariances(rig, covariance)
        by_depths = [depths_of_pair(rig, j) for j in range(len(rig.pairs))]
        self._of_depths = [rows @ covariance[:n, :n] @ rows.T for rows in by_depths]
        self._of_matrix = imu[GYRO_MATRIX:ACCEL_MATRIX, GYRO_MATRIX:ACCEL_MATRIX].reshape(3, 3, 3, 3)
        self._of_time_offset = float(imu[TIME_OFFSET, TIME_OFFSET])

    def covariance(self, motion: Float, before: Float | None, now: Float | None) -> Float:
        """Return the covariance that errors of the extrinsics, the gyro's matrix and the time offset add.

        Args:
            motion: (4, 4) motion of body, ``reference_T_current``.
            before: (6,) angular and linear velocity of body, in its own frame, rad/s and m/s, at the beginning; None
                leaves out the time offset.
            now: the same at the end.

        Returns:
            (6, 6), tangent ``[rotation, translation]`` in the body frame of the later instant.
        """
        carried = se3_adjoint(se3_inverse(motion))
        by_extrinsics = carried - np.eye(6)
        covariance = by_extrinsics @ self._covariance_in_body @ by_extrinsics.T
        phi = so3_log(motion)
        covariance[:3, :3] += np.einsum("iajb,a,b->ij", self._of_matrix, phi, phi)
        if before is not None and now is not None:
            by_time = now - carried @ before
            covariance += self._of_time_offset * np.outer(by_time, by_time)
        return np.asarray(covariance)

    def of_depths(self, derivatives: Float) -> Float:
        """Return the covariance that errors within the pairs add.

        Args:
            derivatives: (P, 2, 6) derivatives of the innovation, see `graphvio.measurements.motion.RelativeMotion`.

        Returns:
            (6, 6), tangent as that of the derivatives.
        """
        added = np.zeros((6, 6))
        for each, of_pair in zip(derivatives, self._of_depths, strict=False):
            added += each.T @ of_pair @ each
        for block in (slice(3), slice(3, 6)):
            added[block, block] += _ERROR_SHARE**2 * np.trace(added[block, block]) / 3.0 * np.eye(3)
        return added

    def of_other_extrinsics(self, j: int, motion: Float) -> Float:
        """Return the covariance (6, 6) that errors of a pair's pose relative to the first pair add to a motion."""
        if j not in self._relative_covariances:
            return np.zeros((6, 6))
        by_extrinsics = se3_adjoint(se3_inverse(motion)) - np.eye(6)
        return np.asarray(by_extrinsics @ self._relative_covariances[j] @ by_extrinsics.T)
