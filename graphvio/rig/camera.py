"""One camera: its lens model and its pose in body, and functions that compare two cameras."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.cameras import (
    MODEL_NAMES,
    N_COEFFICIENTS,
    central_scale,
    project_points,
    unproject_pixels,
)
from graphvio.errors import RigError
from graphvio.geometry import se3_inverse
from graphvio.rig.lens_checks import lens_fault
from graphvio.rig.values import checked_transform, finite, set_value

_ROUNDING = 1e-14
_OVERLAP_DISTANCE_M = 5.0
_GRID = 12  # image points of `overlap`, across and down
_MAX_READOUT_US = 100e3
_MAX_STAMP_OFFSET_S = 1.0


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera.

    Attributes:
        name: name of the camera, unique in the rig, such as ``cam0``.
        model: lens model, one of `graphvio.cameras.MODEL_NAMES`.
        size_px: image size (width, height).
        intrinsics: (4,) ``[fx, fy, cx, cy]``, pixels.
        distortion: coefficients (8,), see `graphvio.cameras.COEFFICIENTS`; shorter input is filled with zeros.
        body_T_cam: pose (4, 4) of the camera in body, metres.
        mask: image file whose black pixels are not used (parts of the rig or of its carrier), or None.
        line_time_us: time from the exposure of one line to that of the next, from the top, microseconds; 0 for a
            global shutter. An image's stamp is the instant of its first line.
        stamp_offset_s: offset that is added to the stamps of this camera's images to get instants on the common clock
            of the rig's cameras; negative if the stamps are late. Sources add it, so that the stamps of framesets are
            instants.

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
    stamp_offset_s: float = 0.0

    def __post_init__(self) -> None:
        where = f"camera {self.name}"
        if self.model not in MODEL_NAMES:
            raise RigError(f"{where}: unknown model {self.model!r}; use one of {', '.join(MODEL_NAMES)}")
        width, height = self.size_px
        if width < 16 or height < 16:
            raise RigError(f"{where}: image size {width}x{height} is too small; size_px is [width, height]")
        intrinsics = finite(self.intrinsics, (4,), f"{where}: intrinsics [fx, fy, cx, cy]")
        if intrinsics[0] <= 0 or intrinsics[1] <= 0:
            raise RigError(f"{where}: focal lengths {intrinsics[:2].tolist()} must be positive, in pixels")
        given = np.asarray(self.distortion, dtype=np.float64).ravel()
        if len(given) > N_COEFFICIENTS:
            raise RigError(f"{where}: {len(given)} distortion coefficients; give at most {N_COEFFICIENTS}")
        filled = np.pad(given, (0, N_COEFFICIENTS - len(given)))
        distortion = finite(filled, (N_COEFFICIENTS,), f"{where}: distortion")
        fault = lens_fault(self.model, distortion)
        if fault:
            raise RigError(f"{where}: {fault}")
        if not 0.0 <= self.line_time_us * height <= _MAX_READOUT_US:  # also refuses NaN
            raise RigError(
                f"{where}: line_time_us is {self.line_time_us}; it must be in microseconds, and {height} lines take at "
                f"most {1e-3 * _MAX_READOUT_US:g} ms"
            )
        if not abs(self.stamp_offset_s) < _MAX_STAMP_OFFSET_S:  # also refuses NaN
            raise RigError(f"{where}: stamp_offset_s is {self.stamp_offset_s}; it must be in seconds, less than one")
        set_value(self, "size_px", (int(width), int(height)))
        set_value(self, "intrinsics", intrinsics)
        set_value(self, "distortion", distortion)
        set_value(self, "body_T_cam", checked_transform(self.body_T_cam, f"{where}: body_T_cam"))

    @cached_property
    def focal_px(self) -> float:
        """Scale from normalised image units to pixels at the image centre, the mean of both axes.

        For lens models with ``xi`` it is the focal length in `intrinsics` divided by ``1 + xi``.
        """
        mean = float(0.5 * (self.intrinsics[0] + self.intrinsics[1]))
        return mean * central_scale(self.model_number, self.distortion)

    @property
    def readout_ns(self) -> int:
        """Time from the exposure of the first line to that of the last, nanoseconds; 0 for a global shutter."""
        return round(1e3 * self.line_time_us * (self.size_px[1] - 1))

    @property
    def stamp_offset_ns(self) -> int:
        """`stamp_offset_s` in nanoseconds."""
        return round(1e9 * self.stamp_offset_s)

    @cached_property
    def cam_T_body(self) -> Float:
        """Inverse (4, 4) of ``body_T_cam``."""
        return se3_inverse(self.body_T_cam)

    @property
    def model_number(self) -> int:
        """Number of the lens model, as the kernels of `graphvio.cameras` take it."""
        return MODEL_NAMES[self.model]

    def project(self, points: Float) -> tuple[Float, Bool]:
        """Project points to pixels.

        Args:
            points: (N, 3) in the camera frame, metres.

        Returns:
            Pixels (N, 2), and whether each is inside the image (N,).
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        pixels, valid = project_points(self.model_number, self.intrinsics, self.distortion, points)
        return pixels, valid & self.contains(pixels)

    def unproject(self, pixels: Float) -> tuple[Float, Bool]:
        """Compute the rays of pixels.

        Args:
            pixels: (N, 2); the centre of the first pixel is (0, 0).

        Returns:
            Normalised coordinates (N, 2) ``[X / Z, Y / Z]``, and whether each pixel has a ray (N,).
        """
        pixels = np.ascontiguousarray(pixels, dtype=np.float64)
        return unproject_pixels(self.model_number, self.intrinsics, self.distortion, pixels)

    def contains(self, pixels: Float, border_px: float = 0.0) -> Bool:
        """Test whether pixels are inside the image.

        Args:
            pixels: (N, 2); the centre of the first pixel is (0, 0).
            border_px: least distance from the image's edge, pixels.

        Returns:
            Whether each pixel is inside (N,).
        """
        width, height = self.size_px
        x, y = pixels[:, 0], pixels[:, 1]
        inside_x = (x >= border_px) & (x <= width - 1 - border_px)
        return np.asarray(inside_x & (y >= border_px) & (y <= height - 1 - border_px))


def axes_angle_deg(left: Camera, right: Camera) -> float:
    """Compute the angle between the optical axes of two cameras, degrees."""
    return float(np.rad2deg(np.arccos(np.clip((right.cam_T_body @ left.body_T_cam)[2, 2], -1.0, 1.0))))


def overlap(left: Camera, right: Camera) -> float:
    """Compute the share of the left image whose points, taken at a depth of 5 m, the right camera sees too."""
    width, height = left.size_px
    u, v = np.meshgrid((np.arange(_GRID) + 0.5) / _GRID * width, (np.arange(_GRID) + 0.5) / _GRID * height)
    rays, has_ray = left.unproject(np.column_stack([u.ravel(), v.ravel()]))
    points = np.column_stack([_OVERLAP_DISTANCE_M * rays, np.full((len(rays), 1), _OVERLAP_DISTANCE_M)])
    right_T_left = right.cam_T_body @ left.body_T_cam
    _, is_seen = right.project(points @ right_T_left[:3, :3].T + right_T_left[:3, 3])
    return float(np.mean(is_seen & has_ray))


def as_written(camera: Camera, body_T_cam: Float) -> Camera:
    """Restore the exact digits of the transform (4, 4) of a camera that was read from a file.

    The constructor orthonormalises rotations, which may change the last digit. If the given transform differs from the
    constructor's by more than rounding, the camera keeps the latter.
    """
    given = np.array(body_T_cam, dtype=np.float64)
    if np.abs(given - camera.body_T_cam).max() <= _ROUNDING:
        set_value(camera, "body_T_cam", given)
    return camera
