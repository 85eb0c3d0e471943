"""Preintegration of the IMU between two framesets into one measurement of the motion between them.

C. Forster, L. Carlone, F. Dellaert, D. Scaramuzza, *On-Manifold Preintegration for Real-Time Visual-Inertial
Odometry*, IEEE T-RO 33(1), 2017; in gtsam's form with the biases' random walks.
"""

from __future__ import annotations

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.backend.states import RigState
from graphvio.geometry import so3_exp
from graphvio.kernels import kernel
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.sensors import GRAVITY_M_S2
from graphvio.rig import Imu

_INTEGRATION_SIGMA = 3e-5  # like a noise in m/s^2: the error of integrating piecewise constant rates
_MIN_STAMP_SIGMA_S = 1e-4  # stamps with a larger sigma count as jittering


def preintegration_params(imu: Imu, noise_scale: float) -> gtsam.PreintegrationCombinedParams:
    """Return gtsam's parameters for nav z up, with the rig's noise densities times a factor."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY_M_S2)
    params.setGyroscopeCovariance(np.eye(3) * (noise_scale * imu.gyro_noise_density) ** 2)
    params.setAccelerometerCovariance(np.eye(3) * (noise_scale * imu.accel_noise_density) ** 2)
    params.setBiasOmegaCovariance(np.eye(3) * (noise_scale * imu.gyro_random_walk) ** 2)
    params.setBiasAccCovariance(np.eye(3) * (noise_scale * imu.accel_random_walk) ** 2)
    params.setIntegrationCovariance(np.eye(3) * (noise_scale * _INTEGRATION_SIGMA) ** 2)
    return params


def is_as_stated(interval: ImuInterval, imu: Imu, noise_scale: float) -> bool:
    """Return whether the samples show no more than the rig file's noise, and the framesets' stamps do not jitter."""
    is_more = interval.noise_densities > noise_scale * imu.noise_densities
    return interval.stamp_sigma_s < _MIN_STAMP_SIGMA_S and not is_more.any()


def interval_params(
    interval: ImuInterval, imu: Imu, noise_scale: float, state: RigState
) -> gtsam.PreintegrationCombinedParams:
    """Return gtsam's parameters for an interval, with the noise that its samples show and the jitter of its stamps.

    Args:
        interval: the interval to be preintegrated.
        imu: the rig's IMU.
        noise_scale: factor on the IMU's noise densities, which are used where the samples show less noise.
        state: the state at the interval's beginning.
    """
    params, dt = preintegration_params(imu, noise_scale), float(interval.steps_s.sum())
    gyro, accel = np.maximum(noise_scale * imu.noise_densities, interval.noise_densities)
    # If an interval is longer than its stamps say, the rig turns, speeds up and moves on in it; taken as white noise.
    longer2 = 2.0 * interval.stamp_sigma_s**2 / dt
    turn2 = longer2 * float(np.sum((interval.mean_rate - state.gyro_bias) ** 2))
    faster2 = longer2 * float((np.linalg.norm(interval.mean_force) - GRAVITY_M_S2) ** 2)
    moved2 = longer2 * float(np.sum(state.velocity_nav**2))
    params.setGyroscopeCovariance(np.eye(3) * (gyro**2 + turn2))
    params.setAccelerometerCovariance(np.eye(3) * (accel**2 + faster2))
    params.setIntegrationCovariance(np.eye(3) * ((noise_scale * _INTEGRATION_SIGMA) ** 2 + moved2))
    return params


def preintegrate(
    interval: ImuInterval, params: gtsam.PreintegrationCombinedParams, bias: gtsam.imuBias.ConstantBias
) -> gtsam.PreintegratedCombinedMeasurements:
    """Preintegrate an interval, linearised at a bias.

    A step's mean force is in the body frame at its middle, while gtsam expects it in the frame at the step's beginning:
    it is rotated to there by half of the step's rotation.
    """
    measurements = gtsam.PreintegratedCombinedMeasurements(params, bias)
    forces = _at_start(interval.steps_s, interval.angular_velocity, interval.linear_acceleration, bias.vector())
    for force, rate, step in zip(forces, interval.angular_velocity, interval.steps_s.tolist(), strict=True):
        if step > 0.0:
            measurements.integrateMeasurement(force, rate, step)
    return measurements


@kernel
def _at_start(steps_s: Float, rates: Float, forces: Float, bias: Float) -> Float:
    """Return the mean forces (N, 3) in the frames at the steps' beginnings; bias (6,) of accelerometer and gyro."""
    turned = np.empty_like(forces)
    for i in range(len(steps_s)):
        start_R_middle = so3_exp(0.5 * steps_s[i] * (rates[i] - bias[3:]))
        for r in range(3):
            turned[i, r] = bias[r]
            for c in range(3):
                turned[i, r] += start_R_middle[r, c] * (forces[i, c] - bias[c])
    return turned
