"""Online estimation of the time offset between cameras and IMU."""

from __future__ import annotations

from graphvio.backend.time_offset import TimeOffsetFilter
from graphvio.config import Config
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.motion import Quality, VisualResult
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.rig import Rig

_MIN_REPORTED_S = 1e-3
_MIN_SIGMAS = 5.0  # significance of a difference from the rig that is reported


class TimeOffsetCorrection:
    """Corrects the synchroniser's time offset once it is known well enough.

    Args:
        rig: The rig, with the nominal offset.
        config: Configuration, which says whether the offset is estimated at all.
        synchroniser: Receives the corrections.
        report: Receives one event if the offset differs from the rig's.
    """

    def __init__(self, rig: Rig, config: Config, synchroniser: Synchroniser, report: Report) -> None:
        self._synchroniser = synchroniser
        self._report = report
        self._nominal_s = 0.0
        self._filter: TimeOffsetFilter | None = None
        self._is_reported = False
        if rig.imu is not None and config.fusion.estimate_time_offset:
            self._nominal_s = rig.imu.time_offset_s
            self._filter = TimeOffsetFilter(rig.imu, config.smoother.imu_noise_scale, synchroniser.interval)

    @property
    def offset_s(self) -> float | None:
        """The IMU's stamp less the framesets' stamp of the same instant, or None where it is not estimated."""
        return None if self._filter is None else self._synchroniser.time_offset_s

    @property
    def sigma_s(self) -> float | None:
        """Standard deviation of `offset_s`, or None."""
        return None if self._filter is None else self._filter.estimate.sigma_s

    def update(self, stamp_ns: int, visual: VisualResult) -> None:
        """Update the estimate of the offset with a frameset's motion, and correct the offset."""
        if self._filter is None or visual.motion is None or visual.quality is not Quality.GOOD:
            return
        self._filter.update(visual.motion)
        if not self._filter.estimate.is_usable:
            return
        self._synchroniser.add_to_time_offset(self._filter.corrected())
        offset_s, sigma_s = self._synchroniser.time_offset_s, self._filter.estimate.sigma_s
        off_s = offset_s - self._nominal_s
        if not self._is_reported and abs(off_s) > max(_MIN_REPORTED_S, _MIN_SIGMAS * sigma_s):
            self._is_reported = True
            self._report(
                stamp_ns,
                EventKind.TIME_OFFSET_OFF,
                f"rotations show that the IMU's stamps are {1e3 * off_s:.1f} ms later than in the rig (sigma "
                f"{1e3 * sigma_s:.1f} ms); corrected for this run: set time_offset_s: {offset_s:.4f} in the rig",
            )
