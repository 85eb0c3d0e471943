"""Reconstruction of a recorded IMU's true states from the recorded positions and the IMU alone.

The orientations in such a recording may differ from those of the IMU, so they are not used. A batch optimisation over
the whole recording estimates the IMU's poses, velocities and biases, and the point of the body whose positions were
measured.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from campaigns.flight import STEP_NS, Flight, Truth
from graphvio.arrays import Float, Int
from graphvio.backend.factors import b, v, x
from graphvio.backend.noise import isotropic
from graphvio.backend.preintegration import preintegrate, preintegration_params
from graphvio.backend.states import StateCovariance
from graphvio.geometry import so3_log
from graphvio.measurements.sensors import GRAVITY_M_S2
from graphvio.rig import Imu

_POSITION_SIGMA_M, _LEVER_ARM_SIGMA_M, _BIAS_SIGMA = 1e-3, 0.1, 1.0
_LEVER_ARM = int(gtsam.symbol("l", 0))


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Result of the batch optimisation over a flight.

    Attributes:
        truth: the reconstructed states.
        lever_arm: (3,) m, in body: the point whose positions were measured.
        chi_square: twice the cost of the solution.
        freedom: expected value of ``chi_square``: the number of residuals minus that of unknowns.
    """

    truth: Truth
    lever_arm: Float
    chi_square: float
    freedom: int
    _marginals: gtsam.Marginals

    def covariances(self, numbers: Int) -> dict[int, StateCovariance]:
        """Return the covariances of some states (M,) by number."""
        known = {}
        for k in numbers.tolist():
            biases = self._marginals.marginalCovariance(b(k))
            known[k] = StateCovariance(
                pose=self._marginals.marginalCovariance(x(k)),
                velocity=self._marginals.marginalCovariance(v(k)),
                gyro_bias=biases[3:, 3:],
                accel_bias=biases[:3, :3],
            )
        return known


def reconstruct(flight: Flight, imu: Imu, noise_scale: float, rounds: int = 2) -> Reconstruction:
    """Estimate the states that fit the positions and the IMU of a flight.

    Args:
        flight: the flight; its orientations are used only as initial values.
        imu: model with the IMU's noise densities.
        noise_scale: factor on the noise densities.
        rounds: number of optimisations; each preintegrates the IMU at the biases of the previous one, the first at
            zero.
    """
    recorded, zeros = flight.recorded, np.zeros_like(flight.recorded.gyro_bias)
    truth, lever_arm = Truth(recorded.world_T_body, recorded.velocity_world, zeros, zeros), np.zeros(3)
    params = preintegration_params(imu, noise_scale)
    for _ in range(rounds):
        graph = _graph(flight, truth, params)
        values = gtsam.LevenbergMarquardtOptimizer(graph, _values(truth, lever_arm)).optimize()
        truth, lever_arm = _truth(values, len(flight.stamps_ns)), np.asarray(values.atVector(_LEVER_ARM))
    # A position has three residuals, and a step has as many as a state has unknowns; the first biases have a prior.
    freedom = 3 * len(flight.stamps_ns) - 15 + 6
    return Reconstruction(truth, lever_arm, 2.0 * graph.error(values), freedom, gtsam.Marginals(graph, values))


def turns(recorded: Truth, found: Truth) -> Float:
    """Return rotation vectors (N, 3) rad, in body, from one truth's orientations to another's."""
    recorded_R_found = np.swapaxes(recorded.world_T_body[:, :3, :3], 1, 2) @ found.world_T_body[:, :3, :3]
    return np.array([so3_log(np.ascontiguousarray(turn)) for turn in recorded_R_found])


def force_errors(flight: Flight, truth: Truth, imu: Imu) -> Float:
    """Return the errors (N - 1, 3) m/s^2 of each step's mean specific force against a truth, in body, bias included."""
    step_s, up = 1e-9 * STEP_NS, np.array([0.0, 0.0, GRAVITY_M_S2])
    params, errors = preintegration_params(imu, 1.0), np.empty((len(flight.intervals), 3))
    for k, (interval, bias) in enumerate(zip(flight.intervals, _biases(truth)[:-1], strict=True)):
        gained = truth.velocity_world[k + 1] - truth.velocity_world[k] + step_s * up
        measured = preintegrate(interval, params, bias).deltaVij()
        errors[k] = truth.accel_bias[k] + (measured - truth.world_T_body[k, :3, :3].T @ gained) / step_s
    return errors


def with_synthetic_forces(flight: Flight, errors: Float, density: float, seed: int) -> Flight:
    """Return a flight with the specific forces of a truth, a constant bias and white noise.

    Args:
        flight: the flight with the measured forces.
        errors: (N - 1, 3) m/s^2, `force_errors` of that truth; their mean is the bias.
        density: density of the noise, m/s^2/sqrt(Hz).
        seed: seed of the noise.
    """
    rng, intervals = np.random.default_rng([seed, 13]), []
    for interval, off in zip(flight.intervals, errors - errors.mean(axis=0), strict=True):
        steps_s = np.maximum(interval.steps_s, 1e-9)[:, None]
        noise = density / np.sqrt(steps_s) * rng.standard_normal(interval.linear_acceleration.shape)
        intervals.append(replace(interval, linear_acceleration=interval.linear_acceleration - off + noise))
    return replace(flight, intervals=intervals)


def allan_deviation(values: Float, steps: int) -> Float:
    """Return the Allan deviation (M,) of the columns of ``values`` (N, M), for means over ``steps`` rows."""
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    means = (sums[steps:] - sums[:-steps]) / steps
    return np.asarray(np.sqrt(0.5 * np.mean((means[steps:] - means[:-steps]) ** 2, axis=0)))


def _graph(flight: Flight, around: Truth, params: gtsam.PreintegrationCombinedParams) -> gtsam.NonlinearFactorGraph:
    graph, noise = gtsam.NonlinearFactorGraph(), isotropic(3, _POSITION_SIGMA_M)
    for k, world_T_body in enumerate(flight.recorded.world_T_body):
        graph.add(gtsam.GPSFactorArmCalib(x(k), _LEVER_ARM, world_T_body[:3, 3], noise))
    for k, (interval, bias) in enumerate(zip(flight.intervals, _biases(around)[:-1], strict=True)):
        measured = preintegrate(interval, params, bias)
        graph.add(gtsam.CombinedImuFactor(x(k), v(k), x(k + 1), v(k + 1), b(k), b(k + 1), measured))
    graph.add(gtsam.PriorFactorConstantBias(b(0), gtsam.imuBias.ConstantBias(), isotropic(6, _BIAS_SIGMA)))
    graph.add(gtsam.PriorFactorVector(_LEVER_ARM, np.zeros(3), isotropic(3, _LEVER_ARM_SIGMA_M)))
    return graph


def _values(truth: Truth, lever_arm: Float) -> gtsam.Values:
    values = gtsam.Values()
    for k, bias in enumerate(_biases(truth)):
        values.insert(x(k), gtsam.Pose3(truth.world_T_body[k]))
        values.insert(v(k), truth.velocity_world[k])
        values.insert(b(k), bias)
    values.insert(_LEVER_ARM, lever_arm)
    return values


def _truth(values: gtsam.Values, count: int) -> Truth:
    biases = np.array([values.atConstantBias(b(k)).vector() for k in range(count)])
    return Truth(
        world_T_body=np.array([values.atPose3(x(k)).matrix() for k in range(count)]),
        velocity_world=np.array([values.atVector(v(k)) for k in range(count)]),
        gyro_bias=biases[:, 3:],
        accel_bias=biases[:, :3],
    )


def _biases(truth: Truth) -> list[gtsam.imuBias.ConstantBias]:
    return [gtsam.imuBias.ConstantBias(*both) for both in zip(truth.accel_bias, truth.gyro_bias, strict=True)]
