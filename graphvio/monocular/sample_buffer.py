"""IMU samples of the estimator's window, in time order, as far as the newest state needs them."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.measurements.imu_noise import shown_noise
from graphvio.rig import Imu
from graphvio.self_calibration.inertial import InertialSamples
from graphvio.self_calibration.preintegration import Preintegrated, covering_samples, preintegrate

_MARGIN_NS = 100_000_000
MAX_TIME_OFFSET_NS = 30_000_000
"""By which the time offset of a rig file may be wrong."""


class SampleBuffer:
    """Keeps the samples between the oldest state that is of use and the newest one.

    Args:
        imu: Of the rig.
        noise_scale: Factor on its stated white noise.
        max_gap_ns: Between samples of one interval.

    Attributes:
        time_offset_s: Of the samples' stamps from those of the framesets, as it is estimated.
    """

    def __init__(self, imu: Imu, noise_scale: float, max_gap_ns: int) -> None:
        self._stated_noise = self._noise = noise_scale * imu.noise_densities
        self._max_gap_ns = max_gap_ns
        self.time_offset_s = 0.0
        self._waiting_ns: list[int] = []
        self._waiting: list[Float] = []
        self._stamps_ns, self._readings = np.zeros(0, dtype=np.int64), np.zeros((0, 6))

    def add(self, stamp_ns: int, values: Float) -> None:
        """Take a sample (6,), gyro in rad/s and accelerometer in m/s^2, stamped on the framesets' clock."""
        self._waiting_ns.append(stamp_ns)
        self._waiting.append(values)

    def collect(self, oldest_ns: int, until_ns: int) -> None:
        """Use the samples that have come, up to the first one after a stamp; forget those from before another one.

        Later ones would change the integration next to the stamp, and results would depend on when they came.
        """
        stamps, readings = self._stamps_ns, self._readings
        if self._waiting_ns:
            stamps = np.concatenate([stamps, self._waiting_ns])
            readings = np.concatenate([readings, self._waiting])
            order = np.argsort(stamps, kind="stable")  # a corrected time offset may have moved the newest ones
            stamps, readings = stamps[order], readings[order]
        first = max(int(np.searchsorted(stamps, oldest_ns - _MARGIN_NS)) - 1, 0)
        end = int(np.searchsorted(stamps, until_ns + self._offset_ns)) + 1
        self._waiting_ns, self._waiting = stamps[end:].tolist(), list(readings[end:])
        self._stamps_ns, self._readings = stamps[first:end], readings[first:end]
        self._noise = np.maximum(self._stated_noise, shown_noise(self._stamps_ns, self._readings, self._max_gap_ns))

    def reaches(self, stamp_ns: int) -> bool:
        """Return whether a sample in use is as late as a stamp, or later."""
        return bool((self._stamps_ns[-1:] >= stamp_ns).any())

    def covers(self, start_ns: int, end_ns: int) -> bool:
        """Return whether the samples in use have no gap between two stamps."""
        stamps, _ = self._extended()
        return bool(covering_samples(stamps, start_ns, end_ns, self.time_offset_s, self._max_gap_ns)[1] >= 0)

    def preintegrated(self, start_ns: int, end_ns: int, parameters: Float) -> Preintegrated:
        """Integrate the samples in use between two stamps, by the IMU's parameters (25,).

        Raises:
            MeasurementError: If they do not cover it.
        """
        return preintegrate(*self._extended(), start_ns, end_ns, parameters, self._noise, self._max_gap_ns)

    def between(self, stamps_ns: Int, is_offset_known: bool) -> InertialSamples:
        """Return the samples in use, for the intervals between the stamps (K,) of states.

        Args:
            stamps_ns: (K,).
            is_offset_known: whether the time offset is taken for known, and stays as it is.
        """
        return InertialSamples(*self._extended(is_offset_known), stamps_ns, self._noise, self._max_gap_ns)

    @property
    def _offset_ns(self) -> int:
        return round(self.time_offset_s * 1e9)

    def _extended(self, is_offset_known: bool = True) -> tuple[Int, Float]:
        """Return the samples in use; where their time offset is estimated, the newest reading lasts a little longer.

        An offset that has just been found may ask for samples that have not come; the next framesets have them.
        """
        is_exact = is_offset_known and self.time_offset_s == 0.0
        if is_exact or not len(self._stamps_ns):
            return self._stamps_ns, self._readings
        held_ns = self._stamps_ns[-1] + min(MAX_TIME_OFFSET_NS, self._max_gap_ns)
        return np.append(self._stamps_ns, held_ns), np.concatenate([self._readings, self._readings[-1:]])
