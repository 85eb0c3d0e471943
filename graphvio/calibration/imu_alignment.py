"""Estimation of a camera's rotation in body (= IMU) and of their time offset, from rotations by gyro and vision.

With ``R`` the camera's rotation in body, body turns by ``R turn R^T`` where the camera turns by ``turn``; the gyro,
less its bias, must have measured that over the same interval by its own clock. Unknowns are a small rotation of ``R``,
the bias, and a correction of the offset; the positions of gyro and camera do not matter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import chdtri

from graphvio.arrays import Float, Int
from graphvio.calibration import paper_method
from graphvio.calibration.segments import Segments, of_one_length
from graphvio.errors import CalibrationError
from graphvio.geometry import skew, so3_exp, so3_log
from graphvio.kernels import kernel
from graphvio.rig import Imu

_LIMIT = float(chdtri(3, 1e-3))
_SIGMAS = 4.0
_FLOOR_RAD = 1e-3  # systematic error: scale and axes of a gyro
_FLOOR_S = 2e-4
_MIN_MOTIONS = 10
_MIN_TURNED = 3.0  # rms rotation about the second axis over the noise
_ROUNDS = 20
_STEP_S = 1e-3
_MAX_OFFSET_S, _COARSE_S = 0.1, 0.005  # range and step of the first search
_BIAS_SIGMA = 0.1  # rad/s, a priori
_NS_PER_S = 1e9


@dataclass(frozen=True, eq=False)
class ImuAlignment:
    """The rotation and time offset of a left camera relative to the IMU."""

    body_R_left: Float  # (3, 3)
    misrotation: Float  # (3,) rotation vector, radians in body, from the rig's rotation to this one
    covariance: Float  # (3, 3) of misrotation
    time_offset_s: float  # add it to the camera's stamps to get the IMU's
    time_offset_sigma_s: float  # standard deviation of time_offset_s
    rig_time_offset_s: float  # time offset in the rig
    gyro_bias: Float  # (3,) rad/s

    @property
    def is_turned(self) -> bool:
        """Whether the rig's rotation is significantly wrong."""
        return float(self.misrotation @ np.linalg.solve(self.covariance, self.misrotation)) > _LIMIT

    @property
    def is_late(self) -> bool:
        """Whether the rig's time offset is significantly wrong."""
        return abs(self.time_offset_s - self.rig_time_offset_s) > _SIGMAS * self.time_offset_sigma_s

    def warnings(self, name: str) -> list[str]:
        """Return sentences on a wrong rotation and a wrong time offset of the pair with this name."""
        sentences = []
        if self.is_turned:
            angle, sigma = np.linalg.norm(self.misrotation), np.sqrt(np.linalg.eigvalsh(self.covariance)[-1])
            sentences.append(
                f"{name} is turned by {np.rad2deg(angle):.2f} degrees (+- {np.rad2deg(sigma):.2f}) from where the rig "
                "has it against the IMU"
            )
        if self.is_late:
            sentences.append(
                f"{name}: the time offset between cameras and IMU is {1e3 * self.time_offset_s:.2f} ms (+- "
                f"{1e3 * self.time_offset_sigma_s:.2f}), and {1e3 * self.rig_time_offset_s:.2f} ms in the rig"
            )
        return sentences


def align(segments: Segments, camera: int, stamps_ns: Int, gyro: Float, imu: Imu, body_R_left: Float) -> ImuAlignment:
    """Estimate rotation and time offset of one camera.

    Args:
        segments: segments of all cameras.
        camera: index of the camera.
        stamps_ns: (S,) stamps of the gyro's samples, increasing.
        gyro: (S, 3) angular rates in body, rad/s.
        imu: the rig's IMU, with noise and time offset.
        body_R_left: (3, 3) rotation of the left camera in the rig file.

    Raises:
        CalibrationError: if gyro and vision do not overlap in time, or the rig did not turn about two axes.
    """
    of_camera = segments.select(segments.known[:, camera])
    chosen = of_camera.select(of_one_length(of_camera))
    rotations = _Rotations(chosen, camera, stamps_ns, gyro, imu)
    if len(rotations.turns) < _MIN_MOTIONS:
        raise CalibrationError("gyro and camera have less than a few seconds in common: the IMU cannot be checked")
    offset_s = rotations.likeliest_offset(imu.time_offset_s)
    by_gyro = rotations.by_gyro(offset_s, np.zeros(3))
    if not rotations.is_about_two_axes:
        raise CalibrationError(
            "the rig turned about one axis only, or hardly at all, so the camera's rotation against the IMU cannot be "
            "checked; turn it about two axes"
        )
    closed_form, _ = paper_method.rotation(np.swapaxes(rotations.turns, 1, 2), np.swapaxes(by_gyro, 1, 2))
    initial = (np.ascontiguousarray(body_R_left), closed_form)
    found = min((rotations.solve(each, offset_s) for each in initial), key=lambda each: each.cost)
    covariance = found.covariance
    return ImuAlignment(
        body_R_left=found.rotation,
        misrotation=so3_log(np.ascontiguousarray(found.rotation @ body_R_left.T)),
        covariance=covariance[:3, :3] + np.eye(3) * _FLOOR_RAD**2,
        time_offset_s=found.offset_s,
        time_offset_sigma_s=float(np.hypot(np.sqrt(covariance[6, 6]), _FLOOR_S)),
        rig_time_offset_s=imu.time_offset_s,
        gyro_bias=found.bias,
    )


@dataclass(frozen=True, eq=False)
class _Solution:
    rotation: Float
    bias: Float
    offset_s: float
    covariance: Float  # (7, 7) of rotation, bias, offset
    cost: float


class _Rotations:
    """Rotations of a camera by vision, and of body by the gyro over the same intervals."""

    def __init__(self, segments: Segments, camera: int, stamps_ns: Int, gyro: Float, imu: Imu) -> None:
        self._origin_ns = int(stamps_ns[0])
        self._times_s = (stamps_ns - self._origin_ns) / _NS_PER_S
        self._gyro = np.ascontiguousarray(gyro)
        self._gyro_variance = imu.gyro_noise_density**2
        margin_s = abs(imu.time_offset_s) + _MAX_OFFSET_S
        start, end = ((each - self._origin_ns) / _NS_PER_S for each in (segments.start_ns, segments.end_ns))
        inside = (start > margin_s) & (end < self._times_s[-1] - margin_s)
        self._start_s, self._end_s = start[inside], end[inside]
        self.turns = np.ascontiguousarray(segments.motions[inside, camera, :3, :3])
        self._covariances = segments.covariances[inside, camera, :3, :3]

    @property
    def is_about_two_axes(self) -> bool:
        """Whether the camera turned about a second axis by more than its noise."""
        turns = _logs(self.turns)
        second = np.linalg.eigvalsh(turns.T @ turns / len(turns))[1]
        noise = np.median(np.trace(self._covariances, axis1=1, axis2=2)) / 3.0
        return bool(second > _MIN_TURNED**2 * noise)

    def by_gyro(self, offset_s: float, bias: Float) -> Float:
        """Integrate the gyro to rotations (N, 3, 3) of body from start to end of the segments."""
        start, end = self._start_s + offset_s, self._end_s + offset_s
        return np.asarray(_integrated(self._times_s, self._gyro - bias, start, end))

    def likeliest_offset(self, around_s: float) -> float:
        """Find the offset at which the angles of both agree best; they are independent of the rotation in body."""
        angles = np.array([np.linalg.norm(so3_log(turn)) for turn in self.turns])
        tried = around_s + np.arange(-_MAX_OFFSET_S, _MAX_OFFSET_S + 1e-9, _COARSE_S)

        def misfit(offset_s: float) -> float:
            by_gyro = self.by_gyro(offset_s, np.zeros(3))
            return float(np.median(np.abs(angles - [np.linalg.norm(so3_log(turn)) for turn in by_gyro])))

        return float(min(tried.tolist(), key=misfit))

    def solve(self, rotation: Float, offset_s: float) -> _Solution:
        """Minimise the inliers' errors by Gauss-Newton, from an initial rotation and offset."""
        bias = np.zeros(3)
        normal, cost, weight = np.eye(7), np.inf, np.zeros(0)
        duration = self._end_s - self._start_s
        for number in range(_ROUNDS):
            errors, jacobians = self._linearised(rotation, bias, offset_s)
            noise = rotation @ self._covariances @ rotation.T
            noise = noise + (self._gyro_variance * duration)[:, None, None] * np.eye(3)
            information = np.linalg.inv(noise)
            squares = np.einsum("ni,nij,nj->n", errors, information, errors)
            scale = max(float(np.median(squares)) / float(chdtri(3, 0.5)), 1.0)  # factor on the noise
            weight = (squares < scale * _LIMIT).astype(np.float64)
            cost = float(np.minimum(squares, _LIMIT).sum())
            weighted = np.einsum("n,nki,nkl->nil", weight, jacobians, information)
            normal = np.einsum("nil,nlj->ij", weighted, jacobians)
            normal[3:6, 3:6] += np.eye(3) / _BIAS_SIGMA**2
            gradient = np.einsum("nil,nl->i", weighted, errors)
            gradient[3:6] += bias / _BIAS_SIGMA**2
            step = -np.linalg.lstsq(normal, gradient, rcond=1e-12)[0]
            rotation = so3_exp(np.ascontiguousarray(step[:3])) @ rotation
            bias, offset_s = bias + step[3:6], offset_s + float(np.clip(step[6], -_MAX_OFFSET_S, _MAX_OFFSET_S))
            if number > 2 and np.abs(step).max() < 1e-9:
                break
        used = weight > 0.0
        factor = max(float(np.mean(squares[used])) / 3.0, 1.0) if used.any() else 1.0
        covariance = np.asarray(factor * np.linalg.pinv(normal, hermitian=True), dtype=np.float64)
        return _Solution(rotation, bias, offset_s, covariance, cost)

    def _linearised(self, rotation: Float, bias: Float, offset_s: float) -> tuple[Float, Float]:
        """Compute errors (N, 3) in body at the end, and derivatives (N, 3, 7).

        The derivatives are with respect to left rotation, bias and offset.
        """
        by_vision = rotation @ self.turns @ rotation.T
        by_gyro = self.by_gyro(offset_s, bias)
        later = self.by_gyro(offset_s + _STEP_S, bias)
        errors = _logs(np.swapaxes(by_gyro, 1, 2) @ by_vision)
        jacobians = np.empty((len(errors), 3, 7))
        jacobians[:, :, :3] = np.swapaxes(by_vision, 1, 2) - np.eye(3)
        halfway = np.array([np.eye(3) - 0.5 * skew(turn) for turn in _logs(by_gyro)])
        jacobians[:, :, 3:6] = (self._end_s - self._start_s)[:, None, None] * halfway
        jacobians[:, :, 6] = (_logs(np.swapaxes(later, 1, 2) @ by_vision) - errors) / _STEP_S
        return errors, jacobians


def _logs(rotations: Float) -> Float:
    return np.array([so3_log(np.ascontiguousarray(each)) for each in rotations]).reshape(-1, 3)


@kernel
def _integrated(times_s: Float, rates: Float, start_s: Float, end_s: Float) -> Float:
    """Integrate rotations (N, 3, 3) of a body with angular velocities (S, 3), linear between times (S,)."""
    out = np.empty((len(start_s), 3, 3))
    for k in range(len(start_s)):
        turned = np.eye(3)
        at, i = start_s[k], np.searchsorted(times_s, start_s[k])
        rate = _rate_at(times_s, rates, i, at)
        while at < end_s[k]:
            until = min(times_s[i], end_s[k]) if i < len(times_s) else end_s[k]
            next_rate = _rate_at(times_s, rates, i, until)
            turned = turned @ so3_exp(0.5 * (rate + next_rate) * (until - at))
            at, rate = until, next_rate
            i += 1
        out[k] = turned
    return out


@kernel
def _rate_at(times_s: Float, rates: Float, after: int, at: float) -> Any:
    """Interpolate between a sample and the one before it; beyond the ends, return the first or last."""
    if after <= 0:
        return rates[0].copy()
    if after >= len(times_s):
        return rates[-1].copy()
    share = (at - times_s[after - 1]) / (times_s[after] - times_s[after - 1])
    return (1.0 - share) * rates[after - 1] + share * rates[after]
