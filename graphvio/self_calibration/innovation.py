"""What errors of the calibration add to the innovation of a motion: vision and the IMU disagree by it."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3_adjoint, se3_inverse, so3_log
from graphvio.rig import Rig
from graphvio.self_calibration.imu_model import ACCEL_MATRIX, GYRO_MATRIX, TIME_OFFSET
from graphvio.self_calibration.parameters import n_of_cameras, place_of


class InnovationErrors:
    """Errors of the cameras' place in body, of the gyro's matrix and of the time offset, in a motion's innovation.

    The innovation is the motion of body by vision less that by the IMU. To a motion M of body, an error d of the
    cameras' place adds ``(Ad(M^-1) - I) d``, an error D of the gyro's matrix the rotation ``D phi`` with M's rotation
    vector phi, and an error of the time offset the motion that body makes in it at the end, less that at the beginning.
    The three are taken as independent.

    Args:
        covariance: (C, C) of the calibration of the cameras and the IMU.
        rig: That it belongs to.
    """

    def __init__(self, covariance: Float, rig: Rig) -> None:
        imu = covariance[n_of_cameras(rig) :, n_of_cameras(rig) :]
        self._of_place = covariance[place_of(rig, 0), place_of(rig, 0)]
        self._of_matrix = imu[GYRO_MATRIX:ACCEL_MATRIX, GYRO_MATRIX:ACCEL_MATRIX].reshape(3, 3, 3, 3)
        self._of_time_offset = float(imu[TIME_OFFSET, TIME_OFFSET])

    def covariance(self, motion: Float, before: Float | None, now: Float | None) -> Float:
        """Return the covariance that they add.

        Args:
            motion: (4, 4) of body, ``reference_T_current``.
            before: (6,) angular and linear velocity of body, in its own frame, rad/s and m/s, at the beginning; None
                leaves out the time offset.
            now: the same at the end.

        Returns:
            (6, 6), tangent ``[rotation, translation]`` in the body frame of the later instant.
        """
        carried = se3_adjoint(se3_inverse(motion))
        by_place = carried - np.eye(6)
        covariance = by_place @ self._of_place @ by_place.T
        phi = so3_log(motion)
        covariance[:3, :3] += np.einsum("iajb,a,b->ij", self._of_matrix, phi, phi)
        if before is not None and now is not None:
            by_time = now - carried @ before
            covariance += self._of_time_offset * np.outer(by_time, by_time)
        return np.asarray(covariance)
