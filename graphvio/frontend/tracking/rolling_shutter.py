"""Compensation of rolling shutters: where points of an image would be at its stamp, and where its lines see them.

Lines are exposed one after the other, the first at the image's stamp. Within the readout, the angular and the linear
acceleration of the rig are taken to change linearly; a point's depth determines how its pixel moves with the rig.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from graphvio.arrays import Float
from graphvio.cameras import distort, fold_radius
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.geometry import se3_inverse, so3_exp, so3_log
from graphvio.kernels import kernel
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.rig import Camera, CameraGroup, SingleCamera

_ROUNDS = 3  # a point's line depends on its pixel, and its pixel on the line
_MIN_Z = 1e-3
_MAX_POWER_OF_RATE = 2  # rates are fitted by parabolas: within a readout of 40 ms, the end of a turn is not linear
_MIN_SHARE_OF_LONGEST = 0.2  # of IMU steps that support the fit: samples in bursts do not determine a parabola


@dataclass(frozen=True, eq=False)
class ReadoutMotion:
    """Motion of body while an image is read out: rotation and translation as polynomials of the time since the stamp.

    Attributes:
        angular_velocity: (3,) rad/s at the image's stamp, frame body.
        velocity: (3,) m/s at the image's stamp, frame body at that instant.
        angular_acceleration: (3,) rad/s^2 at the stamp, frame body.
        acceleration: (3,) m/s^2 at the stamp, frame body at the stamp.
        angular_jerk: (3,) rad/s^3, frame body.
        jerk: (3,) m/s^3, frame body at the stamp.
        force: (3,) m/s^2 specific force, which the accelerometer measures, at the stamp, frame body at the stamp:
            acceleration less gravity. Zero where no IMU measures it.
        velocity_covariance: (3, 3) of the velocity, (m/s)^2, or None where the velocity is only a guess.
        angular_velocity_sigma: Standard deviation of the angular velocity about each axis, rad/s, where vision has
            measured it.
        is_by_imu: Whether an IMU has measured rotation and acceleration.
    """

    angular_velocity: Float
    velocity: Float
    angular_acceleration: Float = field(default_factory=lambda: np.zeros(3))
    acceleration: Float = field(default_factory=lambda: np.zeros(3))
    angular_jerk: Float = field(default_factory=lambda: np.zeros(3))
    jerk: Float = field(default_factory=lambda: np.zeros(3))
    force: Float = field(default_factory=lambda: np.zeros(3))
    velocity_covariance: Float | None = None
    angular_velocity_sigma: float = 0.0
    is_by_imu: bool = False

    @staticmethod
    def by_imu(interval: ImuInterval, gyro_bias: Float, accel_bias: Float) -> ReadoutMotion:
        """Return the readout motion that an IMU measures, without velocity and acceleration, which `falling` adds."""
        rates = _fitted(interval.steps_s, interval.angular_velocity - gyro_bias, _MAX_POWER_OF_RATE)
        turning = ReadoutMotion(rates[0], np.zeros(3), rates[1], angular_jerk=2.0 * rates[2], is_by_imu=True)
        middles_s, measured = np.cumsum(interval.steps_s) - 0.5 * interval.steps_s, interval.linear_acceleration
        turns = middles_s[:, None] ** np.arange(1, 4) @ _columns(turning)[0]
        turned = np.array([so3_exp(turn) @ force for turn, force in zip(turns, measured - accel_bias, strict=True)])
        forces = _fitted(interval.steps_s, turned, 1)
        return replace(turning, force=forces[0], jerk=forces[1])

    def falling(self, velocity: Float, gravity: Float) -> ReadoutMotion:
        """Return the motion with a velocity (3,), m/s, and gravity (3,), m/s^2 downwards, both in body at the stamp."""
        return replace(self, velocity=velocity, acceleration=self.force + gravity)

    @staticmethod
    def steady(cur_T_prev: Float, seconds: float) -> ReadoutMotion:
        """Return the readout motion that continues the motion ``cur_T_prev`` (4, 4) of body over the seconds before."""
        prev_T_cur = se3_inverse(cur_T_prev)
        rate = so3_log(np.ascontiguousarray(prev_T_cur[:3, :3])) / seconds
        return ReadoutMotion(rate, prev_T_cur[:3, :3].T @ prev_T_cur[:3, 3] / seconds)


def pixels_at_stamp(camera: Camera, pixels: Float, inverse_depths: Float, motion: ReadoutMotion) -> tuple[Float, Float]:
    """Return the pixels (N, 2) at which a global shutter would have seen points at the stamp, and their inverse depths.

    Args:
        camera: camera with a rolling shutter.
        pixels: (N, 2) as seen.
        inverse_depths: (N,) 1/m, at the instants when the points' lines were exposed.
        motion: motion of body during the readout.

    Returns:
        Pixels (N, 2), unchanged where the point would have been out of view, and inverse depths (N,).
    """
    rays, _ = camera.unproject(pixels)
    return _moved(
        pixels, rays, inverse_depths, 1e-6 * camera.line_time_us * pixels[:, 1], *_columns(motion), False,
        camera.body_T_cam, camera.model_number, camera.intrinsics, camera.distortion,
    )  # fmt: skip


def pixels_at_lines(camera: Camera, pixels: Float, inverse_depths: Float, motion: ReadoutMotion) -> tuple[Float, Float]:
    """Return the pixels (N, 2) at which a rolling shutter sees points, given where it would see them at the stamp.

    This is the inverse of `pixels_at_stamp`: pixels and inverse depths are given at the stamp, and returned at the
    instants when the points' lines are exposed.
    """
    rays, _ = camera.unproject(pixels)
    seen, depths = pixels, inverse_depths
    for _ in range(_ROUNDS):
        seen, depths = _moved(
            pixels, rays, inverse_depths, 1e-6 * camera.line_time_us * seen[:, 1], *_columns(motion), True,
            camera.body_T_cam, camera.model_number, camera.intrinsics, camera.distortion,
        )  # fmt: skip
    return seen, depths


def turned_rays(camera: Camera, pixels: Float, motion: ReadoutMotion) -> tuple[Float, Float]:
    """Return the rays of pixels as if the camera had not turned since the stamp, and the positions they are seen from.

    This does not need the depths of the points, which determine only how rays change with the camera's position.

    Args:
        camera: camera with a rolling shutter.
        pixels: (N, 2) as seen.
        motion: motion of body during the readout.

    Returns:
        Normalised coordinates (N, 2), and the rows (N, 4) of `graphvio.measurements.motion.CameraTracks.readout`.
    """
    rays, _ = camera.unproject(pixels)
    by_force = replace(motion, velocity=np.zeros(3), acceleration=motion.force)
    return _turned(rays, 1e-6 * camera.line_time_us * pixels[:, 1], *_columns(by_force), camera.body_T_cam)


def rays_by_depth(camera: Camera, pixels: Float, motion: ReadoutMotion) -> tuple[Float, Float]:
    """Return the rays at which a global shutter would have seen points at the stamp, for any depth.

    Args:
        camera: camera with a rolling shutter.
        pixels: (N, 2) as seen.
        motion: motion of body during the readout.

    Returns:
        Normalised coordinates (N, 2) of points at infinity, and their derivatives (N, 2) with respect to the inverse
        depth at the stamp, of which they are linear functions.
    """
    rays, _ = camera.unproject(pixels)
    times_s = 1e-6 * camera.line_time_us * pixels[:, 1]
    turned, readout = _turned(rays, times_s, *_columns(motion), camera.body_T_cam)
    shifts = readout[:, 1:] @ camera.body_T_cam[:3, :3]
    return turned, shifts[:, :2] - shifts[:, 2:] * turned


def as_at_stamp(frame: TrackedFrame, group: CameraGroup, motion: ReadoutMotion) -> TrackedFrame:
    """Return a frame with rays and points as global shutters would have seen them at the stamp; its pixels stay.

    The cameras of a pair see a point at nearly the same instant, so that its depth is known before the compensation.
    A frame may be compensated again, by another motion; the depths of single cameras then stay those of the first time.
    """
    was_at_stamp = bool(frame.shutter_px.any())
    if was_at_stamp:  # back to where the lines have seen the points
        frame = replace(frame, shutter_px=np.zeros_like(frame.shutter_px)).recalibrated(group)
    depths = np.where(frame.has_depth, np.maximum(frame.points[:, 2], 0.0), 0.0)
    left_px, depths_then = pixels_at_stamp(group.left, frame.pixels, depths, motion)
    shutter_px = np.zeros((len(frame.ids), 2, 2))
    shutter_px[:, 0] = left_px - frame.pixels
    if isinstance(group, SingleCamera):
        left, _ = group.left.unproject(left_px)
        _, slopes = rays_by_depth(group.left, frame.pixels, motion)
        points = np.column_stack([left, frame.points[:, 2] if was_at_stamp else depths_then])
        return replace(frame, left_rays=left, points=points, shutter_px=shutter_px, shutter_slopes=slopes)
    right_T_left = group.right_T_left
    z = np.column_stack([frame.left_rays, np.ones(len(depths))]) @ right_T_left[2, :3] + depths * right_T_left[2, 3]
    right_px, _ = pixels_at_stamp(group.right, frame.right_pixels, depths / np.maximum(z, _MIN_Z), motion)
    shutter_px[:, 1] = right_px - frame.right_pixels
    return replace(frame, shutter_px=shutter_px).recalibrated(group)


def _columns(motion: ReadoutMotion) -> tuple[Float, Float]:
    """Return rotation and translation as polynomials of time, (3, 3) each: rows are the coefficients of t, t^2, t^3."""
    turns = np.array([motion.angular_velocity, 0.5 * motion.angular_acceleration, motion.angular_jerk / 6.0])
    return turns, np.array([motion.velocity, 0.5 * motion.acceleration, motion.jerk / 6.0])


def _fitted(steps_s: Float, means: Float, max_power: int) -> Float:
    """Fit a polynomial of time whose means (N, 3) over N steps are given.

    Where there are few steps, or most of them are short, the coefficients of the highest powers are zero.

    Returns:
        Coefficients (max_power + 1, 3), the constant one first.
    """
    counted = int((steps_s >= _MIN_SHARE_OF_LONGEST * steps_s.max()).sum())
    ends, n = np.cumsum(steps_s), min(max_power + 1, counted)
    powers = np.arange(1, n + 1)
    integrals = (ends[:, None] ** powers - (ends - steps_s)[:, None] ** powers) / powers
    found = np.zeros((max_power + 1, 3))
    found[:n] = np.linalg.lstsq(integrals, means * steps_s[:, None], rcond=None)[0]
    return found


@kernel
def _turn_and_way(t: float, turns: Float, shifts: Float, lever: Float) -> tuple[Float, Float]:
    """Return the rotation (3, 3) of body from the stamp to a time, and the displacement (3,) of a point at a lever."""
    turn = so3_exp(t * turns[0] + t * t * turns[1] + t * t * t * turns[2])
    return turn, t * shifts[0] + t * t * shifts[1] + t * t * t * shifts[2] + turn @ lever - lever


@kernel
def _turned(rays: Float, times_s: Float, turns: Float, shifts: Float, body_T_cam: Float) -> tuple[Float, Float]:
    """Rotate rays (N, 2) back from times (N,) to the stamp; return them, and (N, 4) times and camera displacements."""
    turned, readout = rays.copy(), np.zeros((len(rays), 4))
    body_R_cam, lever = body_T_cam[:3, :3].copy(), body_T_cam[:3, 3].copy()
    for i in range(len(rays)):
        turn, way = _turn_and_way(times_s[i], turns, shifts, lever)
        readout[i, 0], readout[i, 1:] = times_s[i], way
        ray = body_R_cam.T @ (turn @ (body_R_cam @ np.array([rays[i, 0], rays[i, 1], 1.0])))
        if ray[2] > 1e-6:
            turned[i] = ray[:2] / ray[2]
    return turned, readout


@kernel
def _moved(
    pixels: Float, rays: Float, inverse_depths: Float, times_s: Float, turns: Float, shifts: Float, to_lines: bool,
    body_T_cam: Float, model: int, intrinsics: Float, distortion: Float,
) -> tuple[Float, Float]:  # fmt: skip
    """Move points from times (N,) to the stamp, or ``to_lines``, back: pixels (N, 2) and inverse depths (N,)."""
    moved, depths = pixels.copy(), inverse_depths.copy()
    limit = fold_radius(model, distortion)
    body_R_cam, lever = body_T_cam[:3, :3].copy(), body_T_cam[:3, 3].copy()
    for i in range(len(pixels)):
        w = inverse_depths[i]
        turn, way = _turn_and_way(times_s[i], turns, shifts, lever)
        shift = body_R_cam.T @ way
        turn = body_R_cam.T @ turn @ body_R_cam
        ray = np.array([rays[i, 0], rays[i, 1], 1.0])
        point = turn.T @ (ray - w * shift) if to_lines else turn @ ray + w * shift
        z = point[2]
        if not z > 1e-6 or not point[0] ** 2 + point[1] ** 2 < (limit * z) ** 2:
            continue
        xd, yd, _, _, _, _ = distort(model, distortion, point[0] / z, point[1] / z)
        moved[i, 0], moved[i, 1] = intrinsics[0] * xd + intrinsics[2], intrinsics[1] * yd + intrinsics[3]
        depths[i] = w / z
    return moved, depths
