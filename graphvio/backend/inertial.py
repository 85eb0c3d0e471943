"""IMU samples by time, and their preintegration between framesets."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.events import ImuSample
from graphvio.geometry import so3_exp
from graphvio.rig import Imu

GRAVITY_M_S2 = 9.81
_MAX_RATE = 100.0  # rad/s and m/s^2: beyond what any inertial sensor for this use can read
_MAX_FORCE = 1000.0
_INTEGRATION_SIGMA = 1e-4  # m/s^2-like noise that stands for the error of integrating piecewise constant rates


@dataclass(frozen=True, eq=False)
class ImuSpan:
    """The IMU between two instants, as steps of constant rate and acceleration.

    Attributes:
        steps_s: (N,) durations.
        angular_velocity: (N, 3) rad/s, body.
        linear_acceleration: (N, 3) m/s^2 specific force, body.
    """

    steps_s: Float
    angular_velocity: Float
    linear_acceleration: Float

    @property
    def mean_rate(self) -> Float:
        """Mean angular rate (3,) rad/s, bias included."""
        return np.asarray(self.steps_s @ self.angular_velocity / self.steps_s.sum())

    @property
    def mean_force(self) -> Float:
        """Mean specific force (3,) m/s^2, bias included."""
        return np.asarray(self.steps_s @ self.linear_acceleration / self.steps_s.sum())


class ImuBuffer:
    """Samples in time order; what cannot be used is named and left out."""

    def __init__(self, max_gap_ms: float) -> None:
        self._stamps: list[int] = []
        self._rates: list[Float] = []
        self._forces: list[Float] = []
        self._max_gap_ns = round(max_gap_ms * 1e6)

    @property
    def oldest_ns(self) -> int | None:
        """Stamp of the oldest sample, or None."""
        return self._stamps[0] if self._stamps else None

    def add(self, sample: ImuSample) -> str:
        """Take a sample; the name of its fault if it cannot be used, or an empty string."""
        if not (np.isfinite(sample.angular_velocity).all() and np.isfinite(sample.linear_acceleration).all()):
            return "imu_not_finite"
        if np.abs(sample.angular_velocity).max() > _MAX_RATE or np.abs(sample.linear_acceleration).max() > _MAX_FORCE:
            return "imu_out_of_range"
        if self._stamps and sample.stamp_ns <= self._stamps[-1]:
            return "imu_duplicate_stamp" if sample.stamp_ns == self._stamps[-1] else "imu_backward_stamp"
        self._stamps.append(sample.stamp_ns)
        self._rates.append(np.asarray(sample.angular_velocity, dtype=np.float64))
        self._forces.append(np.asarray(sample.linear_acceleration, dtype=np.float64))
        return ""

    def covers(self, stamp_ns: int) -> bool:
        """Whether a sample at or after an instant has come."""
        return bool(self._stamps) and self._stamps[-1] >= stamp_ns

    def span(self, start_ns: int, end_ns: int) -> ImuSpan | None:
        """The IMU between two instants, interpolated at both ends, or None where a gap makes it unknown."""
        first = bisect_right(self._stamps, start_ns) - 1
        last = bisect_left(self._stamps, end_ns)
        if first < 0 or last >= len(self._stamps) or end_ns <= start_ns:
            return None
        stamps = self._stamps[first : last + 1]
        if max(b - a for a, b in pairwise(stamps)) > self._max_gap_ns:
            return None
        at = np.array([s - start_ns for s in stamps], dtype=np.float64) * 1e-9
        knots = np.concatenate([[0.0], at[1:-1], [(end_ns - start_ns) * 1e-9]])
        rates = _interpolate(knots, at, np.array(self._rates[first : last + 1]))
        forces = _interpolate(knots, at, np.array(self._forces[first : last + 1]))
        return ImuSpan(np.diff(knots), 0.5 * (rates[1:] + rates[:-1]), 0.5 * (forces[1:] + forces[:-1]))

    def stretch(self, start_ns: int, end_ns: int) -> tuple[ImuSpan, int] | None:
        """The longest gapless piece of the IMU that ends at the newest sample within two instants.

        Returns:
            The span and the stamp at which it starts, or None where there are not two samples.
        """
        end = bisect_right(self._stamps, end_ns) - 1
        first = end
        while (
            first > 0
            and self._stamps[first - 1] >= start_ns
            and self._stamps[first] - self._stamps[first - 1] <= self._max_gap_ns
        ):
            first -= 1
        span = self.span(self._stamps[first], self._stamps[end]) if end > first else None
        return None if span is None else (span, self._stamps[first])

    def discard_before(self, stamp_ns: int) -> None:
        """Forget samples that no later span can need."""
        keep_from = max(bisect_right(self._stamps, stamp_ns) - 1, 0)
        del self._stamps[:keep_from], self._rates[:keep_from], self._forces[:keep_from]


def preintegration_params(imu: Imu, noise_scale: float) -> gtsam.PreintegrationCombinedParams:
    """gtsam's parameters for nav z up, with the rig's noise densities times a factor."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY_M_S2)
    params.setGyroscopeCovariance(np.eye(3) * (noise_scale * imu.gyro_noise_density) ** 2)
    params.setAccelerometerCovariance(np.eye(3) * (noise_scale * imu.accel_noise_density) ** 2)
    params.setBiasOmegaCovariance(np.eye(3) * (noise_scale * imu.gyro_random_walk) ** 2)
    params.setBiasAccCovariance(np.eye(3) * (noise_scale * imu.accel_random_walk) ** 2)
    params.setIntegrationCovariance(np.eye(3) * _INTEGRATION_SIGMA**2)
    return params


def preintegrate(
    span: ImuSpan, params: gtsam.PreintegrationCombinedParams, bias: gtsam.imuBias.ConstantBias
) -> gtsam.PreintegratedCombinedMeasurements:
    """Preintegrate a span, linearised at a bias.

    A step's mean force belongs to its middle, and gtsam takes it to be in the frame at the step's start: it is turned
    there by half of the step's rotation.
    """
    measurements = gtsam.PreintegratedCombinedMeasurements(params, bias)
    accel_bias, gyro_bias = bias.accelerometer(), bias.gyroscope()
    for force, rate, step in zip(span.linear_acceleration, span.angular_velocity, span.steps_s, strict=True):
        if step > 0.0:
            start_R_middle = so3_exp(0.5 * step * (rate - gyro_bias))
            at_start = start_R_middle @ (force - accel_bias) + accel_bias
            measurements.integrateMeasurement(at_start, rate, step)
    return measurements


def _interpolate(knots: Float, at: Float, values: Float) -> Float:
    return np.column_stack([np.interp(knots, at, values[:, axis]) for axis in range(3)])
