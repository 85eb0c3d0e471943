"""Runs of the smoother alone on a recorded IMU, with visual motions that are sampled around a truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from campaigns.flight import FRAMES_HZ, Flight, Truth
from campaigns.measures import tilt_error
from graphvio.arrays import Float
from graphvio.backend.smoother import Smoother
from graphvio.backend.states import InitialUncertainty, RigState, origin_covariance
from graphvio.config.stages import SmootherConfig
from graphvio.geometry import se3_exp, se3_inverse, se3_log
from graphvio.measurements.motion import RelativeMotion
from graphvio.rig import Imu

_WARM_UP_S = 2.0
_SIGMAS = np.repeat([1e-3, 2e-3], 3)  # of visual motions from frame to frame: rad and metres
_TILT_SIGMA, _SPEED_SIGMA, _GYRO_BIAS_SIGMA = 0.05, 0.2, 0.1
_INTERVALS_S = (1, 10)


@dataclass(frozen=True, eq=False)
class Miss:
    """Error of an estimate, and its reported covariance.

    Attributes:
        name: name of the quantity.
        number: number of the state.
        error: (M,) truth minus estimate.
        covariance: (M, M) reported covariance.
    """

    name: str
    number: int
    error: Float
    covariance: Float


@dataclass(frozen=True, eq=False)
class RealRun:
    """Result of a run.

    Attributes:
        misses: errors of the states at each second, errors of motions, and vision's innovations.
        gyro_biases: (N, 3) rad/s, estimated for each state.
        accel_biases: (N, 3) m/s^2, estimated for each state.
        refused: number of visual motions that the gate refused.
    """

    misses: list[Miss]
    gyro_biases: Float
    accel_biases: Float
    refused: int


def real_run(seed: int, flight: Flight, truth: Truth, config: SmootherConfig, imu: Imu) -> RealRun:
    """Run the smoother on a flight, with vision sampled around a truth; the estimated biases are zero at first."""
    rng = np.random.default_rng([seed, 11])
    smoother = _initialised(flight, truth, config, imu, rng)
    misses: list[Miss] = []
    states, refused = [smoother.state()], 0
    references = dict.fromkeys(_INTERVALS_S, 0)  # seconds -> number of the state from which the motion is measured
    for k in range(1, len(flight.stamps_ns)):
        smoother.extend(flight.stamps_ns[k], flight.intervals[k - 1])
        motion = _measured_motion(flight, truth, k, rng)
        gate = smoother.gate(motion)
        counts = k >= _WARM_UP_S * FRAMES_HZ
        if counts:
            misses.append(Miss("vision", k, gate.innovation, gate.covariance))
        if gate.accepted:
            smoother.add_motion(motion)
        else:
            refused += 1
        smoother.update({flight.stamps_ns[k], *(flight.stamps_ns[number] for number in references.values())})
        states.append(smoother.state())
        if counts and k % FRAMES_HZ == 0:
            misses += _misses_of_state(smoother, truth, k)
        for seconds, reference in references.items():
            if k - reference == seconds * FRAMES_HZ:
                if reference >= _WARM_UP_S * FRAMES_HZ:
                    error, covariance = _motion_error(smoother, flight, truth, reference, k)
                    misses.append(Miss(f"pose over {seconds} s", k, error, covariance))
                references[seconds] = k
    gyro_biases, accel_biases = (
        np.array(each) for each in zip(*((state.gyro_bias, state.accel_bias) for state in states), strict=True)
    )
    return RealRun(misses, gyro_biases, accel_biases, refused)


def _initialised(flight: Flight, truth: Truth, config: SmootherConfig, imu: Imu, rng: np.random.Generator) -> Smoother:
    """Return a smoother that is initialised at the true state plus sampled errors."""
    pose = np.ascontiguousarray(truth.world_T_body[0])
    covariance = origin_covariance(pose[:3, :3], _TILT_SIGMA)
    off = np.linalg.cholesky(covariance) @ rng.standard_normal(6)
    velocity = truth.velocity_world[0] + _SPEED_SIGMA * rng.standard_normal(3)
    smoother = Smoother(config, imu)
    smoother.initialise(
        flight.stamps_ns[0],
        RigState(pose @ se3_exp(off), velocity, np.zeros(3), np.zeros(3)),
        InitialUncertainty(covariance, _SPEED_SIGMA, _GYRO_BIAS_SIGMA),
    )
    return smoother


def _measured_motion(flight: Flight, truth: Truth, k: int, rng: np.random.Generator) -> RelativeMotion:
    """Sample a visual measurement of the motion from frame ``k - 1`` to frame ``k``."""
    moved = _moved(truth, k - 1, k) @ se3_exp(_SIGMAS * rng.standard_normal(6))
    stamps = flight.stamps_ns
    return RelativeMotion(stamps[k - 1], stamps[k], moved, np.diag(_SIGMAS**2), np.zeros((6, 6)), 100)


def _misses_of_state(smoother: Smoother, truth: Truth, k: int) -> Iterator[Miss]:
    state, known = smoother.state(), smoother.state_covariance()
    assert known.velocity is not None
    assert known.gyro_bias is not None
    assert known.accel_bias is not None
    assert known.tilt is not None
    yield Miss("velocity", k, truth.velocity_world[k] - state.velocity_nav, known.velocity)
    yield Miss("tilt", k, tilt_error(state.nav_T_body, state.gravity_nav, truth.world_T_body[k]), known.tilt)
    yield Miss("gyro bias", k, truth.gyro_bias[k] - state.gyro_bias, known.gyro_bias)
    yield Miss("accel bias", k, truth.accel_bias[k] - state.accel_bias, known.accel_bias)


def _motion_error(smoother: Smoother, flight: Flight, truth: Truth, start: int, end: int) -> tuple[Float, Float]:
    """Return error (6,) and covariance (6, 6) of the motion between two states, in body at its end."""
    start_ns, end_ns = flight.stamps_ns[start], flight.stamps_ns[end]
    estimated = se3_inverse(smoother.pose(start_ns)) @ smoother.pose(end_ns)
    return se3_log(se3_inverse(estimated) @ _moved(truth, start, end)), smoother.covariance_since(start_ns)


def _moved(truth: Truth, start: int, end: int) -> Float:
    """Return the true motion ``start_T_end`` (4, 4) of body."""
    poses = truth.world_T_body
    return np.asarray(se3_inverse(np.ascontiguousarray(poses[start])) @ poses[end])
