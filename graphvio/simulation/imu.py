"""The simulated IMU; a sample is the instantaneous value at its stamp, in frame body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.rig import Imu
from graphvio.simulation.calibration_error import ImuError
from graphvio.simulation.motion import Motion, MotionStates

GRAVITY_MPS2 = 9.81
_FIRST_GYRO_BIAS = 4e-3
_FIRST_ACCEL_BIAS = 4e-2


@dataclass(frozen=True, eq=False)
class ImuTrack:
    """IMU samples, and the truth at the same stamps.

    Attributes:
        stamps_ns: (N,), on the IMU's clock.
        true_stamps_ns: (N,), the same instants on the cameras' clock.
        angular_velocity: (N, 3) rad/s, measured.
        linear_acceleration: (N, 3) m/s^2, measured specific force.
        gyro_bias: (N, 3) rad/s, true.
        accel_bias: (N, 3) m/s^2, true.
        states: true states of the body.
    """

    stamps_ns: Int
    true_stamps_ns: Int
    angular_velocity: Float
    linear_acceleration: Float
    gyro_bias: Float
    accel_bias: Float
    states: MotionStates


def ideal_readings(states: MotionStates) -> tuple[Float, Float]:
    """Compute noise-free IMU readings.

    Args:
        states: true states of the body at N times.

    Returns:
        Angular velocity (N, 3) in rad/s and specific force (N, 3) in m/s^2, frame body.
    """
    force_world = states.acceleration + np.array([0.0, 0.0, GRAVITY_MPS2])
    body_R_world = np.swapaxes(states.world_T_body[:, :3, :3], 1, 2)
    return states.angular_velocity, np.einsum("nij,nj->ni", body_R_world, force_world)


def measure(
    motion: Motion, imu: Imu, times_s: Float, stamps_ns: Int, seed: int, error: ImuError | None = None
) -> ImuTrack:
    """Sample the IMU along a motion, with white noise and random-walk biases.

    Args:
        motion: motion of the body.
        imu: rate, noise densities and time offset.
        times_s: (N,) seconds since the start of the motion.
        stamps_ns: (N,) stamps of these times on the cameras' clock.
        seed: seed of the noise, the initial biases and their random walks.
        error: scale and misalignment errors, or None.
    """
    states = motion.at(times_s)
    rate, force = ideal_readings(states)
    if error is not None:
        rate, force = rate @ error.gyro_matrix.T, force @ error.accel_matrix.T
    random = np.random.default_rng(np.random.SeedSequence([seed, 1]))
    n, root = len(times_s), np.sqrt(imu.rate_hz)

    def bias(first: float, walk: float) -> Float:
        steps = walk / root * random.standard_normal((n, 3))
        steps[0] = first * random.standard_normal(3)
        return np.cumsum(steps, axis=0)

    gyro_bias = bias(_FIRST_GYRO_BIAS, imu.gyro_random_walk)
    accel_bias = bias(_FIRST_ACCEL_BIAS, imu.accel_random_walk)
    gyro_noise = imu.gyro_noise_density * root * random.standard_normal((n, 3))
    accel_noise = imu.accel_noise_density * root * random.standard_normal((n, 3))
    measured = rate + gyro_bias + gyro_noise, force + accel_bias + accel_noise
    return ImuTrack(stamps_ns + imu.time_offset_ns, stamps_ns, *measured, gyro_bias, accel_bias, states)
