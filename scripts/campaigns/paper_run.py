"""A walk with the measurements of the paper's filter, estimated by it, by windows of its model, and by the smoother."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from paper_graph import PaperGraph

from campaigns.walks import FRAMES_HZ, Walk, buffer_of
from graphvio.arrays import Float
from graphvio.backend.ekf.filter import ExtendedKalmanFilter
from graphvio.backend.ekf.measurements import Measurement, VisualRates, accelerometer, gyro, stacked, vision
from graphvio.backend.ekf.process import noise_sigmas
from graphvio.backend.ekf.state import FilterState
from graphvio.backend.smoother import Smoother
from graphvio.backend.states import InitialUncertainty, RigState, origin_covariance
from graphvio.config.stages import FilterConfig, SmootherConfig
from graphvio.geometry import se3_exp, se3_log
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import RelativeMotion

_SIGMAS = np.repeat([1e-3, 2e-3], 3)  # of visual motions from frame to frame: rad and metres
_BLIND_EVERY_S, _BLIND_S = 5.0, 1.0
_TILT_SIGMA, _SPEED_SIGMA, _RATE_SIGMA, _GYRO_BIAS_SIGMA = 0.01, 0.05, 0.1, 0.01


@dataclass(frozen=True, eq=False)
class Track:
    """Errors over a run.

    Attributes:
        position_m: (N, 3) errors of the position.
        velocity_m_s: (N, 3) errors of the velocity, in body.
        tilt_rad: (N, 2) errors of the orientation about nav's horizontal axes.
        heading_rad: (N,) errors of the orientation about nav's vertical axis.
    """

    position_m: Float
    velocity_m_s: Float
    tilt_rad: Float
    heading_rad: Float


class PaperRun:
    """The measurements of a walk, sampled with a seed, and the estimators that process them."""

    def __init__(self, seed: int, duration_s: float) -> None:
        rng, walk = np.random.default_rng([seed, 11]), Walk(seed, duration_s)
        buffer = buffer_of(walk.track)
        self._imu, self._stamps = walk.imu, walk.stamps_ns
        self._truth, self._rates = walk.world_T_body, walk.angular_velocity
        self._velocities = np.einsum("nji,nj->ni", self._truth[:, :3, :3], walk.velocity_world)
        self._intervals: list[ImuInterval] = []
        self._motions: list[RelativeMotion | None] = []
        for k in range(1, len(self._stamps)):
            start_ns, end_ns = self._stamps[k - 1], self._stamps[k]
            interval = buffer.interval(start_ns, end_ns)
            assert interval is not None
            self._intervals.append(interval)
            true = np.linalg.inv(self._truth[k - 1]) @ self._truth[k]
            measured = true @ se3_exp(_SIGMAS * rng.standard_normal(6))
            sees = (k / FRAMES_HZ) % _BLIND_EVERY_S < _BLIND_EVERY_S - _BLIND_S
            self._motions.append(
                RelativeMotion(start_ns, end_ns, measured, np.diag(_SIGMAS**2), np.zeros((6, 6)), 300) if sees else None
            )

    def by_filter(self) -> dict[str, Track]:
        """Estimate by the paper's filter; for the result see `by_graph`."""
        running = ExtendedKalmanFilter(*self._start())
        states = []
        for k in range(1, len(self._stamps)):
            running.predict(*self._process())
            running.update(stacked([each(running.state) for each in self._expectations(k)]))
            states.append((k, running.state))
        return {"newest": self._track(states), "leaving": self._track(states)}

    def by_graph(self, lag: int, iterations: int) -> dict[str, Track]:
        """Estimate by a window of the filter's model.

        Args:
            lag: length of the window in steps.
            iterations: number of iterations in each step.

        Returns:
            ``newest`` -> errors of each state when it was the newest; ``leaving`` -> when it left the window.
        """
        graph = PaperGraph(*self._start(), lag, iterations)
        newest, leaving = [], []
        for k in range(1, len(self._stamps)):
            graph.predict(*self._process())
            for each in self._expectations(k):
                graph.add(each)
            graph.update()
            newest.append((k, graph.state))
            if k >= lag:
                leaving.append((k - lag + 1, graph.oldest))
        return {"newest": self._track(newest), "leaving": self._track(leaving)}

    def by_smoother(self) -> dict[str, Track]:
        """Estimate by the odometry's smoother; for the result see `by_graph`."""
        smoother, (first, _) = Smoother(SmootherConfig(), self._imu), self._start()
        pose = first.nav_T_body
        known = InitialUncertainty(origin_covariance(pose[:3, :3], _TILT_SIGMA), _SPEED_SIGMA, _GYRO_BIAS_SIGMA)
        smoother.initialise(0, RigState(pose, pose[:3, :3] @ first.velocity_body, np.zeros(3), np.zeros(3)), known)
        newest, leaving = [], []
        for k in range(1, len(self._stamps)):
            smoother.extend(self._stamps[k], self._intervals[k - 1])
            motion = self._motions[k - 1]
            if motion is not None:
                smoother.add_motion(motion)
            for stamp_ns, nav_T_body in smoother.update(()):
                number = self._stamps.index(stamp_ns)
                leaving.append((number, _posed(nav_T_body)))
            state = smoother.state()
            in_body = state.nav_T_body[:3, :3].T @ state.velocity_nav
            newest.append((k, _posed(state.nav_T_body, in_body)))
        return {"newest": self._track(newest, self._velocities), "leaving": self._track(leaving)}

    def _start(self) -> tuple[FilterState, Float]:
        pose = self._truth[0]
        covariance = np.diag(np.repeat([1e-3, _TILT_SIGMA, _SPEED_SIGMA, _RATE_SIGMA, _GYRO_BIAS_SIGMA], 3) ** 2)
        first = FilterState(pose[:3, 3].copy(), pose[:3, :3].copy(), self._velocities[0], self._rates[0], np.zeros(3))
        return first, covariance

    @staticmethod
    def _process() -> tuple[float, Float]:
        config, dt = FilterConfig(), 1.0 / FRAMES_HZ
        return dt, noise_sigmas(
            dt, config.accel_sigma_m_s2, config.angular_accel_sigma_rad_s2, config.gyro_bias_walk_rad_s
        )

    def _expectations(self, k: int) -> list[Callable[[FilterState], Measurement]]:
        config, interval, motion = FilterConfig(), self._intervals[k - 1], self._motions[k - 1]
        made: list[Callable[[FilterState], Measurement]] = [
            lambda state: gyro(state, interval.mean_rate, config.gyro_sigma_rad_s),
            lambda state: accelerometer(state, interval.mean_force, config.gravity_sigma_m_s2),
        ]
        if motion is not None:
            rates = VisualRates.of(motion)
            made.append(lambda state: vision(state, rates))
        return made

    def _track(self, states: list[tuple[int, FilterState]], velocities: Float | None = None) -> Track:
        """Return the errors of states, given as number and state. The true velocities (N + 1, 3) default to those of
        the filter, which are means over the step that ends in the state."""
        if velocities is None:
            velocities = np.vstack([self._velocities[:1], 0.5 * (self._velocities[1:] + self._velocities[:-1])])
        errors = []
        for k, state in states:
            true = self._truth[k]
            off = np.eye(4)
            off[:3, :3] = true[:3, :3] @ state.nav_R_body.T
            velocity = velocities[k] - state.velocity_body
            errors.append(np.concatenate([true[:3, 3] - state.position, velocity, se3_log(off)[:3]]))
        table = np.array(errors)
        return Track(table[:, :3], table[:, 3:6], table[:, 6:8], table[:, 8])


def _posed(nav_T_body: Float, velocity_body: Float | None = None) -> FilterState:
    """Return a filter state from a pose and, if known, a velocity; all else is unknown."""
    velocity = np.full(3, np.nan) if velocity_body is None else velocity_body
    return FilterState(nav_T_body[:3, 3], nav_T_body[:3, :3], velocity, np.zeros(3), np.zeros(3))
