"""IMU readings around a frameset: the interval before it, a standstill, the motion during the readout of its images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.estimator import ImuFaultTolerant, StateEstimator
from graphvio.backend.initialisation import shows_standstill
from graphvio.backend.time_offset import integrated_rates
from graphvio.config import Config
from graphvio.frontend.tracking.rolling_shutter import ReadoutMotion
from graphvio.geometry import se3
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import Quality, RelativeMotion, VisualResult
from graphvio.monocular.estimator import MonocularEstimator
from graphvio.odometry.clock_watch import ClockWatch
from graphvio.odometry.imu_clock import ImuClock
from graphvio.odometry.imu_watch import ImuWatch
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.rig import Rig

_MAX_VELOCITY_SIGMA_M_S = 0.1  # above this, images measure the velocity better


class FramesetImu:
    """Provides the IMU readings of a synchroniser as the odometry uses them at each frameset.

    Args:
        rig: Cameras and IMU.
        config: Configuration of all stages.
        synchroniser: Keeps the samples.
        estimator: Estimator of the state.
        report: Receives stamp, kind and detail of an event.
    """

    def __init__(
        self,
        rig: Rig,
        config: Config,
        synchroniser: Synchroniser,
        estimator: StateEstimator,
        report: Report,
    ) -> None:
        self._timing = config.timing
        self._initialisation = config.initialisation
        self._synchroniser = synchroniser
        self._estimator = estimator
        self._report = report
        self._clock = ImuClock(config.timing.max_imu_wait_ms * 1e-3, synchroniser, report)
        self._watch: ImuWatch | None = None
        self._clock_watch: ClockWatch | None = None
        if rig.imu is not None and isinstance(estimator, ImuFaultTolerant):
            self._watch = ImuWatch(config.smoother.max_gated_s, self._clock, synchroniser, report)
        elif isinstance(estimator, MonocularEstimator):
            self._clock_watch = ClockWatch(rig, self._clock, synchroniser)
        self._readout_ns = max(camera.readout_ns for camera in rig.cameras)
        self._first_ns: int | None = None
        self._initialisations = 0

    @property
    def is_left_out(self) -> bool:
        """Whether the IMU is left out, see `ImuWatch`."""
        return self._watch is not None and self._watch.is_left_out

    @property
    def warnings(self) -> list[str]:
        """Warnings where the IMU contradicts the rig, a sentence each."""
        return self._clock.warnings if self._watch is None else self._watch.warnings

    @property
    def clock_shift_s(self) -> float:
        """Time, s, by which the IMU's stamps were found to be later than by the rig's time offset."""
        return self._clock.shift_s

    def watch(
        self, stamp_ns: int, interval: ImuInterval | None, visual: VisualResult, applied: RelativeMotion | None
    ) -> bool:
        """Leave the IMU out while it contradicts vision, and use an IMU whose samples come late.

        With single cameras, which need the IMU, its clock is corrected instead.

        Args:
            stamp_ns: Stamp of a frameset by which the state has been updated.
            interval: The IMU readings before it that have been used, or None.
            visual: The front-end's result for the frameset.
            applied: The motion by vision that the state has been updated by, or None.

        Returns:
            Whether the use of the IMU changed: it is left out, or used, from now on, or its clock was corrected.
        """
        if self._clock_watch is not None:
            assert isinstance(self._estimator, MonocularEstimator)
            is_corrected = self._clock_watch.update(stamp_ns, visual.camera_tracks, self._estimator.has_pose)
            if is_corrected:
                self._estimator.restart_imu(stamp_ns)
            self._estimator.doubt_imu(stamp_ns, self._clock_watch.is_doubted)
            return is_corrected
        if self._watch is None:
            return False
        assert isinstance(self._estimator, ImuFaultTolerant)
        if applied is not None and visual.quality is Quality.GOOD and not self._estimator.has_imu:
            imu = self._synchroniser.initial_interval(stamp_ns)
            if imu is not None:
                self._estimator.use_late_imu(applied, imu)
                return True
        was_left_out = self.is_left_out
        gate_result = None if interval is None else self._estimator.gate_results.get("vision")
        match = self._watch.update(stamp_ns, visual, gate_result, is_applied=applied is not None)
        if match is not None and applied is not None:
            self._estimator.use_imu_again(applied, match)
        if self.is_left_out and not was_left_out:
            self._estimator.leave_imu_out()
        return self.is_left_out != was_left_out

    def is_awaited(self, stamp_ns: int) -> bool:
        """Whether the IMU's first sample, from which the state is to be initialised, is still awaited."""
        if self._estimator.is_initialised:
            return False
        if self._first_ns is None:
            self._first_ns = stamp_ns
        longest_ns = self._timing.max_imu_start_wait_s * 1e9
        return self._synchroniser.precedes_imu(stamp_ns) and stamp_ns - self._first_ns < longest_ns

    def begins(self, stamp_ns: int) -> bool:
        """Whether to initialise: at the first frameset, or where a late IMU begins an epoch (else see `watch`)."""
        if self._estimator.has_imu:
            return False
        if not self._estimator.is_initialised:
            return True
        return self._watch is None and self._synchroniser.initial_interval(stamp_ns) is not None

    def interval(self, start_ns: int, end_ns: int) -> ImuInterval | None:
        """Return the IMU readings between two framesets, or None where samples are missing, or the IMU is left out."""
        if not self._estimator.has_imu or self.is_left_out:
            return None
        interval = self._synchroniser.interval(start_ns, end_ns)
        if interval is None:
            self._report(
                end_ns,
                EventKind.IMU_NOT_COVERING,
                "IMU samples are missing since the frameset before: the motion is predicted without them",
            )
        return interval

    def gyro_rotation_since(self, then_ns: int) -> Float | None:
        """Return ``now_T_then`` (4, 4) of body from a frameset to the newest one, by the gyro and without translation.

        It is the only prediction while single cameras have no pose; None once they have one, or if the gyro is doubted.
        """
        is_doubted = self._clock_watch is not None and self._clock_watch.is_doubted
        if self._estimator.has_pose or not self._estimator.has_imu or is_doubted:
            return None
        interval = self._synchroniser.interval(then_ns, self._estimator.latest_ns)
        if interval is None:
            return None
        then_R_now, _ = integrated_rates(interval.steps_s, interval.angular_velocity)
        return se3(np.ascontiguousarray(then_R_now.T), np.zeros(3))

    def readout_motion(self, stamp_ns: int) -> ReadoutMotion | None:
        """Return body's motion by the IMU while rolling shutters read a frameset out; None without rolling shutters."""
        if not self._readout_ns or not self._estimator.has_imu or self.is_left_out:
            return None
        interval = self._synchroniser.interval_after(stamp_ns, self._readout_ns)
        if interval is None:
            return None
        if not self._estimator.has_pose:
            return ReadoutMotion.by_imu(interval, np.zeros(3), np.zeros(3))
        state = self._estimator.state()
        body_R_nav = state.nav_T_body[:3, :3].T
        readout = ReadoutMotion.by_imu(interval, state.gyro_bias, state.accel_bias)
        readout = readout.falling(body_R_nav @ state.velocity_nav, body_R_nav @ state.gravity_nav)
        # The covariance is that of the last frameset: after an initialisation since then it is not of this state.
        covariance, initialisations = self._estimator.covariance.velocity, self._initialisations
        self._initialisations = self._estimator.initialisations
        if covariance is None or initialisations != self._initialisations:
            return readout
        if np.linalg.eigvalsh(covariance)[-1] > _MAX_VELOCITY_SIGMA_M_S**2:
            return readout
        return replace(readout, velocity_covariance=body_R_nav @ covariance @ body_R_nav.T)

    def shows_standstill(self, interval: ImuInterval | None) -> bool:
        """Whether the IMU shows a standstill; True while no IMU is used, False where samples are missing."""
        if interval is None:
            return not self._estimator.has_imu
        return shows_standstill(interval, self._initialisation)
