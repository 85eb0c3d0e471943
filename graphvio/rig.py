"""The calibrated rig: stereo pairs, single cameras and an IMU, rigidly mounted.

All extrinsics are ``body_T_cam``. Body is the IMU's frame; a rig without an IMU may choose any. The objects are
immutable and validate their values on construction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.calibration_sigmas import FACTORY, CalibrationSigmas
from graphvio.cameras import (
    MODEL_NAMES,
    N_COEFFICIENTS,
    central_scale,
    lens_fault,
    project_points,
    unproject_pixels,
    view_fault,
)
from graphvio.errors import RigError
from graphvio.geometry import se3_inverse

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_ROTATION_TOLERANCE = 1e-3
_ROUNDING = 1e-14
_OVERLAP_DISTANCE_M = 5.0
_GRID = 12  # points of an image, across and down
_MAX_READOUT_US = 100e3
_MAX_READOUT_DIFFERENCE_NS = 1_000_000
MAX_AXES_ANGLE_DEG = 45.0
"""Between the cameras of a stereo pair: with more, patches look too different."""
MIN_BASELINE_M = 1e-3
"""Between these cameras."""
_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
_MAX_MATRIX_ERROR = 0.2


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera.

    Attributes:
        name: unique in the rig, such as ``cam0``.
        model: of the lens, one of `graphvio.cameras.MODEL_NAMES`.
        size_px: (width, height).
        intrinsics: (4,) ``[fx, fy, cx, cy]``, pixels.
        distortion: (8,), see `graphvio.cameras.COEFFICIENTS`; shorter input is filled with zeros.
        body_T_cam: (4, 4), metres.
        mask: image file whose black pixels are not used (parts of the rig or of its carrier), or None.
        line_time_us: time from one line's exposure to the next one's, from the top, microseconds; 0 of a global
            shutter. An image's stamp is the instant of its first line.

    Raises:
        RigError: if a value has the wrong shape, is not finite or out of range.
    """

    name: str
    model: str
    size_px: tuple[int, int]
    intrinsics: Float
    distortion: Float
    body_T_cam: Float
    mask: Path | None = None
    line_time_us: float = 0.0

    def __post_init__(self) -> None:
        where = f"camera {self.name}"
        if self.model not in MODEL_NAMES:
            raise RigError(f"{where}: unknown model {self.model!r}; use one of {', '.join(MODEL_NAMES)}")
        width, height = self.size_px
        if width < 16 or height < 16:
            raise RigError(f"{where}: image size {width}x{height} is too small; size_px is [width, height]")
        intrinsics = _finite(self.intrinsics, (4,), f"{where}: intrinsics [fx, fy, cx, cy]")
        if intrinsics[0] <= 0 or intrinsics[1] <= 0:
            raise RigError(f"{where}: focal lengths {intrinsics[:2].tolist()} must be positive, in pixels")
        given = np.asarray(self.distortion, dtype=np.float64).ravel()
        if len(given) > N_COEFFICIENTS:
            raise RigError(f"{where}: {len(given)} distortion coefficients; give at most {N_COEFFICIENTS}")
        filled = np.pad(given, (0, N_COEFFICIENTS - len(given)))
        distortion = _finite(filled, (N_COEFFICIENTS,), f"{where}: distortion")
        fault = lens_fault(self.model, distortion)
        if fault:
            raise RigError(f"{where}: {fault}")
        if not 0.0 <= self.line_time_us * height <= _MAX_READOUT_US:  # also refuses NaN
            raise RigError(
                f"{where}: line_time_us is {self.line_time_us}; it must be in microseconds, and {height} lines take at "
                f"most {1e-3 * _MAX_READOUT_US:g} ms"
            )
        _set(self, "size_px", (int(width), int(height)))
        _set(self, "intrinsics", intrinsics)
        _set(self, "distortion", distortion)
        _set(self, "body_T_cam", checked_transform(self.body_T_cam, f"{where}: body_T_cam"))

    @cached_property
    def focal_px(self) -> float:
        """Scale from normalised image units to pixels at the image centre, the mean of both axes.

        It is not that of `intrinsics` where the lens has a sphere that is off the centre.
        """
        mean = float(0.5 * (self.intrinsics[0] + self.intrinsics[1]))
        return mean * central_scale(self.model_number, self.distortion)

    @property
    def readout_ns(self) -> int:
        """Time from the first line's exposure to the last one's, nanoseconds; 0 of a global shutter."""
        return round(1e3 * self.line_time_us * (self.size_px[1] - 1))

    @cached_property
    def cam_T_body(self) -> Float:
        """Inverse (4, 4) of ``body_T_cam``."""
        return se3_inverse(self.body_T_cam)

    @property
    def model_number(self) -> int:
        """Number of the model in the kernels of `graphvio.cameras`."""
        return MODEL_NAMES[self.model]

    def project(self, points: Float) -> tuple[Float, Bool]:
        """Project points.

        Args:
            points: (N, 3) in the camera frame, metres.

        Returns:
            Pixels (N, 2), and whether each is inside the image (N,).
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        pixels, valid = project_points(self.model_number, self.intrinsics, self.distortion, points)
        return pixels, valid & self.contains(pixels)

    def unproject(self, pixels: Float) -> tuple[Float, Bool]:
        """Unproject pixels.

        Args:
            pixels: (N, 2), the centre of the first is (0, 0).

        Returns:
            Normalised coordinates (N, 2) ``[X / Z, Y / Z]``, and whether each pixel has a ray (N,).
        """
        pixels = np.ascontiguousarray(pixels, dtype=np.float64)
        return unproject_pixels(self.model_number, self.intrinsics, self.distortion, pixels)

    def contains(self, pixels: Float, border_px: float = 0.0) -> Bool:
        """Test whether pixels are inside the image.

        Args:
            pixels: (N, 2), the centre of the first is (0, 0).
            border_px: least distance from the edge.

        Returns:
            Whether each is (N,).
        """
        width, height = self.size_px
        x, y = pixels[:, 0], pixels[:, 1]
        inside_x = (x >= border_px) & (x <= width - 1 - border_px)
        return np.asarray(inside_x & (y >= border_px) & (y <= height - 1 - border_px))


def axes_angle_deg(left: Camera, right: Camera) -> float:
    """Compute the angle between the optical axes of two cameras."""
    return float(np.rad2deg(np.arccos(np.clip((right.cam_T_body @ left.body_T_cam)[2, 2], -1.0, 1.0))))


def overlap(left: Camera, right: Camera) -> float:
    """Compute the share of the left image that shows points, 5 m away, which the right camera sees too."""
    width, height = left.size_px
    u, v = np.meshgrid((np.arange(_GRID) + 0.5) / _GRID * width, (np.arange(_GRID) + 0.5) / _GRID * height)
    rays, has_ray = left.unproject(np.column_stack([u.ravel(), v.ravel()]))
    points = np.column_stack([_OVERLAP_DISTANCE_M * rays, np.full((len(rays), 1), _OVERLAP_DISTANCE_M)])
    right_T_left = right.cam_T_body @ left.body_T_cam
    _, is_seen = right.project(points @ right_T_left[:3, :3].T + right_T_left[:3, 3])
    return float(np.mean(is_seen & has_ray))


@dataclass(frozen=True, eq=False)
class StereoPair:
    """Left and right camera with overlapping views.

    Attributes:
        name: unique in the rig.
        left: the camera whose corners are tracked.
        right: the camera in which they are matched.

    Raises:
        RigError: if the baseline is below 1 mm, the optical axes are more than 45 degrees apart, or rolling shutters
            are read out in times that differ by more than 1 ms.
    """

    name: str
    left: Camera
    right: Camera

    def __post_init__(self) -> None:
        where = f"pair {self.name} ({self.left.name}, {self.right.name})"
        if self.baseline_m < MIN_BASELINE_M:
            raise RigError(
                f"{where}: baseline is {1e3 * self.baseline_m:.3f} mm; a stereo pair needs two cameras at "
                "different places: check body_T_cam of both"
            )
        axes_deg = axes_angle_deg(self.left, self.right)
        if axes_deg > MAX_AXES_ANGLE_DEG:
            raise RigError(
                f"{where}: optical axes are {axes_deg:.0f} degrees apart (at most "
                f"{MAX_AXES_ANGLE_DEG:.0f}); check which cameras form a pair and the direction of body_T_cam"
            )
        if abs(self.left.readout_ns - self.right.readout_ns) > _MAX_READOUT_DIFFERENCE_NS:
            raise RigError(
                f"{where}: its cameras read their lines out in {1e-6 * self.left.readout_ns:.1f} and "
                f"{1e-6 * self.right.readout_ns:.1f} ms; a pair needs the same line_time_us: make them single cameras"
            )

    @cached_property
    def right_T_left(self) -> Float:
        """Transform (4, 4) from left to right camera, ``P^s`` of the paper's eq. (2)."""
        return self.right.cam_T_body @ self.left.body_T_cam

    @property
    def baseline_m(self) -> float:
        """Distance between the optical centres, metres."""
        return float(np.linalg.norm(self.right_T_left[:3, 3]))

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Left and right camera."""
        return self.left, self.right


@dataclass(frozen=True, eq=False)
class SingleCamera:
    """A camera without a stereo partner: the depth of its points comes from motion.

    Attributes:
        left: the camera, whose corners are tracked as those of a pair's left camera are.
    """

    left: Camera

    @property
    def name(self) -> str:
        """Name of the camera."""
        return self.left.name

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The camera."""
        return (self.left,)


CameraGroup = StereoPair | SingleCamera
"""Cameras whose images are tracked together: two, or one."""


@dataclass(frozen=True)
class Imu:
    """The inertial sensor; its frame is body.

    Attributes:
        rate_hz: nominal rate.
        gyro_noise_density: white noise, rad/s/sqrt(Hz).
        gyro_random_walk: bias diffusion, rad/s^2/sqrt(Hz).
        accel_noise_density: white noise, m/s^2/sqrt(Hz).
        accel_random_walk: bias diffusion, m/s^3/sqrt(Hz).
        time_offset_s: ``t_imu = t_cam + time_offset``, Kalibr's ``timeshift_cam_imu``.
        gyro_matrix: (3, 3) by rows, scale and misalignment: angular velocities are multiplied by it.
        accel_matrix: (3, 3) by rows, the same for specific forces.

    Raises:
        RigError: if the rate or a density is not positive, a value is not finite, or a matrix is not near the identity.
    """

    rate_hz: float = 200.0
    gyro_noise_density: float = 1.7e-4
    gyro_random_walk: float = 2.0e-5
    accel_noise_density: float = 2.0e-3
    accel_random_walk: float = 3.0e-3
    time_offset_s: float = 0.0
    gyro_matrix: tuple[float, ...] = _IDENTITY
    accel_matrix: tuple[float, ...] = _IDENTITY

    def __post_init__(self) -> None:
        for name in ("gyro_matrix", "accel_matrix"):
            matrix = np.array(getattr(self, name), dtype=np.float64).ravel()
            if matrix.shape != (9,) or not np.abs(matrix - _IDENTITY).max() < _MAX_MATRIX_ERROR:  # also refuses NaN
                raise RigError(f"imu: {name} is {matrix.tolist()}; it must be three rows that are nearly the identity")
            _set(self, name, tuple(matrix.tolist()))
        for name, value in vars(self).items():
            if name.endswith("_matrix"):
                continue
            if not np.isfinite(value):
                raise RigError(f"imu: {name} is {value}; it must be a finite number")
            if name != "time_offset_s" and value <= 0:
                raise RigError(f"imu: {name} is {value}; it must be positive")
        if abs(self.time_offset_s) > 1.0:
            raise RigError(f"imu: time_offset_s is {self.time_offset_s}; it must be in seconds, less than one")

    @property
    def time_offset_ns(self) -> int:
        """`time_offset_s` in nanoseconds."""
        return round(self.time_offset_s * 1e9)

    @property
    def has_matrices(self) -> bool:
        """Whether readings have to be multiplied by a matrix."""
        return self.gyro_matrix != _IDENTITY or self.accel_matrix != _IDENTITY

    @property
    def matrices(self) -> tuple[Float, Float]:
        """`gyro_matrix` and `accel_matrix` as arrays (3, 3)."""
        return np.reshape(self.gyro_matrix, (3, 3)), np.reshape(self.accel_matrix, (3, 3))


@dataclass(frozen=True, eq=False)
class Rig:
    """Stereo pairs, cameras without a partner, and at most one IMU.

    Attributes:
        pairs: none where there are only single cameras, whose scale an IMU shows.
        imu: None for vision only.
        name: used in messages and results.
        calibration_sigmas: how far the calibration is known.
        singles: cameras without a partner.

    Raises:
        RigError: if there is no camera, or neither a pair nor an IMU, or if two cameras, or two groups of cameras,
            share a name.
    """

    pairs: tuple[StereoPair, ...]
    imu: Imu | None = None
    name: str = "rig"
    calibration_sigmas: CalibrationSigmas = FACTORY
    singles: tuple[SingleCamera, ...] = ()

    def __post_init__(self) -> None:
        _set(self, "pairs", tuple(self.pairs))
        _set(self, "singles", tuple(self.singles))
        if not self.groups:
            raise RigError(f"{self.name}: has no camera; give a stereo pair, or a single camera and an IMU")
        if not self.pairs and self.imu is None:
            alone = ", ".join(single.name for single in self.singles)
            raise RigError(
                f"{self.name}: {alone} without a stereo pair and without an IMU: the scale cannot be known; "
                "use an IMU, or add a camera whose view overlaps"
            )
        names = [camera.name for camera in self.cameras]
        for kind, all_names in (("camera", names), ("group", [group.name for group in self.groups])):
            twice = {n for n in all_names if all_names.count(n) > 1}
            if twice:
                raise RigError(f"{self.name}: {kind} {sorted(twice)[0]!r} appears twice; names must differ")

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """All cameras: left and right of the first pair, then of the second, and so on; then single ones."""
        return tuple(camera for group in self.groups for camera in group.cameras)

    @property
    def groups(self) -> tuple[CameraGroup, ...]:
        """Pairs, then cameras without a partner: the indices of `graphvio.measurements.sensors.FrameSet.images`."""
        return (*self.pairs, *self.singles)

    def left2_T_left1(self, first: int = 0, second: int = 1) -> Float:
        """Transform from one pair's left camera to another's.

        Args:
            first: index of the one pair.
            second: index of the other.

        Returns:
            ``left2_T_left1`` (4, 4), ``P_12`` of the paper's eq. (1).
        """
        return self.pairs[second].left.cam_T_body @ self.pairs[first].left.body_T_cam

    def with_pairs(self, indices: Sequence[int]) -> Rig:
        """Select pairs of the rig, without cameras that have no partner.

        Args:
            indices: of the pairs, in the order wanted.

        Returns:
            The rig of these pairs.

        Raises:
            RigError: if an index does not exist or is repeated.
        """
        for index in indices:
            if not 0 <= index < len(self.pairs):
                raise RigError(f"{self.name}: there is no pair {index}; choose from 0 to {len(self.pairs) - 1}")
        if len(set(indices)) < len(indices):
            raise RigError(f"{self.name}: a pair is asked for twice; name each once")
        return replace(self, pairs=tuple(self.pairs[i] for i in indices), singles=())

    def with_only(self, cameras: Sequence[str]) -> Rig:
        """Select cameras of the rig: pairs of which both are selected stay pairs, others become single cameras.

        Args:
            cameras: names; a number N is short for ``camN``.

        Returns:
            The rig of these cameras.

        Raises:
            RigError: if there is no such camera, or neither a pair nor an IMU is left.
        """
        names = [camera.name for camera in self.cameras]
        wanted = {f"cam{name}" if name.isdecimal() and name not in names else name for name in cameras}
        for name in sorted(wanted - set(names)):
            raise RigError(f"{self.name}: there is no camera {name!r}; choose from {', '.join(names)}")
        pairs = [pair for pair in self.pairs if {camera.name for camera in pair.cameras} <= wanted]
        paired = {camera.name for pair in pairs for camera in pair.cameras}
        singles = [SingleCamera(camera) for camera in self.cameras if camera.name in wanted - paired]
        return replace(self, pairs=tuple(pairs), singles=tuple(singles))

    def without_pairs(self) -> Rig:
        """Take each camera for a single one.

        Returns:
            The rig without pairs.

        Raises:
            RigError: if there is no IMU.
        """
        return replace(self, pairs=(), singles=tuple(SingleCamera(camera) for camera in self.cameras))

    def need_pairs(self, user: str) -> None:
        """Refuse a rig of single cameras only.

        Args:
            user: what needs a stereo pair.

        Raises:
            RigError: if there is none.
        """
        if not self.pairs:
            names = ", ".join(single.name for single in self.singles)
            raise RigError(
                f"{self.name}: has only single cameras ({names}), and {user} needs a stereo pair; graphvio run takes "
                "such rigs"
            )

    def without_imu(self) -> Rig:
        """Drop the IMU.

        Returns:
            The rig without it.

        Raises:
            RigError: if no pair is left that shows the scale.
        """
        return replace(self, imu=None)

    def with_cameras(self, change: Callable[[Camera], Camera]) -> Rig:
        """Replace each camera by what a function makes of it.

        Args:
            change: returns the camera to be used instead.

        Returns:
            The rig with these cameras.
        """
        pairs = [replace(pair, left=change(pair.left), right=change(pair.right)) for pair in self.pairs]
        singles = [SingleCamera(change(single.left)) for single in self.singles]
        return replace(self, pairs=tuple(pairs), singles=tuple(singles))


def checked_views(rig: Rig) -> Rig:
    """Return a rig that was read from a file, after a test that its lenses reach all of their images.

    Cameras with a mask are not tested: images of a fisheye may have black corners.

    Raises:
        RigError: if one does not.
    """
    for camera in rig.cameras:
        if camera.mask is None:
            fault = view_fault(camera.model, camera.intrinsics, camera.distortion, camera.size_px)
            if fault:
                raise RigError(f"camera {camera.name}: {fault}")
    return rig


def as_written(camera: Camera, body_T_cam: Float) -> Camera:
    """Restore the exact digits of the transform (4, 4) in a camera that was read from a file.

    The constructor orthonormalises rotations, which may change the last digit. A transform that differs by more than
    rounding stays as the constructor made it.
    """
    given = np.array(body_T_cam, dtype=np.float64)
    if np.abs(given - camera.body_T_cam).max() <= _ROUNDING:
        _set(camera, "body_T_cam", given)
    return camera


def checked_transform(matrix: object, where: str) -> Float:
    """Validate a rigid transform and orthonormalise its rotation.

    Args:
        matrix: (4, 4).
        where: start of the error message.

    Raises:
        RigError: if the shape is wrong, a value is not finite, or the upper left block is no rotation.
    """
    transform = _finite(matrix, (4, 4), where)
    rotation = transform[:3, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if off > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise RigError(
            f"{where}: the upper left 3x3 block is no rotation (R R^T differs from 1 by {off:.2g}, "
            f"determinant {np.linalg.det(rotation):.3g}); check that the matrix is complete and row-major"
        )
    if np.abs(transform[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise RigError(f"{where}: the last row is {transform[3].tolist()}; it must be [0, 0, 0, 1]")
    u, _, vt = np.linalg.svd(rotation)
    transform[:3, :3] = u @ vt
    return transform


def _finite(values: object, shape: tuple[int, ...], where: str) -> Float:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise RigError(f"{where}: is not numeric ({error})") from None
    if array.shape != shape:
        raise RigError(f"{where}: has shape {array.shape}; it must be {shape}")
    if not np.isfinite(array).all():
        raise RigError(f"{where}: holds NaN or infinity")
    return array


def _set(frozen: object, name: str, value: object) -> None:
    object.__setattr__(frozen, name, value)
