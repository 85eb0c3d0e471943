"""Runs of the smoother alone, with errors that are sampled from its own model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import gtsam
import numpy as np

from campaigns.measures import tilt_error
from campaigns.synthetic_vision import SyntheticVision, Template
from campaigns.walks import FRAMES_HZ, Walk, buffer_of
from graphvio.backend.preintegration import preintegrate, preintegration_params
from graphvio.backend.smoother import Smoother
from graphvio.backend.states import InitialUncertainty, RigState, origin_covariance
from graphvio.config.stages import SmootherConfig
from graphvio.geometry import se3_exp, se3_inverse, se3_log
from graphvio.measurements.imu_interval import ImuInterval

_WARM_UP_S = 2.0
_TILT_SIGMA, _SPEED_SIGMA, _GYRO_BIAS_SIGMA, _ACCEL_BIAS_SIGMA = 0.02, 0.2, 0.01, 0.2  # the last is the smoother's
_FIRST_GYRO_BIAS, _FIRST_ACCEL_BIAS = 4e-3, 4e-2  # of the simulator's IMU

Square = tuple[str, float, float, int]
"""Name of the quantity, time in seconds, squared Mahalanobis distance, and its dimensions."""


def model_run(seed: int, templates: dict[int, Template], duration_s: float) -> list[Square]:
    """Run the smoother once, and return the squared Mahalanobis distances at each second."""
    return list(_ModelRun(seed, templates, duration_s).squares())


class _ModelRun:
    def __init__(self, seed: int, templates: dict[int, Template], duration_s: float) -> None:
        self._rng = np.random.default_rng([seed, 7])
        walk = Walk(seed, min(duration_s, (max(templates) - 1) / FRAMES_HZ))
        extra = [
            np.sqrt(all_of_it**2 - simulated**2) * self._rng.standard_normal(3)
            for all_of_it, simulated in ((_GYRO_BIAS_SIGMA, _FIRST_GYRO_BIAS), (_ACCEL_BIAS_SIGMA, _FIRST_ACCEL_BIAS))
        ]
        track = walk.track
        self._track = replace(
            track,
            angular_velocity=track.angular_velocity + extra[0],
            linear_acceleration=track.linear_acceleration + extra[1],
            gyro_bias=track.gyro_bias + extra[0],
            accel_bias=track.accel_bias + extra[1],
        )
        self._buffer, self._imu_rate_hz = buffer_of(self._track), walk.imu.rate_hz
        self._stamps, self._truth, self._velocities = walk.stamps_ns, walk.world_T_body, walk.velocity_world
        self._vision = SyntheticVision(templates, self._truth, self._stamps, self._rng)
        self._smoother = Smoother(SmootherConfig(imu_noise_scale=1.0), walk.imu)
        self._params = preintegration_params(walk.imu, 1.0)

    def squares(self) -> Iterator[Square]:
        """Run the smoother, and yield the squared Mahalanobis distances."""
        smoother = self._smoother
        self._initialise()
        references = {1: 0, 10: 0}  # seconds -> frameset from which the motion is measured
        for k in range(1, len(self._stamps)):
            interval = self._buffer.interval(self._stamps[k - 1], self._stamps[k])
            assert interval is not None
            smoother.extend(self._stamps[k], interval)
            if k > _WARM_UP_S * FRAMES_HZ:
                yield "imu", k / FRAMES_HZ, self._imu_square(interval, k), 15
            motion = self._vision.at(k)
            if motion is not None and smoother.knows(motion.reference_stamp_ns):
                gate = smoother.gate(motion)
                if k > _WARM_UP_S * FRAMES_HZ:
                    yield "vision", k / FRAMES_HZ, gate.statistic, 6
                if gate.accepted:
                    smoother.add_motion(motion)
            kept = {self._stamps[number] for number in references.values()}
            following = self._vision.reference(k + 1)
            kept |= set() if following is None else {self._stamps[following]}
            smoother.update(kept)
            if k % FRAMES_HZ == 0 and k >= _WARM_UP_S * FRAMES_HZ:
                yield from self._state_squares(k)
            for seconds, reference in references.items():
                if k - reference == seconds * FRAMES_HZ:
                    if reference >= _WARM_UP_S * FRAMES_HZ:
                        yield self._motion_square(f"pose over {seconds} s", reference, k)
                    references[seconds] = k

    def _initialise(self) -> None:
        """Initialise the smoother at the true state plus sampled errors."""
        rng, pose = self._rng, self._truth[0]
        covariance = origin_covariance(pose[:3, :3], _TILT_SIGMA)
        known = InitialUncertainty(covariance, _SPEED_SIGMA, _GYRO_BIAS_SIGMA)
        off = np.linalg.cholesky(covariance) @ rng.standard_normal(6)
        velocity = self._velocities[0] + _SPEED_SIGMA * rng.standard_normal(3)
        self._smoother.initialise(0, RigState(pose @ se3_exp(off), velocity, np.zeros(3), np.zeros(3)), known)

    def _state_squares(self, k: int) -> Iterator[Square]:
        time_s, state, known = k / FRAMES_HZ, self._smoother.state(), self._smoother.state_covariance()
        sample = round(time_s * self._imu_rate_hz)
        assert known.velocity is not None
        assert known.gyro_bias is not None
        assert known.accel_bias is not None
        assert known.tilt is not None
        for name, error, covariance in (
            ("velocity", self._velocities[k] - state.velocity_nav, known.velocity),
            ("tilt", tilt_error(state.nav_T_body, state.gravity_nav, self._truth[k]), known.tilt),
            ("gyro bias", self._track.gyro_bias[sample] - state.gyro_bias, known.gyro_bias),
            ("accel bias", self._track.accel_bias[sample] - state.accel_bias, known.accel_bias),
        ):
            yield name, time_s, float(error @ np.linalg.solve(covariance, error)), len(error)

    def _imu_square(self, interval: ImuInterval, k: int) -> float:
        """Return the squared Mahalanobis distance of the IMU factor between two framesets (with the biases' random
        walk) at the true states."""
        biases = []
        for number in (k - 1, k):
            sample = round(number / FRAMES_HZ * self._imu_rate_hz)
            biases.append(gtsam.imuBias.ConstantBias(self._track.accel_bias[sample], self._track.gyro_bias[sample]))
        states = [(gtsam.Pose3(self._truth[number]), self._velocities[number]) for number in (k - 1, k)]
        factor = gtsam.CombinedImuFactor(0, 1, 2, 3, 4, 5, preintegrate(interval, self._params, biases[0]))
        values = gtsam.Values()
        for at, (pose, velocity) in enumerate(states):
            values.insert(2 * at, pose)
            values.insert(2 * at + 1, velocity)
            values.insert(4 + at, biases[at])
        return 2.0 * float(factor.error(values))

    def _motion_square(self, name: str, start: int, end: int) -> Square:
        smoother = self._smoother
        estimated = se3_inverse(smoother.pose(self._stamps[start])) @ smoother.pose(self._stamps[end])
        true = np.linalg.inv(self._truth[start]) @ self._truth[end]
        error = se3_log(np.ascontiguousarray(se3_inverse(estimated) @ true))
        covariance = smoother.covariance_since(self._stamps[start])
        return name, end / FRAMES_HZ, float(error @ np.linalg.solve(covariance, error)), 6
