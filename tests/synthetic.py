"""Synthetic truth for tests: transforms, a rig of two pairs, points that it sees, and a motion with its IMU."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from graphvio.arrays import AnyArray, Float
from graphvio.backend.inertial import ImuBuffer
from graphvio.frontend.depth.stereo import triangulate
from graphvio.frontend.motion.observations import Observations, RigArrays
from graphvio.measurements.motion import RelativeMotion
from graphvio.measurements.sensors import GRAVITY_M_S2, ImuSample
from graphvio.rig import Camera, Imu, Rig, StereoPair

UP = np.array([0.0, 0.0, GRAVITY_M_S2])  # specific force at a standstill
CAM_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # body_R_cam of a camera that looks along x


def transform(rotation_vector: object, translation: object) -> Float:
    """Transform (4, 4), made with scipy: independent of `graphvio.geometry`."""
    made = np.eye(4)
    made[:3, :3] = Rotation.from_rotvec(np.asarray(rotation_vector, dtype=np.float64)).as_matrix()
    made[:3, 3] = np.asarray(translation, dtype=np.float64)
    return made


def random_transform(rng: np.random.Generator, angle_rad: float, distance_m: float) -> Float:
    """Rotation of this angle about a random axis, translation of this length along another."""
    axis, direction = rng.standard_normal((2, 3))
    return transform(angle_rad * axis / np.linalg.norm(axis), distance_m * direction / np.linalg.norm(direction))


def random_covariance(rng: np.random.Generator, size: int, sigma: float) -> Float:
    """A full covariance (size, size) whose standard deviations are about sigma."""
    root = sigma * (np.eye(size) + 0.3 * rng.standard_normal((size, size)))
    return np.asarray(root @ root.T)


# ------------------------------------------------------------------ rig and points


def two_pair_rig(imu: Imu | None = None) -> Rig:
    """A pair that looks forward and a larger one that looks back; nothing is parallel, so no sign can hide."""
    front = transform([0.0, 0.0, 0.0], [0.07, 0.06, 0.05])
    front[:3, :3] = CAM_AXES
    back = transform([0.03, 0.2, np.pi - 0.1], [-0.15, -0.05, 0.1])
    back[:3, :3] = back[:3, :3] @ CAM_AXES
    pairs = []
    for name, body_T_left, baseline, focal in (("front", front, 0.12, 400.0), ("back", back, 0.2, 500.0)):
        left_T_right = transform([0.01, -0.02, 0.005], [baseline, 0.002, -0.001])
        left, right = (
            Camera(f"{name}_{side}", "radial-tangential", (640, 480), np.array([f, f, 320.0, 240.0]), np.zeros(5), pose)
            for side, f, pose in (("left", focal, body_T_left), ("right", 1.02 * focal, body_T_left @ left_T_right))
        )
        pairs.append(StereoPair(name, left, right))
    return Rig(tuple(pairs), imu, "synthetic")


def seen_points(
    rig: Rig,
    cur_T_ref: Float,
    per_pair: int,
    rng: np.random.Generator,
    sigma_px: float = 0.0,
    outlier_share: float = 0.0,
) -> Observations:
    """What a motion of the rig makes of random points, 1.5 to 20 m away.

    Pixel noise is on all four images of a point; outliers have random places in both current images.
    """
    arrays = RigArrays.of(rig)
    columns: list[list[AnyArray]] = [[] for _ in range(6)]
    for j, pair in enumerate(rig.pairs):
        n = per_pair
        focal = np.array([pair.left.focal_px, pair.right.focal_px])
        half = 0.85 * np.array([320.0, 240.0]) / focal[0]
        rays = np.column_stack([rng.uniform(-half, half, size=(n, 2)), np.ones(n)])
        points = rays / rng.uniform(0.05, 0.67, size=(n, 1))
        left_motion = arrays.cam_T_body[j, 0] @ cur_T_ref @ arrays.body_T_left[j]
        seen = [_normalised(pose, points) for pose in (np.eye(4), pair.right_T_left)]
        seen += [_normalised(pose, points) for pose in (left_motion, pair.right_T_left @ left_motion)]
        noisy = [view + sigma_px / focal[i % 2] * rng.standard_normal((n, 2)) for i, view in enumerate(seen)]
        wrong = rng.random(n) < outlier_share
        for view in noisy[2:]:
            view[wrong] = rng.uniform(-half, half, size=(int(wrong.sum()), 2))
        held, covariances, _ = triangulate(noisy[0], noisy[1], pair.right_T_left, float(focal[0]), float(focal[1]))
        parts = (np.full(n, j), held, covariances, noisy[2], noisy[3], np.ones(n, dtype=bool))
        for column, part in zip(columns, parts, strict=True):
            column.append(part)
    return Observations(*(np.ascontiguousarray(np.concatenate(column)) for column in columns))


def _normalised(cam_T_points: Float, points: Float) -> Float:
    moved = points @ cam_T_points[:3, :3].T + cam_T_points[:3, 3]
    assert moved[:, 2].min() > 0.2
    return np.asarray(moved[:, :2] / moved[:, 2:])


# ------------------------------------------------------------------ motion and IMU


def pose_at(time_s: float) -> Float:
    """``nav_T_body`` (4, 4) of a brisk walk with all axes excited: metres, at 0.8 m/s and more."""
    t = time_s
    yaw, pitch, roll = 0.5 * np.sin(0.7 * t), 0.12 * np.sin(2.3 * t + 0.4), 0.1 * np.sin(1.9 * t)
    made = np.eye(4)
    made[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    made[:3, 3] = [0.8 * t + 0.1 * np.sin(3.0 * t), 0.6 * np.sin(0.9 * t), 0.05 * np.sin(8.0 * t)]
    return made


def velocity_at(time_s: float) -> Float:
    """Velocity (3,) in nav."""
    h = 1e-4
    return np.asarray((pose_at(time_s + h)[:3, 3] - pose_at(time_s - h)[:3, 3]) / (2.0 * h))


@cache
def imu_at(time_s: float) -> tuple[Float, Float]:
    """True angular rate and specific force (3,) in body, by differences of the pose."""
    h = 1e-3
    before, now, after = pose_at(time_s - h), pose_at(time_s), pose_at(time_s + h)
    turn = Rotation.from_matrix(before[:3, :3].T @ after[:3, :3]).as_rotvec()
    acceleration = (after[:3, 3] - 2.0 * now[:3, 3] + before[:3, 3]) / h**2
    return turn / (2.0 * h), now[:3, :3].T @ (acceleration + UP)


def filled_buffer(
    imu: Imu,
    duration_s: float,
    rng: np.random.Generator,
    gyro_bias: Float,
    accel_bias: Float,
    noise_scale: float = 1.0,
) -> ImuBuffer:
    """Samples of `imu_at` from 0 to a time, with the IMU's white noise and constant biases."""
    buffer = ImuBuffer(50.0)
    root = noise_scale * np.sqrt(imu.rate_hz)
    for i in range(round(duration_s * imu.rate_hz) + 1):
        rate, force = imu_at(i / imu.rate_hz)
        rate = rate + gyro_bias + imu.gyro_noise_density * root * rng.standard_normal(3)
        force = force + accel_bias + imu.accel_noise_density * root * rng.standard_normal(3)
        assert buffer.add(ImuSample(round(i * 1e9 / imu.rate_hz), rate, force)) == ""
    return buffer


def stamps_ns(duration_s: float, rate_hz: float = 20.0) -> Iterator[int]:
    """Stamps of framesets from 0 to a time."""
    yield from (round(i * 1e9 / rate_hz) for i in range(round(duration_s * rate_hz) + 1))


def measured_motion(
    start_ns: int, end_ns: int, rng: np.random.Generator, rotation_sigma: float = 1e-3, translation_sigma: float = 3e-3
) -> RelativeMotion:
    """What vision would say of the motion of `pose_at` between two stamps."""
    noise = np.repeat([rotation_sigma, translation_sigma], 3) * rng.standard_normal(6)
    motion = np.linalg.inv(pose_at(start_ns * 1e-9)) @ pose_at(end_ns * 1e-9) @ transform(noise[:3], noise[3:])
    covariance = np.diag(np.repeat([rotation_sigma, translation_sigma], 3) ** 2)
    return RelativeMotion(start_ns, end_ns, motion, covariance, np.zeros((6, 6)), 100)
