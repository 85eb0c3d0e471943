"""Information of landmark views on the poses from which they were seen, after elimination of the landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Bool, Float, Int

_MIN_INFORMATION = 1e-6  # added to that of an eliminated pose: negligible, but keeps its block invertible


@dataclass(frozen=True, eq=False)
class WindowViews:
    """Views of landmarks from K states, as a quadratic cost of the states' poses.

    The cost is ``gradient . d + d . information d / 2``, for small changes d of the poses. It does not change if all
    poses move together, nor with the scale where no measurement determines it.

    Attributes:
        stamps_ns: (K,) stamps of the states, increasing.
        poses: (K, 4, 4) ``nav_T_body`` at which the cost was linearised.
        information: (6 K, 6 K), tangents ``[rotation, translation]`` on the right, in body at each.
        gradient: (6 K,) at these poses.
    """

    stamps_ns: Int
    poses: Float
    information: Float
    gradient: Float

    def of(self, kept: Bool) -> WindowViews:
        """Return the cost of the states that are kept (K,), after elimination of the poses of the others."""
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
    """Information on the first states of an epoch from before its first pose, as a quadratic cost.

    Attributes:
        stamps_ns: (K,) stamps of the states, increasing.
        poses: (K, 4, 4) ``nav_T_body`` at which the cost was linearised.
        velocity: (3,) velocity of the first state in nav, m/s.
        gravity: (3,) gravity in nav, m/s^2.
        biases: (6,) biases of gyro, rad/s, and accelerometer, m/s^2.
        information: (6 K + 12, 6 K + 12) of poses, velocity, gravity and biases.
        gradient: (6 K + 12,) at these values.
    """

    stamps_ns: Int
    poses: Float
    velocity: Float
    gravity: Float
    biases: Float
    information: Float
    gradient: Float
