"""Measurements from before an epoch's first pose, as a factor on the epoch's first states in a session's graph.

Single cameras have no pose until the scale is known. The images and IMU samples until then give a quadratic cost of the
first poses, and of velocity, gravity and biases. The frame of these poses is arbitrary, so the cost is rewritten as one
of the poses relative to the first of them, and of velocity and gravity in the body frame at the first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import gtsam
import numpy as np

from graphvio.arrays import Float, Int
from graphvio.backend.factors import b, v, x
from graphvio.geometry import se3_adjoint, se3_inverse, skew
from graphvio.measurements.sensors import GRAVITY_M_S2
from graphvio.measurements.window_views import FirstWindow
from graphvio.optimization.views import RelativePoses, root_of

_OTHERS = 12  # dimension of velocity, gravity and biases
_GRAVITY_NAV = np.array([0.0, 0.0, -GRAVITY_M_S2])


class FirstWindows(NamedTuple):
    """V costs as columns; the states of cost i are rows ``begins[i]`` to ``begins[i + 1]`` of ``row`` and ``poses``."""

    begins: Int  # (V + 1,)
    row: Int  # (S,) rows of the framesets
    poses: Float  # (S, 4, 4) ``nav_T_body`` at which the cost was linearised
    # (V, 12) velocity (m/s) and gravity (m/s^2) in body at the first state, biases of gyro and accelerometer
    others: Float
    gradient: Float  # concatenated, 6 K + 6 numbers for a cost of K states
    information: Float  # concatenated, (6 K + 6)^2 numbers for a cost of K states

    def at(self, number: int) -> tuple[Int, Float, Float, Float, Float]:
        """Return a cost's rows (K,), poses (K, 4, 4), ``others`` (12,), information and gradient.

        Information and gradient are those of the relative poses and of ``others``, 6 K + 6 dimensions.
        """
        states = slice(int(self.begins[number]), int(self.begins[number + 1]))
        sizes = 6 * np.diff(self.begins) + 6
        size, begin, begin2 = int(sizes[number]), int(sizes[:number].sum()), int((sizes[:number] ** 2).sum())
        return (
            self.row[states],
            self.poses[states],
            self.others[number],
            self.information[begin2 : begin2 + size**2].reshape(size, size),
            self.gradient[begin : begin + size],
        )

    @staticmethod
    def of(given: Iterable[FirstWindow], row_of: Mapping[int, int]) -> FirstWindows:
        """Collect the costs whose states all have a row; ``row_of`` gives the row of a stamp."""
        kept = [each for each in given if all(int(ns) in row_of for ns in each.stamps_ns)]
        relative = [_relative(each) for each in kept]
        return FirstWindows(
            np.cumsum([0, *(len(each.stamps_ns) for each in kept)], dtype=np.int64),
            np.array([row_of[int(ns)] for each in kept for ns in each.stamps_ns], dtype=np.int64),
            np.concatenate([np.zeros((0, 4, 4)), *(each.poses for each in kept)]),
            np.array([others for others, _, _ in relative]).reshape(-1, _OTHERS),
            np.concatenate([np.zeros(0), *(gradient for _, _, gradient in relative)]),
            np.concatenate([np.zeros(0), *(information.ravel() for _, information, _ in relative)]),
        )


def _relative(start: FirstWindow) -> tuple[Float, Float, Float]:
    """Return ``others`` (12,), and information and gradient of relative poses and ``others``, first pose eliminated."""
    n = len(start.poses)
    first_R_nav = start.poses[0, :3, :3].T
    velocity, gravity = first_R_nav @ start.velocity, first_R_nav @ start.gravity
    by_relative = np.eye(6 * n + _OTHERS)
    for k in range(1, n):
        pose_T_first = np.ascontiguousarray(se3_inverse(start.poses[k]) @ start.poses[0])
        by_relative[6 * k : 6 * k + 6, :6] = se3_adjoint(pose_T_first)
    for at, vector in ((6 * n, velocity), (6 * n + 3, gravity)):
        by_relative[at : at + 3, at : at + 3] = first_R_nav.T
        by_relative[at : at + 3, :3] = -first_R_nav.T @ skew(vector)
    information = by_relative.T @ start.information @ by_relative
    gradient = by_relative.T @ start.gradient
    gain = np.linalg.solve(information[:6, :6], information[:6, 6:]).T
    eliminated = information[6:, 6:] - gain @ information[:6, 6:]
    others = np.concatenate([velocity, gravity, start.biases])
    return others, 0.5 * (eliminated + eliminated.T), gradient[6:] - gain @ gradient[:6]


def first_window_factor(
    states: Int, poses: Float, others: Float, information: Float, gradient: Float
) -> gtsam.CustomFactor:
    """Return the factor between the poses of K states, and velocity and biases of the first.

    Args:
        states: numbers (K,) of the states in the graph.
        poses: poses (K, 4, 4) at which the cost was linearised.
        others: velocity and gravity in body at the first state, and biases (12,).
        information: information (6 K + 6, 6 K + 6) of relative poses and ``others``.
        gradient: gradient (6 K + 6,) of the cost, likewise.
    """
    root, offset = root_of(information, gradient)
    keys = [*(x(int(k)) for k in states), v(int(states[0])), b(int(states[0]))]
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(root)), keys, _error(root, offset, poses, others))


def _error(
    root: Float, offset: Float, poses: Float, others: Float
) -> Callable[[gtsam.CustomFactor, gtsam.Values, list[Float] | None], Float]:
    """Return the error ``root d + offset`` with its derivatives; d is the change of relative poses and ``others``."""
    relative = RelativePoses(root, poses)
    of_velocity, of_gravity, of_gyro, of_accel = np.split(root[:, 6 * (len(poses) - 1) :], 4, axis=1)

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, derivatives: list[Float] | None) -> Float:
        """Return the error, and write its derivatives where gtsam asks for them."""
        *of_poses, of_first, of_bias = factor.keys()
        now = [values.atPose3(key).matrix() for key in of_poses]
        inverse = se3_inverse(now[0])
        velocity, gravity = inverse[:3, :3] @ values.atVector(of_first), inverse[:3, :3] @ _GRAVITY_NAV
        bias = values.atConstantBias(of_bias)
        residual = offset + of_velocity @ (velocity - others[:3]) + of_gravity @ (gravity - others[3:6])
        residual += of_gyro @ (bias.gyroscope() - others[6:9]) + of_accel @ (bias.accelerometer() - others[9:])
        by_first = relative.add_to(residual, now, derivatives)
        if derivatives is not None:
            by_first[:, :3] += of_velocity @ skew(velocity) + of_gravity @ skew(gravity)
            derivatives[0] = np.asfortranarray(by_first)
            derivatives[-2] = np.asfortranarray(of_velocity @ inverse[:3, :3])
            derivatives[-1] = np.asfortranarray(np.hstack([of_accel, of_gyro]))
        return np.asarray(residual)

    return error
