"""Collection of keyframes in windows for the self-calibration, with the IMU samples over them."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.measurements.imu_noise import shown_noise
from graphvio.measurements.sensors import ImuSample
from graphvio.rig import Rig
from graphvio.self_calibration.inertial import InertialSamples
from graphvio.self_calibration.window import Keyframe, View, median_displacement_px

WINDOW = 16  # keyframes
FIRST_WINDOW_SIGMA_PX = 0.15
_MIN_DISPLACEMENT_PX = 8.0  # median of a pair's tracks since the last keyframe: a standstill has no keyframes
_IMU_NOISE_FACTOR = 2.0  # on the stated densities, since biases walk within a window, too
_MAX_IMU_GAP_NS = 50_000_000
_MARGIN_NS = 50_000_000  # of IMU samples before a window
_HELD_NS = 30_000_000  # of readings at the ends; a time offset that is wrong by more is found over later windows
_HELD_NOISE_FACTOR = 100.0  # on the variance of a reading that is held
_KEPT_NS = 30_000_000_000  # of IMU samples: a rig that stands may have no keyframes for hours


class FullWindow(NamedTuple):
    """Measurements of a window that is full.

    Attributes:
        keyframes: keyframes, in time order.
        samples: IMU samples over it, or None.
        sigma_px: noise of a corner's position, as it is known from the windows before.
    """

    keyframes: tuple[Keyframe, ...]
    samples: InertialSamples | None
    sigma_px: float


class WindowCollector:
    """Collects keyframes while the images move; windows share no keyframe.

    Args:
        rig: rig of the rig file, with the IMU's noise and time offset.

    Attributes:
        keyframes: keyframes of the window that is being collected.
        stamp_sigma_s: standard deviation of the framesets' stamps.
    """

    def __init__(self, rig: Rig) -> None:
        self.keyframes: list[Keyframe] = []
        self.stamp_sigma_s = 0.0
        self._imu = rig.imu
        self._samples: deque[ImuSample] = deque()
        self._last: Keyframe | None = None

    def add_sample(self, sample: ImuSample) -> None:
        """Add an IMU sample as it was measured, in time order."""
        self._samples.append(sample)
        while sample.stamp_ns - self._samples[0].stamp_ns > _KEPT_NS:
            self._samples.popleft()

    def is_keyframe(self, stamp_ns: int, views: Mapping[int, View], interval_s: float) -> bool:
        """Return whether the images have moved, and the interval has passed, since the last keyframe."""
        last = self._last
        if last is None or not views:
            return bool(views)
        if (stamp_ns - last.stamp_ns) * 1e-9 < interval_s - 1e-3:
            return False
        common = views.keys() & last.views.keys()
        return not common or any(
            median_displacement_px(last.views[j], views[j]) >= _MIN_DISPLACEMENT_PX for j in common
        )

    def add(self, stamp_ns: int, odom_T_body: Float, views: Mapping[int, View]) -> None:
        """Add a keyframe: its stamp, its estimated pose (4, 4), and what was seen."""
        self._last = Keyframe(stamp_ns, odom_T_body, views)
        self.keyframes.append(self._last)

    def begin_window(self) -> None:
        """Begin a window without keyframes; its first one still has to be apart from the last keyframe before it."""
        self.keyframes = []

    def restart(self) -> None:
        """Discard the unfinished window: later poses are in another frame, or their stamps are of another clock."""
        self.keyframes, self._last = [], None

    def forget_samples(self) -> None:
        """Forget the IMU samples until now."""
        self._samples.clear()

    def samples_of(self, window: tuple[Keyframe, ...]) -> InertialSamples | None:
        """Return the IMU samples over a window, or None where there are none; older samples are forgotten."""
        if self._imu is None:
            return None
        first_ns = window[0].stamp_ns + self._imu.time_offset_ns - _MARGIN_NS
        while self._samples and self._samples[0].stamp_ns < first_ns:
            self._samples.popleft()
        if not self._samples:
            return None
        stamps = np.array([sample.stamp_ns - self._imu.time_offset_ns for sample in self._samples])
        values = np.array([[*sample.angular_velocity, *sample.linear_acceleration] for sample in self._samples])
        noise = np.maximum(_IMU_NOISE_FACTOR * self._imu.noise_densities, shown_noise(stamps, values, _MAX_IMU_GAP_NS))
        samples = InertialSamples(
            stamps,
            values,
            np.array([keyframe.stamp_ns for keyframe in window]),
            np.hypot(noise, _noise_of_stamps(window, values[:, :3], self.stamp_sigma_s)),
            _MAX_IMU_GAP_NS,
            np.ones((len(stamps), 2)),
        )
        return _with_held_ends(samples)


def _with_held_ends(samples: InertialSamples) -> InertialSamples:
    """Return samples whose first and last readings are held for longer, if another time offset would need more samples.

    Without that, where the IMU begins with the images or a window ends with the last frameset, the search for the
    offset would lose an interval.
    """
    stamps, readings, factors = samples.stamps_ns, samples.readings, samples.noise_factors
    if stamps[0] > samples.keyframes_ns[0] - _HELD_NS:
        stamps, readings = np.r_[stamps[0] - _HELD_NS, stamps], np.concatenate([readings[:1], readings])
        factors = np.concatenate([np.full((1, 2), _HELD_NOISE_FACTOR), factors])
    if stamps[-1] < samples.keyframes_ns[-1] + _HELD_NS:
        stamps, readings = np.r_[stamps, stamps[-1] + _HELD_NS], np.concatenate([readings, readings[-1:]])
        factors = np.concatenate([factors, factors[-1:]])
        factors[-2:] = _HELD_NOISE_FACTOR
    return samples._replace(stamps_ns=stamps, readings=readings, noise_factors=factors)


def _noise_of_stamps(window: tuple[Keyframe, ...], rates: Float, sigma_s: float) -> Float:
    """Return white noise densities (2,) of gyro and accelerometer that have the effect of noisy stamps of keyframes.

    Args:
        window: K keyframes.
        rates: (N, 3) angular velocities over the window.
        sigma_s: standard deviation of the stamps.
    """
    if sigma_s == 0.0 or len(window) < 2:
        return np.zeros(2)
    intervals_s = 1e-9 * np.diff([keyframe.stamp_ns for keyframe in window])
    steps_m = np.diff([keyframe.odom_T_body[:3, 3] for keyframe in window], axis=0)
    dt, rate2 = float(np.median(intervals_s)), np.mean(np.sum(rates**2, axis=1))
    speed2 = np.mean(np.sum(steps_m**2, axis=1) / intervals_s**2)
    # In an interval that is longer than its stamps say, the rig turns and moves by more. White noise of the
    # accelerometer adds a third of its squared density times the cube of the interval to the position's variance.
    longer2 = 2.0 * sigma_s**2
    return np.asarray(np.sqrt([longer2 * rate2 / dt, 3.0 * longer2 * speed2 / dt**3]))
