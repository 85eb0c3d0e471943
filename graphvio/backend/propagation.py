"""Prediction of poses between framesets and beyond the newest one, from the newest state and the IMU since then.

Samples are collected as they come, and propagated when a prediction asks for them. One thread may predict while another
processes a frameset: the path is replaced as a whole, and only grows at its end.
"""

from __future__ import annotations

from bisect import bisect_right
from threading import Lock

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.backend.states import RigState
from graphvio.geometry import multiply, rotate, se3, se3_compose, se3_exp, so3_exp
from graphvio.kernels import kernel
from graphvio.measurements.estimate import Prediction

_MAX_BLIND_NS = 5_000_000_000  # longest propagation by the IMU without a frameset


class Propagator:
    """Predicts from the newest state, see `graphvio.odometry.Odometry.predict`.

    Args:
        longest_ms: Longest prediction beyond the newest sample, or without samples beyond the newest frameset.
        max_gap_ms: Longest gap between samples that a prediction crosses.
    """

    def __init__(self, longest_ms: float, max_gap_ms: float) -> None:
        self._longest_ns = round(longest_ms * 1e6)
        self._max_gap_ns = round(max_gap_ms * 1e6)
        self._path: _Path | None = None

    def forget(self) -> None:
        """Forget the state: nothing is predicted until `restart`."""
        self._path = None

    def restart(self, stamp_ns: int, state: RigState, epoch: int, rate: Float, stamps: Int, values: Float) -> None:
        """Predict from a new state.

        Args:
            stamp_ns: Stamp of the state.
            state: The rig at that instant.
            epoch: Epoch of the state.
            rate: (3,) angular rate of body, rad/s. Without samples, it and the velocity in body are assumed constant.
            stamps: (N,) stamps of the IMU samples on the framesets' clock; the first is the state's, or there are none.
            values: (N, 6) values of the samples: angular velocity and specific force.
        """
        path = _Path(stamp_ns, state, epoch, rate, values[0] if len(values) else None)
        for stamp, sample in zip(stamps[1:].tolist(), values[1:], strict=True):
            if stamp - path.stamps[-1] > self._max_gap_ns:
                break
            path.add(stamp, sample)
        self._path = path

    def add(self, stamp_ns: int, sample: Float) -> bool:
        """Add an IMU sample (6,), and return whether it extends the path: it is newer, without too long a gap."""
        path = self._path
        if path is None or not path.samples or stamp_ns <= path.stamps[-1]:
            return False
        if stamp_ns - path.stamps[-1] > self._max_gap_ns or stamp_ns - path.stamps[0] > _MAX_BLIND_NS:
            self._path = None  # the motion in a gap is unknown, and an IMU alone drifts too far
            return False
        path.add(stamp_ns, sample)
        return True

    def predict(self, stamp_ns: int) -> Prediction | None:
        """Return the prediction at an instant, or None if none is possible."""
        path = self._path
        return None if path is None else path.predict(stamp_ns, self._longest_ns)


class _Path:
    """A state and its propagation by the IMU samples since then; without an IMU there are no samples.

    Stamps are appended last, so that a reader in another thread finds everything that belongs to a stamp.
    """

    def __init__(self, stamp_ns: int, state: RigState, epoch: int, rate: Float, sample: Float | None) -> None:
        self.poses, self.velocities = [state.nav_T_body], [state.velocity_nav]
        self.samples = [] if sample is None else [sample]
        self.stamps = [stamp_ns]
        self._growing = Lock()
        self._epoch = epoch
        self._bias = np.concatenate([state.gyro_bias, state.accel_bias])
        self._gravity = state.gravity_nav
        self._twist = np.concatenate([rate, state.nav_T_body[:3, :3].T @ state.velocity_nav])

    def add(self, stamp_ns: int, sample: Float) -> None:
        """Add a sample (6,)."""
        self.samples.append(sample)
        self.stamps.append(stamp_ns)

    def _propagate(self, end: int) -> None:
        """Propagate poses and velocities up to sample ``end``."""
        with self._growing:
            for i in range(len(self.poses), end + 1):
                mean = 0.5 * (self.samples[i - 1] + self.samples[i])
                pose, velocity = self._after(i - 1, self.stamps[i] - self.stamps[i - 1], mean)
                self.poses.append(pose)
                self.velocities.append(velocity)

    def predict(self, stamp_ns: int, longest_ns: int) -> Prediction | None:
        """Return the state at an instant, at most ``longest_ns`` after the newest sample, or None."""
        i = bisect_right(self.stamps, stamp_ns) - 1
        if i < 0:
            return None  # the state that the path begins with is newer
        is_newest = i == len(self.stamps) - 1
        after_ns = stamp_ns - self.stamps[i]
        if is_newest and after_ns > longest_ns:
            return None
        if not self.samples:
            pose = se3_compose(self.poses[i], se3_exp(self._twist * (after_ns * 1e-9)))
            return Prediction(stamp_ns, pose, pose[:3, :3] @ self._twist[3:], self._twist[:3], self._epoch)
        self._propagate(i)
        sample = now = self.samples[i]
        if not is_newest:
            fraction = after_ns / (self.stamps[i + 1] - self.stamps[i])
            now = sample + fraction * (self.samples[i + 1] - sample)
        pose, velocity = self._after(i, after_ns, 0.5 * (sample + now))
        return Prediction(stamp_ns, pose, velocity, now[:3] - self._bias[:3], self._epoch)

    def _after(self, i: int, duration_ns: int, mean: Float) -> tuple[Float, Float]:
        return advanced(self.poses[i], self.velocities[i], mean, self._bias, self._gravity, duration_ns * 1e-9)


@kernel
def advanced(
    nav_T_body: Float, velocity_nav: Float, mean: Float, bias: Float, gravity_nav: Float, duration_s: float
) -> tuple[Float, Float]:
    """Return pose (4, 4) and velocity (3,) after a step with a mean rate and specific force (6,), less biases (6,).

    The mean force is taken as the force at the middle of the step, and rotated by the attitude there.
    """
    turn = duration_s * (mean[:3] - bias[:3])
    half_turned = multiply(nav_T_body, so3_exp(0.5 * turn))
    acceleration = rotate(half_turned, mean[3:] - bias[3:]) + gravity_nav
    position = nav_T_body[:3, 3] + duration_s * velocity_nav + 0.5 * duration_s**2 * acceleration
    return se3(multiply(nav_T_body, so3_exp(turn)), position), velocity_nav + duration_s * acceleration
