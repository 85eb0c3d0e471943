"""Estimation of the time offset between cameras and IMU from rotations by vision and by the gyro.

The rotation that vision measures between two framesets is the one that the gyro measures between instants a little
earlier or later. The two rotations differ by the offset times the difference of the angular rates at the ends of the
interval, and by the gyro's bias.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.gating import gate_innovation
from graphvio.backend.noise import own_covariance
from graphvio.geometry import so3_exp, so3_log
from graphvio.kernels import kernel, put
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import RelativeMotion
from graphvio.rig import Imu

_START_SIGMA_S = 0.01
_START_BIAS_SIGMA_RAD_S = 0.1
_WALK_S = 5e-5  # random walk of the offset over a second
_INTERVAL_NS = 250_000_000  # shorter intervals have less information; samples of longer ones may be discarded already
_ANGULAR_ACCEL_RAD_S2 = 10.0
_USABLE_SIGMA_S = 2e-3
_GATE_PROBABILITY = 0.999


@dataclass(frozen=True)
class OffsetEstimate:
    """Estimated error of the offset in use.

    Attributes:
        error_s: Error, to be added to the offset in use.
        sigma_s: Standard deviation of the error.
    """

    error_s: float
    sigma_s: float

    @property
    def is_usable(self) -> bool:
        """Whether the error is known well enough to correct the offset by it."""
        return self.sigma_s < _USABLE_SIGMA_S


class TimeOffsetFilter:
    """A Kalman filter over the offset's error, seconds, and the gyro's bias, rad/s.

    Args:
        imu: Noise densities of the IMU.
        noise_scale: Factor on the noise densities.
        imu_between: Returns the IMU readings between two framesets' stamps, with the offset in use, or None.
    """

    def __init__(self, imu: Imu, noise_scale: float, imu_between: Callable[[int, int], ImuInterval | None]) -> None:
        self._gyro_noise_density = noise_scale * imu.gyro_noise_density
        self._walk_variance = np.array([_WALK_S**2, *3 * [(noise_scale * imu.gyro_random_walk) ** 2]])
        self._imu_between = imu_between
        self._mean = np.zeros(4)
        self._covariance = np.diag([_START_SIGMA_S, *3 * [_START_BIAS_SIGMA_RAD_S]]) ** 2
        # Reference -> the motion that ends where an interval begins; None is the reference itself.
        self._beginnings: dict[int, RelativeMotion | None] = {}
        self._newest_ns: int | None = None

    @property
    def estimate(self) -> OffsetEstimate:
        """Estimate of the offset's error."""
        return OffsetEstimate(float(self._mean[0]), float(np.sqrt(self._covariance[0, 0])))

    def update(self, motion: RelativeMotion) -> None:
        """Update the estimate by the relative motion of a frameset."""
        reference_ns = motion.reference_stamp_ns
        start = self._beginnings.get(reference_ns)
        start_ns = reference_ns if start is None else start.stamp_ns
        if reference_ns not in self._beginnings:
            self._beginnings = {
                ns: begun for ns, begun in self._beginnings.items() if ns > reference_ns - 4 * _INTERVAL_NS
            }
            self._beginnings[reference_ns] = None
        if motion.stamp_ns - start_ns < _INTERVAL_NS:
            return
        self._beginnings[reference_ns] = motion
        self._walk(motion.stamp_ns)
        for error_s in (float(self._mean[0]), 0.0):  # at the estimated offset, if the samples there have come
            shift_ns = round(error_s * 1e9)
            interval = self._imu_between(start_ns + shift_ns, motion.stamp_ns + shift_ns)
            if interval is not None:
                self._measure(*_rotation_between(start, motion), interval, error_s)
                return

    def corrected(self) -> float:
        """Return the offset's error, seconds, for the caller to correct, and set it to zero."""
        error_s = float(self._mean[0])
        self._mean[0] = 0.0
        return error_s

    def _walk(self, stamp_ns: int) -> None:
        if self._newest_ns is not None:
            seconds = max(stamp_ns - self._newest_ns, 0) * 1e-9
            self._covariance += np.diag(seconds * self._walk_variance)
        self._newest_ns = stamp_ns

    def _measure(self, start_R_end: Float, covariance: Float, interval: ImuInterval, error_s: float) -> None:
        """Update by a rotation (3, 3) of vision, with its covariance (3, 3) in the frame at its end, and the IMU's."""
        by_gyro, by_bias = integrated_rates(interval.steps_s, interval.angular_velocity - self._mean[1:])
        residual = so3_log(np.ascontiguousarray(by_gyro.T @ start_R_end))
        rates = interval.angular_velocity[[0, -1]] - self._mean[1:]
        by_stamps = np.array([rates[1], -by_gyro.T @ rates[0]])
        by_offset = by_stamps.sum(axis=0)
        jacobian = np.hstack([by_offset[:, None], by_bias])
        # The rates are not those of the true instants: they change with the angular acceleration.
        change = _ANGULAR_ACCEL_RAD_S2 * self._covariance[0, 0]
        noise = max(self._gyro_noise_density, float(interval.noise_densities[0]))
        covariance = covariance + (interval.steps_s.sum() * noise**2 + change**2) * np.eye(3)
        covariance += interval.stamp_sigma_s**2 * by_stamps.T @ by_stamps
        innovation = residual - by_offset * (self._mean[0] - error_s)
        spread = covariance + jacobian @ self._covariance @ jacobian.T
        if not gate_innovation(innovation, spread, _GATE_PROBABILITY).accepted:
            return
        gain = np.linalg.solve(spread, jacobian @ self._covariance).T
        self._mean = self._mean + gain @ innovation
        remaining = np.eye(4) - gain @ jacobian
        self._covariance = remaining @ self._covariance @ remaining.T + gain @ covariance @ gain.T


def _rotation_between(start: RelativeMotion | None, end: RelativeMotion) -> tuple[Float, Float]:
    """Return the rotation (3, 3) from one motion's end to another's, and its covariance (3, 3) there.

    Args:
        start: Motion from the same reference; None is the reference itself.
        end: The later motion.
    """
    if start is None:
        return end.reference_T_current[:3, :3], end.covariance[:3, :3]
    start_R_end = start.reference_T_current[:3, :3].T @ end.reference_T_current[:3, :3]
    before = start_R_end.T @ _own_rotation_covariance(start) @ start_R_end
    return start_R_end, before + _own_rotation_covariance(end)


def _own_rotation_covariance(motion: RelativeMotion) -> Float:
    """Return the covariance (3, 3) without the part that all motions from one reference share."""
    return np.asarray(own_covariance(motion.covariance, motion.shared_covariance)[:3, :3])


@kernel
def integrated_rates(steps_s: Float, rates: Float) -> tuple[Float, Float]:
    """Return the rotation (3, 3) over steps of constant rate (N, 3), and its derivative with respect to their bias.

    The derivative (3, 3) is that of the rotation's tangent in the frame at the end.
    """
    start_R_end, by_bias = np.eye(3), np.zeros((3, 3))
    for i in range(len(steps_s)):
        step = so3_exp(steps_s[i] * rates[i])
        put(by_bias, step.T @ by_bias - steps_s[i] * np.eye(3))
        put(start_R_end, start_R_end @ step)
    return start_R_end, by_bias
