"""What is known of a rig's calibration beforehand: standard deviations of the rig file's values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float
from graphvio.rig import Rig
from graphvio.self_calibration.evidence import FilePrior
from graphvio.self_calibration.imu_model import (
    ACCEL_BIAS,
    ACCEL_MATRIX,
    GYRO_BIAS,
    GYRO_MATRIX,
    PARAMETERS,
    TIME_OFFSET,
)
from graphvio.self_calibration.parameters import BODY, CAMERA, INTRINSICS, PAIR, STEREO

_MIN_DISTORTION = 0.005  # of a coefficient, from which its standard deviation is a share of it
_MIN_SIGMA = 1e-9
GYRO_BIAS_RAD_S, ACCEL_BIAS_M_S2 = 0.02, 0.1


@dataclass(frozen=True)
class CalibrationSigmas:
    """Standard deviations of a rig file's calibration.

    Attributes:
        focal_share: of each focal length, as a share of it.
        principal_point_px: of each principal point's coordinate.
        distortion_share: of each distortion coefficient that is not zero, as a share of it.
        stereo_rotation_deg: of left to right, about each axis.
        stereo_baseline_share: of the translation left to right, each coordinate, as a share of the baseline.
        body_rotation_deg: of all cameras together in body, about each axis.
        body_translation_m: of all cameras together in body, each coordinate.
        pair_rotation_deg: of each pair relative to the first one, about each axis.
        pair_translation_m: of each pair relative to the first one, each coordinate.
        time_offset_s: of the IMU's time offset.
        imu_scale_share: of the scale of each axis of gyro and accelerometer.
        imu_misalignment_deg: of each axis of gyro and accelerometer.
    """

    focal_share: float = 0.001
    principal_point_px: float = 0.5
    distortion_share: float = 0.005
    stereo_rotation_deg: float = 0.05
    stereo_baseline_share: float = 0.002
    body_rotation_deg: float = 0.3
    body_translation_m: float = 0.005
    pair_rotation_deg: float = 0.3
    pair_translation_m: float = 0.005
    time_offset_s: float = 0.002
    imu_scale_share: float = 0.003
    imu_misalignment_deg: float = 0.15

    def prior(self, rig: Rig) -> FilePrior:
        """Return the prior of all parameters of a rig: of its pairs, and of its IMU if there is one."""
        cameras = self._of_pairs(rig)
        n = len(cameras)
        if rig.imu is None:
            return FilePrior(cameras, np.ones(n, dtype=bool))
        covariance, is_of_file = np.zeros((n + PARAMETERS, n + PARAMETERS)), np.ones(n + PARAMETERS, dtype=bool)
        covariance[:n, :n] = cameras
        covariance[n:, n:] = np.diag(self._of_imu() ** 2)
        is_of_file[n : n + GYRO_MATRIX] = False
        return FilePrior(covariance, is_of_file)

    def _of_imu(self) -> Float:
        """Return the standard deviations of the IMU's parameters, see `graphvio.self_calibration.imu_model`."""
        sigmas = np.empty(PARAMETERS)
        sigmas[GYRO_BIAS:ACCEL_BIAS], sigmas[ACCEL_BIAS:GYRO_MATRIX] = GYRO_BIAS_RAD_S, ACCEL_BIAS_M_S2
        matrix = np.full((3, 3), np.deg2rad(self.imu_misalignment_deg))
        np.fill_diagonal(matrix, self.imu_scale_share)
        sigmas[GYRO_MATRIX:ACCEL_MATRIX] = sigmas[ACCEL_MATRIX:TIME_OFFSET] = matrix.ravel()
        sigmas[TIME_OFFSET] = self.time_offset_s
        return sigmas

    def _of_pairs(self, rig: Rig) -> Float:
        """Return the covariance of the pairs' parameters, see `graphvio.self_calibration.parameters`."""
        n_pairs = len(rig.pairs)
        covariance = np.zeros((n_pairs * PAIR, n_pairs * PAIR))
        for j, pair in enumerate(rig.pairs):
            sigmas = np.zeros(PAIR)
            for which, camera in enumerate((pair.left, pair.right)):
                at = which * CAMERA
                sigmas[at : at + 2] = self.focal_share * camera.intrinsics[:2]
                sigmas[at + 2 : at + 4] = self.principal_point_px
                known = np.where(camera.distortion != 0.0, np.maximum(np.abs(camera.distortion), _MIN_DISTORTION), 0.0)
                sigmas[at + INTRINSICS : at + CAMERA] = self.distortion_share * known
            sigmas[STEREO : STEREO + 3] = np.deg2rad(self.stereo_rotation_deg)
            sigmas[STEREO + 3 : BODY] = self.stereo_baseline_share * pair.baseline_m
            at = j * PAIR
            covariance[at : at + BODY, at : at + BODY] = np.diag(np.maximum(sigmas[:BODY], _MIN_SIGMA) ** 2)
        common = np.repeat([np.deg2rad(self.body_rotation_deg), self.body_translation_m], 3) ** 2
        single = np.repeat([np.deg2rad(self.pair_rotation_deg), self.pair_translation_m], 3) ** 2
        for i in range(n_pairs):
            for j in range(n_pairs):
                block = common + single if i == j and j > 0 else common
                covariance[i * PAIR + BODY : (i + 1) * PAIR, j * PAIR + BODY : (j + 1) * PAIR] = np.diag(block)
        return covariance
