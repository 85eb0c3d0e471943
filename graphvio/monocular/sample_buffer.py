"""Buffer of the IMU samples of the estimator's window, in time order, as far as the newest state needs them."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.config import Config
from graphvio.measurements.imu_noise import shown_noise
from graphvio.rig import Imu
from graphvio.self_calibration.inertial import InertialSamples
from graphvio.self_calibration.preintegration import Preintegrated, covering_samples, preintegrate

_MARGIN_NS = 100_000_000
MAX_TIME_OFFSET_NS = 30_000_000
"""Largest error of a rig file's time offset."""
_MAX_BRIDGED_NS = 5_000_000_000 + MAX_TIME_OFFSET_NS


class SampleBuffer:
    """Keeps the samples between the oldest state that is of use and the newest one.

    Gaps of up to 5 s are bridged: readings are interpolated, or the newest one is held, and their noise becomes that of
    a motion that is not measured. The cameras carry the scale across a gap.

    Args:
        imu: The rig's IMU.
        config: Configuration: what a gap is, the factor on the IMU's stated noise, and how a rig may move while that is
            not measured.

    Attributes:
        time_offset_s: Estimated offset of the samples' stamps from those of the framesets.
    """

    def __init__(self, imu: Imu, config: Config) -> None:
        smoother = config.smoother
        self._stated_noise = self._noise = smoother.imu_noise_scale * imu.noise_densities
        self._unmeasured = np.array([smoother.motion_angular_accel_sigma_rad_s2, smoother.motion_accel_sigma_m_s2])
        self._max_gap_ns = round(config.timing.max_imu_gap_ms * 1e6)
        self.time_offset_s = 0.0
        self._waiting_ns: list[int] = []
        self._waiting: list[Float] = []
        self._stamps_ns, self._readings = np.zeros(0, dtype=np.int64), np.zeros((0, 6))

    def add(self, stamp_ns: int, values: Float) -> None:
        """Add a sample (6,), gyro in rad/s and accelerometer in m/s^2, stamped on the framesets' clock."""
        self._waiting_ns.append(stamp_ns)
        self._waiting.append(values)

    def collect(self, oldest_ns: int, until_ns: int) -> None:
        """Use the samples that have come, up to the first one after ``until_ns``; forget those before ``oldest_ns``.

        Later samples wait: they would change the integration next to the stamp, so that results would depend on when
        they came.
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

    def covers(self, start_ns: int, end_ns: int, bridges: bool = True) -> bool:
        """Return whether there are samples between two stamps without gaps, except for those that can be bridged."""
        samples = self.between(np.array([start_ns, end_ns]), is_offset_known=True, bridges=bridges)
        return covering_samples(samples.stamps_ns, start_ns, end_ns, self.time_offset_s, samples.max_gap_ns)[1] >= 0

    def preintegrated(self, start_ns: int, end_ns: int, parameters: Float) -> Preintegrated:
        """Integrate the samples in use between two stamps, with the IMU's parameters (25,).

        Raises:
            MeasurementError: If the samples do not cover the interval.
        """
        samples = self.between(np.array([start_ns, end_ns]), is_offset_known=True)
        return preintegrate(
            samples.stamps_ns, samples.readings, start_ns, end_ns, parameters, samples.noise_densities,
            samples.max_gap_ns, samples.noise_factors,
        )  # fmt: skip

    def between(self, stamps_ns: Int, is_offset_known: bool, bridges: bool = True) -> InertialSamples:
        """Return the samples in use, for the intervals between the stamps (K,) of states.

        Args:
            stamps_ns: (K,) stamps of the states.
            is_offset_known: whether the time offset is taken as known, and stays as it is.
            bridges: whether an interval is covered where samples are missing in it.
        """
        stamps, readings = self._extended(is_offset_known)
        if not bridges or not len(stamps):
            factors = np.ones((len(stamps), 2))
            return InertialSamples(stamps, readings, stamps_ns, self._noise, self._max_gap_ns, factors)
        steps_ns = np.diff(stamps)
        is_missing = (steps_ns > self._max_gap_ns) & (steps_ns <= _MAX_BRIDGED_NS)
        until_ns = stamps_ns[-1] + int(np.ceil(self.time_offset_s * 1e9))
        held_ns = until_ns + MAX_TIME_OFFSET_NS
        if stamps[-1] < until_ns and held_ns - stamps[-1] <= _MAX_BRIDGED_NS:
            stamps = np.append(stamps, held_ns)
            readings = np.concatenate([readings, readings[-1:]])
            is_missing = np.append(is_missing, True)
        samples = InertialSamples(stamps, readings, stamps_ns, self._noise, _MAX_BRIDGED_NS, np.ones((len(stamps), 2)))
        return self._bridged(samples, is_missing) if is_missing.any() else samples

    def _bridged(self, samples: InertialSamples, is_missing: Bool) -> InertialSamples:
        """Return samples with the noise of unmeasured motion in those of the N - 1 steps between them that are missing.

        Such steps are divided at the states, since the unmeasured motion differs from one interval to the next.
        """
        before_ns, states_ns = samples.stamps_ns, samples.keyframes_ns + self._offset_ns
        within = (states_ns > before_ns[0]) & (states_ns < before_ns[-1])
        is_in_gap = is_missing[np.searchsorted(before_ns, states_ns[within]) - 1]
        stamps = np.union1d(before_ns, states_ns[within][is_in_gap])
        readings = np.stack([np.interp(stamps, before_ns, values) for values in samples.readings.T], axis=1)
        step = np.searchsorted(before_ns, stamps[:-1], side="right") - 1  # the step that each part belongs to
        missing = np.flatnonzero(is_missing[step])
        gaps_s, parts_s = 1e-9 * np.diff(before_ns)[step[missing]], 1e-9 * np.diff(stamps)[missing]
        # The force errs by the unmeasured acceleration, the rate by its own change until it is measured again.
        sigmas = self._unmeasured * np.stack([gaps_s, np.ones_like(gaps_s)], axis=1)
        factors = np.ones((len(stamps), 2))
        factors[missing] += parts_s[:, None] * (sigmas / self._noise) ** 2
        return samples._replace(stamps_ns=stamps, readings=readings, noise_factors=factors)

    @property
    def _offset_ns(self) -> int:
        return round(self.time_offset_s * 1e9)

    def _extended(self, is_offset_known: bool = True) -> tuple[Int, Float]:
        """Return the samples in use; unless their time offset is known to be zero, the newest reading is held longer.

        A new estimate of the offset may need samples that have not come yet; they are there at the next framesets.
        """
        is_exact = is_offset_known and self.time_offset_s == 0.0
        if is_exact or not len(self._stamps_ns):
            return self._stamps_ns, self._readings
        held_ns = self._stamps_ns[-1] + min(MAX_TIME_OFFSET_NS, self._max_gap_ns)
        return np.append(self._stamps_ns, held_ns), np.concatenate([self._readings, self._readings[-1:]])
