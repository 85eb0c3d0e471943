"""The IMU between two framesets as one measurement of the motion between them.

C. Forster, L. Carlone, F. Dellaert, D. Scaramuzza, *On-Manifold Preintegration for Real-Time Visual-Inertial
Odometry*, IEEE T-RO 33(1), 2017; in gtsam's form with the biases' random walks.
"""

from __future__ import annotations

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import so3_exp
from graphvio.kernels import kernel
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.sensors import GRAVITY_M_S2
from graphvio.rig import Imu

_INTEGRATION_SIGMA = 3e-5  # m/s^2-like noise that stands for the error of integrating piecewise constant rates


def preintegration_params(
    imu: Imu, noise_scale: float, shown: Float | None = None, position_density: float = 0.0
) -> gtsam.PreintegrationCombinedParams:
    """Return gtsam's parameters for nav z up.

    Args:
        imu: its noise densities.
        noise_scale: factor on these.
        shown: (2,) white noise densities of gyro and accelerometer in this interval, used where they are larger.
        position_density: of white noise of the velocity by which positions are integrated, m/sqrt(s).
    """
    gyro, accel = np.maximum(noise_scale * imu.noise_densities, 0.0 if shown is None else shown)
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY_M_S2)
    params.setGyroscopeCovariance(np.eye(3) * gyro**2)
    params.setAccelerometerCovariance(np.eye(3) * accel**2)
    params.setBiasOmegaCovariance(np.eye(3) * (noise_scale * imu.gyro_random_walk) ** 2)
    params.setBiasAccCovariance(np.eye(3) * (noise_scale * imu.accel_random_walk) ** 2)
    params.setIntegrationCovariance(np.eye(3) * ((noise_scale * _INTEGRATION_SIGMA) ** 2 + position_density**2))
    return params


def preintegrate(
    interval: ImuInterval, params: gtsam.PreintegrationCombinedParams, bias: gtsam.imuBias.ConstantBias
) -> gtsam.PreintegratedCombinedMeasurements:
    """Preintegrate an interval, linearised at a bias.

    A step's mean force is that of its middle, while gtsam takes it in the frame at the step's beginning: it is turned
    there by half of the step's rotation.
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
