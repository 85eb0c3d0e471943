"""Runs of the whole odometry on rendered images, each with newly sampled IMU readings."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from benchmarks.recordings import simulated

from campaigns.measures import tilt_error
from campaigns.model_run import Square
from graphvio.backend.smoother_estimator import SmootherEstimator
from graphvio.config import Config
from graphvio.config.stages import MotionConfig, SmootherConfig
from graphvio.geometry import se3_log
from graphvio.measurements.estimate import Estimate
from graphvio.measurements.sensors import ImuSample, Measurement
from graphvio.odometry import Odometry
from graphvio.simulation import build_scene
from graphvio.simulation.imu import ImuTrack, measure
from graphvio.simulation.motion import MotionStates
from graphvio.sources import open_source

SHARED_ERROR_SHARE = MotionConfig().shared_error_share
"""Share for errors of tracking that the points of a motion have in common; the simulator's calibration has no error."""
WITHOUT_SHARE = ", share 0"
_WARM_UP_S = 2.0
_WINDOW_S = {1: 1.0, 10: 10.0}  # duration of a motion -> lag with which the state at its start is still in the window


def rendered_run(seed: int, scene: str, data: Path, duration_s: float) -> list[Square]:
    """Run the odometry once with each setting, and return the squared Mahalanobis distances at each second."""
    source = open_source(simulated(data, scene), to_s=duration_s)
    assert source.rig.imu is not None
    motion = build_scene(scene).motion
    stamps = np.array([e.stamp_ns for e in source if isinstance(e, ImuSample)], dtype=np.int64)
    times = np.clip((stamps - source.start_ns) * 1e-9, 0.0, motion.duration_s)
    track = measure(motion, source.rig.imu, times, stamps, 1000 + seed)
    measurements = [_resampled(measurement, track) for measurement in source]
    squares: list[Square] = []
    for seconds, share in ((1, SHARED_ERROR_SHARE), (10, SHARED_ERROR_SHARE), (10, 0.0)):
        config = Config(
            motion=MotionConfig(shared_error_share=share),
            smoother=SmootherConfig(lag_s=_WINDOW_S[seconds], imu_noise_scale=1.0),
        )
        run = _Run(source.start_ns, Odometry(source.rig, config), track, motion.at(times))
        without = "" if share else WITHOUT_SHARE
        squares += [
            (name + without, time_s, square, dimensions)
            for name, time_s, square, dimensions in run.squares(measurements, seconds)
        ]
    return squares


def _resampled(measurement: Measurement, track: ImuTrack) -> Measurement:
    if not isinstance(measurement, ImuSample):
        return measurement
    i = int(np.searchsorted(track.stamps_ns, measurement.stamp_ns))
    return ImuSample(measurement.stamp_ns, track.angular_velocity[i], track.linear_acceleration[i])


class _Run:
    def __init__(self, start_ns: int, odometry: Odometry, track: ImuTrack, states: MotionStates) -> None:
        self._start_ns, self._odometry, self._track, self._states = start_ns, odometry, track, states

    def squares(self, measurements: list[Measurement], seconds: int) -> Iterator[Square]:
        """Yield the squared Mahalanobis distances of motions over ``seconds`` and, if it is 1, of states and vision."""
        for measurement in measurements:
            estimate = self._odometry.process(measurement)
            if estimate is None:
                continue
            time_s = (estimate.stamp_ns - self._start_ns) * 1e-9
            if seconds == 1 and time_s > _WARM_UP_S and "vision" in estimate.innovations:
                yield "vision", time_s, estimate.innovations["vision"].statistic, 6
            if abs(time_s - round(time_s)) > 1e-3 or time_s < _WARM_UP_S:
                continue
            if seconds == 1:
                yield from self._state_squares(estimate, time_s)
            if round(time_s) % seconds == 0 and time_s - seconds >= _WARM_UP_S:
                yield from self._motion_square(estimate, time_s, seconds)

    def _state_squares(self, estimate: Estimate, time_s: float) -> Iterator[Square]:
        k = self._sample(estimate.stamp_ns)
        if estimate.nav_T_body is None or estimate.velocity_nav is None or estimate.covariance is None:
            return
        true = self._states.world_T_body[k]
        assert estimate.velocity_covariance is not None
        assert estimate.gyro_bias is not None
        assert estimate.gyro_bias_covariance is not None
        assert estimate.accel_bias is not None
        assert estimate.accel_bias_covariance is not None
        assert estimate.gravity_nav is not None
        assert estimate.tilt_covariance is not None
        true_velocity = estimate.nav_T_body[:3, :3] @ true[:3, :3].T @ self._states.velocity[k]  # seen from body
        for name, error, covariance in (
            ("velocity", true_velocity - estimate.velocity_nav, estimate.velocity_covariance),
            ("tilt", tilt_error(estimate.nav_T_body, estimate.gravity_nav, true), estimate.tilt_covariance),
            ("gyro bias", self._track.gyro_bias[k] - estimate.gyro_bias, estimate.gyro_bias_covariance),
            ("accel bias", self._track.accel_bias[k] - estimate.accel_bias, estimate.accel_bias_covariance),
        ):
            yield name, time_s, float(error @ np.linalg.solve(covariance, error)), len(error)

    def _motion_square(self, estimate: Estimate, time_s: float, seconds: int) -> Iterator[Square]:
        estimator = self._odometry._estimator
        assert isinstance(estimator, SmootherEstimator)
        then_ns = estimate.stamp_ns - seconds * 1_000_000_000
        estimator._running.optimize()  # the state at the motion's start was not passed as one to keep
        now_T_then = estimator.motion_since(then_ns)
        if now_T_then is None:
            return
        start, end = (self._states.world_T_body[self._sample(ns)] for ns in (then_ns, estimate.stamp_ns))
        error = se3_log(np.ascontiguousarray(now_T_then @ np.linalg.inv(start) @ end))
        covariance = estimator._running.covariance_since(then_ns)
        yield f"pose over {seconds} s", time_s, float(error @ np.linalg.solve(covariance, error)), 6

    def _sample(self, stamp_ns: int) -> int:
        return int(np.searchsorted(self._track.stamps_ns, stamp_ns))
