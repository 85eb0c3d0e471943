"""Standard deviations of a rig file's calibration, and named levels of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.errors import RigError

_MARGIN_SIGMAS = 3.0
_MAX_MARGIN_PX = 5.0  # patches farther off than this are not registered


@dataclass(frozen=True)
class CalibrationSigmas:
    """Standard deviations of a rig file's calibration.

    Attributes:
        focal_share: standard deviation of each focal length, as a share of it.
        principal_point_px: standard deviation of each coordinate of a principal point.
        distortion_share: standard deviation of each distortion coefficient, as a share of it.
        stereo_rotation_deg: standard deviation of the rotation of ``right_T_left``, about each axis.
        stereo_baseline_share: standard deviation of each coordinate of ``right_T_left``, as a share of the baseline.
        body_rotation_deg: standard deviation of the rotation of all cameras together in body, about each axis.
        body_translation_m: standard deviation of the position of all cameras together in body, each coordinate.
        pair_rotation_deg: standard deviation of the rotation of each pair relative to the first one, about each axis.
        pair_translation_m: standard deviation of the position of each pair relative to the first one, each coordinate.
        time_offset_s: standard deviation of the IMU's time offset.
        imu_scale_share: standard deviation of the scale of each axis of gyro and accelerometer.
        imu_misalignment_deg: standard deviation of the direction of each axis of gyro and accelerometer.
        estimated: whether the values were estimated together with the calibration. They then describe its actual
            errors, and the calibration is never pinned as exact; one with typical standard deviations may be.

    Raises:
        RigError: if a value is not positive and finite.
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
    estimated: bool = False

    def __post_init__(self) -> None:
        for name, value in self.values.items():
            if not np.isfinite(value) or value <= 0.0:
                raise RigError(f"calibration_sigmas: {name} is {value}; give a positive standard deviation")

    @property
    def values(self) -> dict[str, float]:
        """The standard deviations by name."""
        return {name: value for name, value in vars(self).items() if name != "estimated"}

    def epipolar_margin_px(self, focal_px: float, rotation_deg: float) -> float:
        """Return the possible error of epipolar lines near the middle of the image, pixels: 3 sigma, but at most 5 px.

        Args:
            focal_px: focal length of the cameras, pixels.
            rotation_deg: standard deviation of the rotation between the cameras, degrees.
        """
        turned_px = np.deg2rad(rotation_deg) * focal_px
        sigma_px = float(np.hypot(turned_px, np.sqrt(2.0) * self.principal_point_px))
        return min(_MARGIN_SIGMAS * sigma_px, _MAX_MARGIN_PX)

    def scaled(self, factor: float) -> CalibrationSigmas:
        """Return all standard deviations times a factor."""
        return CalibrationSigmas(
            **{name: factor * value for name, value in self.values.items()}, estimated=self.estimated
        )


FACTORY = CalibrationSigmas()
LEVELS = {"kalibr": FACTORY.scaled(0.3), "factory": FACTORY, "cad": FACTORY.scaled(5.0)}
"""Levels by name: a careful calibration with a target, a factory calibration some months old, and CAD drawings."""
