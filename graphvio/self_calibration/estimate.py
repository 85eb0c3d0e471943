"""Estimate of a rig's calibration at one moment of a run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from graphvio.arrays import Float
from graphvio.rig import Rig
from graphvio.self_calibration.evidence import EXACT, Gaussian, inexact
from graphvio.self_calibration.imu_model import ACCEL_MATRIX, GYRO_MATRIX, TIME_OFFSET
from graphvio.self_calibration.parameters import moved_cameras, n_camera_parameters
from graphvio.self_calibration.prior import refined_sigmas


@dataclass(frozen=True, eq=False)
class CalibrationEstimate:
    """Estimate of a rig's calibration by the rig file and the measurements.

    Attributes:
        file_rig: the rig of the file.
        posterior: posterior of the difference from it (see `graphvio.self_calibration.parameters`), if no part is
            exact.
        difference: (C,) difference that is in force, with zero for parts that are exact.
        file_factors: (G,) factors by which the file's errors exceed their standard deviations: of intrinsics and stereo
            extrinsics, and of extrinsics in body and the IMU. `EXACT` where the file is as good as exact.
        twice_log_bayes_factor: twice the logarithm of the odds of these factors against an exact file; above 10 it is
            very strong evidence (R. E. Kass, A. E. Raftery, *Bayes factors*, 1995).
        is_changed: whether a knock has changed the cameras since the file was made.
    """

    file_rig: Rig
    posterior: Gaussian
    difference: Float
    file_factors: Float
    twice_log_bayes_factor: float = 0.0
    is_changed: bool = False

    @property
    def is_file_exact(self) -> bool:
        """Whether the measurements do not contradict the rig file, which then stays in force."""
        return not self.is_changed and bool((self.file_factors == EXACT).all())

    @cached_property
    def sigmas(self) -> Float:
        """Standard deviations (C,) of the difference."""
        return np.sqrt(np.diag(self.posterior.covariance))

    @cached_property
    def rig(self) -> Rig:
        """The rig with the calibration that is in force."""
        if self.is_file_exact:
            return self.file_rig
        rig = moved_cameras(self.file_rig, self.difference[: self._n_camera_parameters])
        rig = replace(rig, calibration_sigmas=refined_sigmas(rig, self.posterior, inexact(self.file_factors)))
        if rig.imu is None:
            return rig
        gyro, accel = (
            tuple(((np.eye(3) + error) @ matrix).ravel().tolist())
            for error, matrix in zip(self.imu_matrices, rig.imu.matrices, strict=True)
        )
        time_offset_s = rig.imu.time_offset_s + self.time_offset_s
        return replace(rig, imu=replace(rig.imu, time_offset_s=time_offset_s, gyro_matrix=gyro, accel_matrix=accel))

    @property
    def time_offset_s(self) -> float:
        """Difference of the IMU's time offset from the rig file's; 0 without an IMU."""
        return 0.0 if self.file_rig.imu is None else float(self.difference[self._n_camera_parameters + TIME_OFFSET])

    @property
    def imu_matrices(self) -> tuple[Float, Float]:
        """Errors (3, 3) of the matrices of gyro and accelerometer, see `graphvio.self_calibration.imu_model`."""
        if self.file_rig.imu is None:
            return np.zeros((3, 3)), np.zeros((3, 3))
        of_imu = self.difference[self._n_camera_parameters :]
        return of_imu[GYRO_MATRIX:ACCEL_MATRIX].reshape(3, 3), of_imu[ACCEL_MATRIX:TIME_OFFSET].reshape(3, 3)

    @property
    def _n_camera_parameters(self) -> int:
        return n_camera_parameters(self.file_rig)
