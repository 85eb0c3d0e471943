"""States of a window, and the layout of their unknowns in the window's equations.

Unknowns are ``[poses 6 K, velocities 3 K, gravity 3, gyro and accelerometer bias 6, calibration F]`` of K states; the
landmarks are eliminated. Biases and calibration are the same in the whole window; their random walk is added when a
state leaves it. The calibration is ``[cameras C * SINGLE, IMU without its biases 19]``, see
`graphvio.self_calibration.parameters`: the difference from the rig file, which is estimated, or taken as zero.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.geometry import so3_exp, so3_log
from graphvio.kernels import kernel
from graphvio.monocular.reprojection import Cameras
from graphvio.self_calibration.imu_model import PARAMETERS

BIASES, GRAVITY = 6, 3
_OTHER_IMU = PARAMETERS - BIASES


@dataclass(frozen=True, eq=False)
class States:
    """K states of a window, in time order.

    Attributes:
        stamps_ns: (K,).
        poses: (K, 4, 4) ``odom_T_body``.
        velocities: (K, 3) m/s, frame odom.
        gravity: (3,) m/s^2, frame odom, downwards.
        biases: (6,) biases of gyro, rad/s, and accelerometer, m/s^2.
        calibration: (F,) difference from the rig file; empty where it is not estimated.
    """

    stamps_ns: Int
    poses: Float
    velocities: Float
    gravity: Float
    biases: Float
    calibration: Float = field(default_factory=lambda: np.zeros(0))

    @property
    def parameters(self) -> Float:
        """Parameters (25,) of the IMU, see `graphvio.self_calibration.imu_model`."""
        other = self.calibration[-_OTHER_IMU:] if len(self.calibration) else np.zeros(_OTHER_IMU)
        return np.concatenate([self.biases, other])

    @property
    def n_camera_parameters(self) -> int:
        """Number of the cameras' parameters."""
        return max(len(self.calibration) - _OTHER_IMU, 0)

    def cameras(self, of_file: Cameras) -> Cameras:
        """Return the cameras with the states' calibration, from those of the rig file."""
        return of_file.moved(self.calibration[: self.n_camera_parameters]) if self.calibration.any() else of_file

    @property
    def falls(self) -> Float:
        """(K, 2, 3) motion of body in free fall for t seconds, in body: the coefficients of t and of its square."""
        falls = np.stack([self.velocities, np.broadcast_to(0.5 * self.gravity, self.velocities.shape)], axis=1)
        return np.ascontiguousarray(falls @ self.poses[:, :3, :3])

    def of(self, kept: Int) -> States:
        """Return some of the states, by their indices."""
        return replace(self, stamps_ns=self.stamps_ns[kept], poses=self.poses[kept], velocities=self.velocities[kept])

    def turned(self, new_T_odom: Float) -> States:
        """Return the states in another frame, given by ``new_T_odom`` (4, 4)."""
        turn = new_T_odom[:3, :3]
        return replace(
            self, poses=new_T_odom @ self.poses, velocities=self.velocities @ turn.T, gravity=turn @ self.gravity
        )

    def moved(self, step: Float) -> States:
        """Return the states after a step of all unknowns, or of all but the calibration."""
        n = len(self.poses)
        poses = self.poses.copy()
        for pose, of_pose in zip(poses, step[: 6 * n].reshape(n, 6), strict=True):
            pose[:3, 3] += pose[:3, :3] @ of_pose[3:]
            pose[:3, :3] = pose[:3, :3] @ so3_exp(of_pose[:3].copy())
        velocities = step[6 * n : 9 * n].reshape(n, 3)
        gravity, biases, calibration = np.split(step[9 * n :], [GRAVITY, GRAVITY + BIASES])
        return replace(
            self,
            poses=poses,
            velocities=self.velocities + velocities,
            gravity=self.gravity + gravity,
            biases=self.biases + biases,
            calibration=self.calibration + calibration if len(calibration) else self.calibration,
        )

    def since(self, other: States) -> Float:
        """Return the difference of all unknowns from other values of the same states."""
        n = len(self.poses)
        difference = np.empty(9 * n + GRAVITY + BIASES + len(self.calibration))
        for k in range(n):
            then_R_odom = other.poses[k, :3, :3].T
            difference[6 * k : 6 * k + 3] = so3_log(np.ascontiguousarray(then_R_odom @ self.poses[k, :3, :3]))
            difference[6 * k + 3 : 6 * k + 6] = then_R_odom @ (self.poses[k, :3, 3] - other.poses[k, :3, 3])
        difference[6 * n : 9 * n] = (self.velocities - other.velocities).ravel()
        common = (self.gravity - other.gravity, self.biases - other.biases, self.calibration - other.calibration)
        difference[9 * n :] = np.concatenate(common)
        return difference


def columns_of(n: int, states: Int, n_free: int = 0) -> Int:
    """Return the indices of ``[poses, velocities, gravity, biases, calibration]`` of some of n states among all."""
    poses = (6 * states[:, None] + np.arange(6)).ravel()
    velocities = (6 * n + 3 * states[:, None] + np.arange(3)).ravel()
    return np.concatenate([poses, velocities, 9 * n + np.arange(GRAVITY + BIASES + n_free)])


def inertial_columns(n: int, n_camera_parameters: int, n_free: int) -> Int:
    """Return the indices of the unknowns of `inertial_equations`, without its last ones if the calibration is known."""
    known = 9 * n + GRAVITY + BIASES
    return np.concatenate([np.arange(known), np.arange(known + n_camera_parameters, known + n_free)])


def visual_columns(n: int, n_camera_parameters: int, n_free: int) -> Int:
    """Return the indices of the unknowns of `visual_equations`: poses, and cameras unless the calibration is known."""
    known = 9 * n + GRAVITY + BIASES
    return np.concatenate([np.arange(6 * n), known + np.arange(n_camera_parameters if n_free else 0)])


@kernel
def add_block(hessian: Float, columns: Int, block: Float) -> None:
    """Add the first M rows and columns of a block to the rows and columns (M,) of a Hessian (N, N)."""
    for r in range(len(columns)):
        for c in range(len(columns)):
            hessian[columns[r], columns[c]] += block[r, c]


def size_m(positions: Float) -> float:
    """Return the rms distance of positions (K, 3) from their mean."""
    return float(np.sqrt(((positions - positions.mean(axis=0)) ** 2).sum(axis=1).mean()))
