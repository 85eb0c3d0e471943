"""The time offset between cameras and IMU, corrected as it runs."""

from __future__ import annotations

from graphvio.backend.time_offset import TimeOffsetFilter
from graphvio.config import Config
from graphvio.measurements.events import Report
from graphvio.measurements.motion import Quality, VisualResult
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.rig import Rig

_NOTABLE_OFFSET_S = 1e-3
_SURELY = 5.0  # standard deviations


class OffsetCorrection:
    """Later framesets take the IMU at their true instants, once the offset is known well enough.

    Args:
        rig: tells the offset that is taken at first.
        config: tells whether it is estimated at all.
        synchroniser: is told the corrections.
        report: is told, once, of an offset that is not the rig's.
    """

    def __init__(self, rig: Rig, config: Config, synchroniser: Synchroniser, report: Report) -> None:
        self._synchroniser = synchroniser
        self._report = report
        self._nominal_s = 0.0
        self._filter: TimeOffsetFilter | None = None
        self._is_told = False
        if rig.imu is not None and config.fusion.estimate_time_offset:
            self._nominal_s = rig.imu.time_offset_s
            self._filter = TimeOffsetFilter(rig.imu, config.smoother.imu_noise_scale, synchroniser.interval)

    @property
    def offset_s(self) -> float | None:
        """How much later than the framesets' the IMU's stamp of an instant is, or None where it is not estimated."""
        return None if self._filter is None else self._synchroniser.time_offset_s

    @property
    def sigma_s(self) -> float | None:
        """Standard deviation of that."""
        return None if self._filter is None else self._filter.estimate.sigma_s

    def update(self, stamp_ns: int, visual: VisualResult) -> None:
        """Learn from a frameset's motion, and correct."""
        if self._filter is None or visual.motion is None or visual.quality is not Quality.GOOD:
            return
        self._filter.update(visual.motion)
        if not self._filter.estimate.is_usable:
            return
        self._synchroniser.shift_imu(self._filter.corrected())
        offset_s, sigma_s = self._synchroniser.time_offset_s, self._filter.estimate.sigma_s
        off_s = offset_s - self._nominal_s
        if not self._is_told and abs(off_s) > max(_NOTABLE_OFFSET_S, _SURELY * sigma_s):
            self._is_told = True
            self._report(
                stamp_ns,
                "time_offset_off",
                f"the IMU's stamps are {1e3 * off_s:.1f} ms later than the rig says (sigma {1e3 * sigma_s:.1f} ms), as "
                f"rotations tell; corrected for this run: set time_offset_s: {offset_s:.4f} in the rig",
            )
