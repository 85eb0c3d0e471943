"""Realistic calibration errors: differences between the calibration in a recording's files and the true one.

For cameras the files are wrong: images are rendered with the rig's calibration, and the files get one with errors. For
the IMU the files are unchanged, and its data are wrong, by scale, misalignment, noise and a time offset.

Each component is sampled from a random stream of its own. So with the same seed, a component has the same error alone
as together with others, and the errors of two levels have the same directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import SourceError
from graphvio.geometry import se3, se3_inverse, so3_exp
from graphvio.rig import Camera, Imu, Rig, SingleCamera, StereoPair

_STREAM = 3  # number of the random stream of a seed; 1 is the IMU's noise, 2 the noise of images


@dataclass(frozen=True)
class CalibrationErrorSizes:
    """Sizes of calibration errors: standard deviations, unless noted otherwise. The default is no error.

    Attributes:
        focal_percent: focal length of each camera; fx and fy have one common factor.
        principal_point_px: cx and cy of each camera.
        distortion_percent: first two coefficients of each camera, k1 and k2 for most models, in percent of themselves.
        left_right_deg: rotation of the right camera about its own centre, for each axis.
        baseline_percent: length of the baseline.
        cameras_in_body_deg: rotation of all cameras together, about body's origin, for each axis.
        cameras_in_body_mm: translation of all cameras together, for each axis.
        pair_transform_deg: rotation of each pair but the first, about its left camera, and of each single camera, for
            each axis.
        pair_transform_mm: translation of each pair but the first, and of each single camera, for each axis.
        time_offset_ms: magnitude of the IMU's time offset; only its sign is random.
        imu_scale_percent: scale of each axis of gyro and accelerometer.
        imu_misalignment_deg: off-diagonal elements of the matrices of gyro and accelerometer, as angles.
        imu_noise_factor: ratio of the actual white noise to that in the files; not random.

    Raises:
        SourceError: if a size is negative or not finite, or the noise would be zero.
    """

    focal_percent: float = 0.0
    principal_point_px: float = 0.0
    distortion_percent: float = 0.0
    left_right_deg: float = 0.0
    baseline_percent: float = 0.0
    cameras_in_body_deg: float = 0.0
    cameras_in_body_mm: float = 0.0
    pair_transform_deg: float = 0.0
    pair_transform_mm: float = 0.0
    time_offset_ms: float = 0.0
    imu_scale_percent: float = 0.0
    imu_misalignment_deg: float = 0.0
    imu_noise_factor: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not np.isfinite(value) or value < 0.0 or (name == "imu_noise_factor" and value == 0.0):
                raise SourceError(f"calibration error: {name} is {value}; give a finite number that is not negative")

    @staticmethod
    def of_level(level: int | str, components: Sequence[str] | None = None) -> CalibrationErrorSizes:
        """Return the errors of one of `LEVELS`.

        Args:
            level: one of `LEVELS`.
            components: names of `COMPONENTS`, to which the errors are limited; None for all.

        Raises:
            SourceError: if there is no such level or component.
        """
        known = {str(each): error for each, error in _LEVELS.items()}.get(str(level))
        if known is None:
            raise SourceError(
                f"there is no calibration error of level {level}; choose from {', '.join(map(str, LEVELS))}, and for "
                f"a single error also its component: {', '.join(COMPONENTS)}"
            )
        if components is None:
            return known
        for name in components:
            if name not in COMPONENTS:
                raise SourceError(f"no calibration error has the name {name!r}; choose from {', '.join(COMPONENTS)}")
        kept = [each for name in components for each in COMPONENTS[name]]
        return CalibrationErrorSizes(**{name: getattr(known, name) for name in kept})


COMPONENTS: dict[str, tuple[str, ...]] = {
    "focal": ("focal_percent",),
    "principal-point": ("principal_point_px",),
    "distortion": ("distortion_percent",),
    "left-right-rotation": ("left_right_deg",),
    "baseline": ("baseline_percent",),
    "cameras-in-body": ("cameras_in_body_deg", "cameras_in_body_mm"),
    "pair-transform": ("pair_transform_deg", "pair_transform_mm"),
    "time-offset": ("time_offset_ms",),
    "imu-scale": ("imu_scale_percent",),
    "imu-misalignment": ("imu_misalignment_deg",),
    "imu-noise": ("imu_noise_factor",),
}
"""Name of a component -> its fields in `CalibrationErrorSizes`."""


def _level(
    factor: float, time_offset_ms: float, scale_percent: float, misalignment_deg: float, noise: float
) -> CalibrationErrorSizes:
    """Return the errors of a level: camera errors are ``factor`` times those of level 2, IMU errors are as given."""
    return CalibrationErrorSizes(
        focal_percent=factor * 0.1,
        principal_point_px=factor * 0.5,
        distortion_percent=factor * 0.5,
        left_right_deg=factor * 0.05,
        baseline_percent=factor * 0.2,
        cameras_in_body_deg=factor * 0.3,
        cameras_in_body_mm=factor * 5.0,
        pair_transform_deg=factor * 0.3,
        pair_transform_mm=factor * 5.0,
        time_offset_ms=time_offset_ms,
        imu_scale_percent=scale_percent,
        imu_misalignment_deg=misalignment_deg,
        imu_noise_factor=noise,
    )


_LEVELS = {
    1: _level(0.3, 0.5, 0.1, 0.05, 1.02),
    2: _level(1.0, 2.0, 0.3, 0.15, 1.2),
    3: _level(3.0, 8.0, 1.0, 0.5, 2.2),
}
LEVELS = tuple(_LEVELS)
"""Levels of `CalibrationErrorSizes.of_level`: a careful calibration, an ordinary one, and an old one."""


@dataclass(frozen=True, eq=False)
class ImuError:
    """Scale and misalignment of an IMU's data, which the files of a simulated recording do not contain.

    Attributes:
        gyro_matrix: (3, 3) matrix by which the true angular velocity is multiplied.
        accel_matrix: (3, 3) matrix by which the true specific force is multiplied.
    """

    gyro_matrix: Float = field(default_factory=lambda: np.eye(3))
    accel_matrix: Float = field(default_factory=lambda: np.eye(3))


@dataclass(frozen=True, eq=False)
class SampledError:
    """A sampled calibration error.

    Attributes:
        written_rig: the rig as the files describe it.
        true_rig: the rig with the true cameras, and the true noise and time offset of the IMU.
        imu: other errors of the IMU's data.
    """

    written_rig: Rig
    true_rig: Rig
    imu: ImuError


def draw(rig: Rig, error: CalibrationErrorSizes, seed: int) -> SampledError:
    """Sample a calibration error.

    Args:
        rig: the rig with the true cameras, and the IMU as its files describe it.
        error: sizes of the errors.
        seed: the same seed gives the same error.

    Raises:
        SourceError: if the seed is negative.
    """
    if seed < 0:
        raise SourceError(f"the seed {seed} of the calibration error is negative; give 0 or more")
    normal = {
        name: np.random.default_rng(np.random.SeedSequence([seed, _STREAM, number])).standard_normal
        for number, name in enumerate(COMPONENTS)
    }
    focal = 1.0 + 0.01 * error.focal_percent * normal["focal"](len(rig.cameras))
    centre_px = error.principal_point_px * normal["principal-point"]((len(rig.cameras), 2))
    distortion = 1.0 + 0.01 * error.distortion_percent * normal["distortion"]((len(rig.cameras), 2))
    turn = np.deg2rad(error.left_right_deg) * normal["left-right-rotation"]((len(rig.pairs), 3))
    baseline = 1.0 + 0.01 * error.baseline_percent * normal["baseline"](len(rig.pairs))
    in_body = _transform(normal["cameras-in-body"](6), error.cameras_in_body_deg, error.cameras_in_body_mm)
    pairs = []
    for j, pair in enumerate(rig.pairs):
        moved = np.eye(4)
        if j > 0:
            moved = _transform(normal["pair-transform"](6), error.pair_transform_deg, error.pair_transform_mm)
        left_T_right = se3_inverse(pair.right_T_left)
        left_T_right = se3(left_T_right[:3, :3] @ so3_exp(turn[j]), baseline[j] * left_T_right[:3, 3])
        body_T_left = in_body @ pair.left.body_T_cam @ moved
        each = zip((pair.left, pair.right), (body_T_left, body_T_left @ left_T_right), strict=True)
        left, right = (
            _camera(camera, focal[i], centre_px[i], distortion[i], body_T_cam)
            for i, (camera, body_T_cam) in enumerate(each, start=2 * j)
        )
        pairs.append(StereoPair(pair.name, left, right))
    singles = []
    for i, single in enumerate(rig.singles, start=2 * len(rig.pairs)):
        moved = _transform(normal["pair-transform"](6), error.pair_transform_deg, error.pair_transform_mm)
        body_T_cam = in_body @ single.left.body_T_cam @ moved
        singles.append(SingleCamera(_camera(single.left, focal[i], centre_px[i], distortion[i], body_T_cam)))
    sign = 1.0 if normal["time-offset"]() > 0.0 else -1.0
    imu = rig.imu if rig.imu is not None else Imu()
    true_imu = replace(
        imu,
        gyro_noise_density=error.imu_noise_factor * imu.gyro_noise_density,
        accel_noise_density=error.imu_noise_factor * imu.accel_noise_density,
        time_offset_s=imu.time_offset_s + sign * 1e-3 * error.time_offset_ms,
    )
    scale = 0.01 * error.imu_scale_percent * normal["imu-scale"]((2, 3))
    skewed = np.deg2rad(error.imu_misalignment_deg) * normal["imu-misalignment"]((2, 3, 3))
    gyro, accel = (np.eye(3) + np.diag(scale[i]) + skewed[i] * (1.0 - np.eye(3)) for i in (0, 1))
    return SampledError(
        replace(rig, pairs=tuple(pairs), singles=tuple(singles), imu=imu),
        replace(rig, imu=true_imu),
        ImuError(gyro, accel),
    )


def _camera(camera: Camera, focal: float, centre_px: Float, distortion: Float, body_T_cam: Float) -> Camera:
    intrinsics, lens = camera.intrinsics.copy(), camera.distortion.copy()
    intrinsics[:2] *= focal
    intrinsics[2:] += centre_px
    lens[:2] *= distortion
    return replace(camera, intrinsics=intrinsics, distortion=lens, body_T_cam=body_T_cam)


def _transform(normal: Float, angle_deg: float, shift_mm: float) -> Float:
    return se3(so3_exp(np.deg2rad(angle_deg) * normal[:3]), 1e-3 * shift_mm * normal[3:])
