"""What views of landmarks say of the poses from which they were seen, once the landmarks are eliminated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Bool, Float, Int

_MIN_INFORMATION = 1e-6  # of a pose that is eliminated: next to nothing, it keeps its block invertible


@dataclass(frozen=True, eq=False)
class WindowViews:
    """Views of landmarks from K states, as a quadratic cost of the states' poses.

    The cost is ``gradient . d + d . information d / 2``, for small changes d of the poses. It does not change if all
    poses move together; where nothing shows the scale, neither with that.

    Attributes:
        stamps_ns: (K,) of the states, increasing.
        poses: (K, 4, 4) ``nav_T_body`` at which it was linearised.
        information: (6 K, 6 K), tangents ``[rotation, translation]`` on the right, in body at each.
        gradient: (6 K,) at these poses.
    """

    stamps_ns: Int
    poses: Float
    information: Float
    gradient: Float

    def of(self, kept: Bool) -> WindowViews:
        """Return what they say of some of the states (K,), whatever the poses of the others may be."""
        rows = np.repeat(kept, 6)
        if rows.all():
            return self
        left = self.information[np.ix_(~rows, ~rows)] + _MIN_INFORMATION * np.eye(int((~rows).sum()))
        gain = np.linalg.solve(left, self.information[np.ix_(~rows, rows)]).T
        information = self.information[np.ix_(rows, rows)] - gain @ self.information[np.ix_(~rows, rows)]
        return WindowViews(
            self.stamps_ns[kept],
            self.poses[kept],
            0.5 * (information + information.T),
            self.gradient[rows] - gain @ self.gradient[~rows],
        )


@dataclass(frozen=True, eq=False)
class FirstWindow:
    """What is known of the first states of an epoch from before its first pose, as a quadratic cost.

    Attributes:
        stamps_ns: (K,) of the states, increasing.
        poses: (K, 4, 4) ``nav_T_body`` at which it was linearised.
        velocity: (3,) m/s, of the first state in nav.
        gravity: (3,) m/s^2, in nav.
        biases: (6,) of gyro, rad/s, and accelerometer, m/s^2.
        information: (6 K + 12, 6 K + 12) of poses, velocity, gravity and biases.
        gradient: (6 K + 12,).
    """

    stamps_ns: Int
    poses: Float
    velocity: Float
    gravity: Float
    biases: Float
    information: Float
    gradient: Float
