"""Tracks of a rig that walks through a cloud of points, without images: for the self-calibration."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import so3_log
from graphvio.measurements.sensors import ImuSample
from graphvio.rig import Rig, StereoPair
from graphvio.self_calibration.online import SelfCalibration
from graphvio.self_calibration.parameters import BODY, DISTORTION, PAIR, STEREO, RigCalibration
from graphvio.self_calibration.window import View
from graphvio.simulation.imu import measure
from graphvio.simulation.motion import Motion
from graphvio.simulation.scenes import build_scene

RATE_HZ = 20.0
_POINTS = 1500
_ROOM_M = np.array([4.0, 4.0, 2.0])
_MAX_TRACKS = 150


@cache
def _motion_of(scene: str) -> Motion:
    """Return the walk through a scene, which is in motion from its first instant."""
    return build_scene(scene, None, 0.0).motion


@dataclass
class Walk:
    """A walk of a rig with its true calibration.

    Attributes:
        rig: the true one.
        sigma_px: noise of a corner's position.
        seed: of points, noise and IMU.
        speed: factor on the time of the scene's walk; 0 stands still.
    """

    rig: Rig
    sigma_px: float = 0.1
    seed: int = 0
    speed: float = 1.0
    scene: str = "room"

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self._motion = _motion_of(self.scene)
        centre = self._motion.at(np.array([0.0])).world_T_body[0, :3, 3]
        directions = self._rng.standard_normal((_POINTS, 3))
        directions /= np.abs(directions).max(axis=1, keepdims=True)
        self._points = centre + directions * _ROOM_M * self._rng.uniform(0.8, 1.6, (_POINTS, 1))

    def pose(self, seconds: float) -> Float:
        """Return the true ``world_T_body`` (4, 4)."""
        pose: Float = self._motion.at(np.array([seconds * self.speed])).world_T_body[0]
        return pose

    def views(self, world_T_body: Float) -> dict[int, View]:
        """Return what pairs and single cameras see."""
        body = np.linalg.inv(world_T_body)
        views = {}
        for j, group in enumerate(self.rig.groups):
            left_T_world = group.left.cam_T_body @ body
            in_left = self._points @ left_T_world[:3, :3].T + left_T_world[:3, 3]
            left, seen = group.left.project(in_left)
            ids = np.flatnonzero(seen)[:_MAX_TRACKS]
            left, in_left = left[ids], in_left[ids]
            right, matched = np.zeros_like(left), np.zeros(len(ids), dtype=bool)
            if isinstance(group, StereoPair):
                in_right = in_left @ group.right_T_left[:3, :3].T + group.right_T_left[:3, 3]
                right, matched = group.right.project(in_right)
            noise = self.sigma_px * self._rng.standard_normal((2, len(ids), 2))
            views[j] = View(ids, left + noise[0], right + noise[1], matched, 1.0 / in_left[:, 2])
        return views

    def framesets(self, duration_s: float) -> Iterator[tuple[int, Float, dict[int, View]]]:
        """Yield stamps, true poses and views."""
        seconds = np.arange(int(duration_s * RATE_HZ)) / RATE_HZ
        poses = self._motion.at(seconds * self.speed).world_T_body
        for k, pose in enumerate(poses):
            yield round(k * 1e9 / RATE_HZ), pose, self.views(pose)

    def samples(self, duration_s: float) -> list[ImuSample]:
        """Return IMU samples of the walk, by the IMU's clock; at a speed of 1 only."""
        assert self.rig.imu is not None
        times_s = np.arange(0.0, duration_s, 1.0 / self.rig.imu.rate_hz)
        stamps_ns = np.round(times_s * 1e9).astype(np.int64)
        track = measure(self._motion, self.rig.imu, times_s, stamps_ns, self.seed)
        return [
            ImuSample(int(stamp), rate, force)
            for stamp, rate, force in zip(
                track.stamps_ns, track.angular_velocity, track.linear_acceleration, strict=True
            )
        ]


def true_difference(written: Rig, true: Rig) -> Float:
    """Return the true difference (C,) of the cameras' parameters from the written calibration."""
    nominal, exact = RigCalibration.of(written), RigCalibration.of(true)
    rows = np.zeros((len(written.groups), PAIR))
    for j in range(len(rows)):
        cameras = np.hstack(
            [exact.intrinsics[j] - nominal.intrinsics[j], (exact.distortion - nominal.distortion)[j, :, :DISTORTION]]
        )
        rows[j, :STEREO] = cameras.ravel()
        stereo_R, body_R = (getattr(nominal, name)[j, :3, :3] for name in ("right_T_left", "body_T_left"))
        rows[j, STEREO : STEREO + 3] = so3_log(np.ascontiguousarray(stereo_R.T @ exact.right_T_left[j, :3, :3]))
        rows[j, STEREO + 3 : BODY] = exact.right_T_left[j, :3, 3] - nominal.right_T_left[j, :3, 3]
        rows[j, BODY : BODY + 3] = so3_log(np.ascontiguousarray(exact.body_T_left[j, :3, :3] @ body_R.T))
        rows[j, BODY + 3 :] = exact.body_T_left[j, :3, 3] - nominal.body_T_left[j, :3, 3]
    return np.asarray(rows.ravel()[nominal.columns])


def calibrated(calibration: SelfCalibration, walk: Walk, duration_s: float) -> SelfCalibration:
    """Let a self-calibration see a walk with true poses, and return it once its last result is in force."""
    samples = walk.samples(duration_s) if walk.rig.imu is not None else []
    at = 0
    for stamp_ns, pose, views in walk.framesets(duration_s):
        while at < len(samples) and samples[at].stamp_ns <= stamp_ns:
            calibration.add_sample(samples[at])
            at += 1
        calibration.update()
        calibration.add_frameset(stamp_ns, pose, views)
    for _ in range(20):
        calibration.update()
    calibration.close()
    return calibration
