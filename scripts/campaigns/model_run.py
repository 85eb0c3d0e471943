"""One run of the smoother alone, on errors that are drawn from its own model."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from campaigns.drawn import DrawnVision, Template
from graphvio.arrays import Float
from graphvio.backend.inertial import ImuBuffer
from graphvio.backend.smoother import Smoother
from graphvio.backend.states import RigState, StartUncertainty, origin_covariance
from graphvio.config import SmootherConfig
from graphvio.events import ImuSample
from graphvio.geometry import se3_exp, se3_inverse, se3_log
from graphvio.rig import Imu
from graphvio.simulation import build_scene
from graphvio.simulation.imu import ImuTrack, measure

SCENES = ("room", "stairs", "calibration", "corridor")
_RATE_HZ = 20
_SETTLED_S = 2.0
_TILT_SIGMA, _SPEED_SIGMA, _GYRO_BIAS_SIGMA, _ACCEL_BIAS_SIGMA = 0.02, 0.2, 0.01, 0.2  # the last is the smoother's
_FIRST_GYRO_BIAS, _FIRST_ACCEL_BIAS = 4e-3, 4e-2  # that the simulator's IMU has

Square = tuple[str, float, float, int]
"""What it is of, seconds, squared Mahalanobis distance, dimensions."""


def model_run(seed: int, templates: dict[int, Template], duration_s: float) -> list[Square]:
    """One run, and its squares at each second."""
    return list(_ModelRun(seed, templates, duration_s).squares())


class _ModelRun:
    def __init__(self, seed: int, templates: dict[int, Template], duration_s: float) -> None:
        self._rng = np.random.default_rng([seed, 7])
        self._imu, self._steps = Imu(), round(min(duration_s, (max(templates) - 1) / _RATE_HZ) * _RATE_HZ)
        motion = build_scene(SCENES[seed % len(SCENES)], duration_s + 1.0).motion
        times = np.arange(round((duration_s + 0.5) * self._imu.rate_hz)) / self._imu.rate_hz
        stamps = np.round(times * 1e9).astype(np.int64)
        self._track = measure(motion, self._imu, times, stamps, seed)
        extra = [
            np.sqrt(all_of_it**2 - simulated**2) * self._rng.standard_normal(3)
            for all_of_it, simulated in ((_GYRO_BIAS_SIGMA, _FIRST_GYRO_BIAS), (_ACCEL_BIAS_SIGMA, _FIRST_ACCEL_BIAS))
        ]
        self._biases = self._track.gyro_bias + extra[0], self._track.accel_bias + extra[1]
        self._buffer = _filled(self._track, *extra)
        self._stamps = [round(k * 1e9 / _RATE_HZ) for k in range(self._steps + 1)]
        states = motion.at(np.array(self._stamps) * 1e-9)
        self._truth, self._velocities = states.world_T_body, states.velocity
        self._vision = DrawnVision(templates, self._truth, self._stamps, self._rng)
        self._smoother = Smoother(SmootherConfig(imu_noise_scale=1.0), self._imu)

    def squares(self) -> Iterator[Square]:
        """Go through the run."""
        smoother = self._smoother
        self._start()
        anchors = {1: 0, 10: 0}  # seconds -> frameset from which the motion is measured
        for k in range(1, self._steps + 1):
            span = self._buffer.span(self._stamps[k - 1], self._stamps[k])
            smoother.extend(self._stamps[k], span)
            motion = self._vision.at(k)
            if motion is not None and smoother.knows(motion.reference_stamp_ns):
                verdict = smoother.test(motion)
                if k > _SETTLED_S * _RATE_HZ:
                    yield "vision", k / _RATE_HZ, verdict.statistic, 6
                if verdict.accepted:
                    smoother.accept(motion)
            kept = {self._stamps[number] for number in anchors.values()}
            following = self._vision.reference(k + 1)
            kept |= set() if following is None else {self._stamps[following]}
            smoother.settle(kept)
            if k % _RATE_HZ == 0 and k >= _SETTLED_S * _RATE_HZ:
                yield from self._state_squares(k)
            for seconds, anchor in anchors.items():
                if k - anchor == seconds * _RATE_HZ:
                    if anchor >= _SETTLED_S * _RATE_HZ:
                        yield self._motion_square(f"pose over {seconds} s", anchor, k)
                    anchors[seconds] = k

    def _start(self) -> None:
        """At the truth, but for errors of the start."""
        rng, pose = self._rng, self._truth[0]
        covariance = origin_covariance(pose[:3, :3], _TILT_SIGMA)
        known = StartUncertainty(covariance, _SPEED_SIGMA, _GYRO_BIAS_SIGMA)
        off = np.linalg.cholesky(covariance) @ rng.standard_normal(6)
        velocity = self._velocities[0] + _SPEED_SIGMA * rng.standard_normal(3)
        self._smoother.start(0, RigState(pose @ se3_exp(off), velocity, np.zeros(3), np.zeros(3)), known)

    def _state_squares(self, k: int) -> Iterator[Square]:
        time_s, state, known = k / _RATE_HZ, self._smoother.state(), self._smoother.state_covariance()
        sample = round(time_s * self._imu.rate_hz)
        assert known.velocity is not None
        assert known.gyro_bias is not None
        assert known.accel_bias is not None
        for name, error, covariance in (
            ("velocity", self._velocities[k] - state.velocity_nav, known.velocity),
            ("tilt", *tilt_error(state.nav_T_body, self._truth[k], known.pose)),
            ("gyro bias", self._biases[0][sample] - state.gyro_bias, known.gyro_bias),
            ("accel bias", self._biases[1][sample] - state.accel_bias, known.accel_bias),
        ):
            yield name, time_s, float(error @ np.linalg.solve(covariance, error)), len(error)

    def _motion_square(self, name: str, start: int, end: int) -> Square:
        smoother = self._smoother
        estimated = se3_inverse(smoother.pose(self._stamps[start])) @ smoother.pose(self._stamps[end])
        true = np.linalg.inv(self._truth[start]) @ self._truth[end]
        error = se3_log(np.ascontiguousarray(se3_inverse(estimated) @ true))
        covariance = smoother.covariance_since(self._stamps[start])
        return name, end / _RATE_HZ, float(error @ np.linalg.solve(covariance, error)), 6


def tilt_error(nav_T_body: Float, true: Float, covariance: Float) -> tuple[Float, Float]:
    """Error (2,) of roll and pitch about nav's horizontal axes, and its covariance (2, 2), from the pose's (6, 6)."""
    rotation = nav_T_body[:3, :3]
    off = np.eye(4)
    off[:3, :3] = true[:3, :3] @ rotation.T
    about_nav = rotation @ covariance[:3, :3] @ rotation.T
    return se3_log(off)[:2], about_nav[:2, :2]


def _filled(track: ImuTrack, gyro_bias: Float, accel_bias: Float) -> ImuBuffer:
    buffer = ImuBuffer(50.0)
    for stamp, rate, force in zip(
        track.stamps_ns.tolist(), track.angular_velocity, track.linear_acceleration, strict=True
    ):
        buffer.add(ImuSample(stamp, rate + gyro_bias, force + accel_bias))
    return buffer
