"""Estimation of the delays between the stamps of pairs that are not triggered together.

Each such pair measures the rotations between its own images, which equal the gyro's rotations between the instants at
which the images were taken. A delay that is the same for all pairs is the IMU's time offset; a difference between two
pairs is an error of their clocks, or of the time that their images take until they are stamped.
"""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.states import RigState
from graphvio.backend.time_offset import TimeOffsetFilter
from graphvio.config import Config
from graphvio.geometry import se3, so3_exp
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.motion import Quality, VisualResult
from graphvio.measurements.sensors import FrameSet
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.rig import Rig

_MIN_CORRECTED_S, _MIN_CORRECTED_SIGMAS = 5e-4, 3.0
_MIN_REPORTED_S, _MIN_REPORTED_SIGMAS = 1e-3, 5.0


class GroupClocks:
    """Corrects the stamps of pairs that come in separate framesets to the clock of the first such pair.

    Args:
        rig: The rig, with its pairs.
        config: Configuration, which says whether calibrations are estimated at all.
        synchroniser: Receives the corrections, and has the IMU samples.
        report: Receives one event for each pair whose stamps are off.
    """

    def __init__(self, rig: Rig, config: Config, synchroniser: Synchroniser, report: Report) -> None:
        is_used = bool(rig.pairs) and len(rig.groups) > 1 and config.fusion.estimator == "smoother"
        self._imu = rig.imu if is_used and config.estimates_calibration else None
        self._names = [group.name for group in rig.groups]
        self._noise_scale = config.smoother.imu_noise_scale
        self._synchroniser = synchroniser
        self._report = report
        self._filters: dict[int, TimeOffsetFilter] = {}  # group -> filter
        self._late_s: dict[int, float] = {}  # group -> delay in use
        self._warnings: dict[int, str] = {}
        self._moves: dict[int, Float] = {}  # stamp -> motion of body until then from the instant of the images

    @property
    def warnings(self) -> list[str]:
        """Warnings about pairs whose stamps are wrong, a sentence each."""
        return list(self._warnings.values())

    def update(self, frameset: FrameSet, visual: VisualResult) -> bool:
        """Update the delays with the motion of a frameset, and correct the stamps of later framesets.

        Returns:
            Whether a correction has changed.
        """
        if (
            self._imu is None
            or len(frameset.images) != 1
            or visual.motion is None
            or visual.quality is not Quality.GOOD
        ):
            return False
        (group,) = frameset.images
        if group not in self._filters:
            self._filters[group] = TimeOffsetFilter(self._imu, self._noise_scale, self._synchroniser.nominal_interval)
        self._filters[group].update(visual.motion)
        first = min(self._filters)
        return group != first and self._correct(frameset.stamp_ns, group, first)

    def motion_to_stamp(self, stamp_ns: int, state: RigState, rate: Float | None) -> Float | None:
        """Return body's motion (4, 4) from the instant of the newest frameset's images to its stamp; None if equal.

        Args:
            stamp_ns: Stamp of the frameset.
            state: State at the instant of its images.
            rate: (3,) angular rate of body, rad/s, or None where it is not known.
        """
        seconds = 1e-9 * (stamp_ns - self._synchroniser.instant_ns(stamp_ns))
        if seconds == 0.0:
            return None
        turned = np.eye(3) if rate is None else so3_exp(seconds * rate)
        self._moves[stamp_ns] = se3(turned, seconds * state.nav_T_body[:3, :3].T @ state.velocity_nav)
        return self._moves[stamp_ns]

    def final_at_stamp(self, stamp_ns: int, estimator_T_body: Float) -> Float:
        """Return the final pose (4, 4) of an earlier frameset at its stamp; to be called once for each frameset."""
        body_T_stamped = self._moves.pop(stamp_ns, None)
        return estimator_T_body if body_T_stamped is None else estimator_T_body @ body_T_stamped

    def restart(self) -> None:
        """Restart the estimation, as the IMU's clock has changed; corrections stay in force."""
        self._filters = {}

    def _correct(self, stamp_ns: int, group: int, first: int) -> bool:
        """Correct the stamps of a group where they are known to differ from those of the first group."""
        own, reference = self._filters[group].estimate, self._filters[first].estimate
        if not (own.is_usable and reference.is_usable):
            return False
        late_s, sigma_s = reference.error_s - own.error_s, float(np.hypot(own.sigma_s, reference.sigma_s))
        if abs(late_s) > max(_MIN_REPORTED_S, _MIN_REPORTED_SIGMAS * sigma_s) and group not in self._warnings:
            late = f"{1e3 * abs(late_s):.1f} ms {'later' if late_s > 0.0 else 'earlier'}"
            self._warnings[group] = (
                f"{self._names[group]}: its stamps are {late} than those of {self._names[first]} "
                f"(sigma {1e3 * sigma_s:.1f} ms), which this run allows for; correct them at their source, or add "
                f"{-late_s:.4f} to stamp_offset_s of its cameras in the rig file"
            )
            self._report(stamp_ns, EventKind.TIME_OFFSET_OFF, self._warnings[group])
        change_s = late_s - self._late_s.get(group, 0.0)
        if abs(change_s) <= max(_MIN_CORRECTED_S, _MIN_CORRECTED_SIGMAS * sigma_s):
            return False
        self._late_s[group] = late_s
        self._synchroniser.set_lateness(group, late_s)
        return True
