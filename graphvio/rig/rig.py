"""The whole rig, and methods that select, remove or change its sensors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from graphvio.arrays import Float
from graphvio.calibration_sigmas import FACTORY, CalibrationSigmas
from graphvio.errors import RigError
from graphvio.rig.camera import Camera, as_written
from graphvio.rig.groups import CameraGroup, SingleCamera, StereoPair
from graphvio.rig.imu import Imu
from graphvio.rig.lens_checks import intrinsics_fault, view_fault
from graphvio.rig.values import set_value

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_MAX_DISTANCE_M = 20.0  # between the cameras of a pair, and between a camera and the IMU
_IN_METRES = "translations are in metres: if these are in millimetres, divide them by 1000"


@dataclass(frozen=True, eq=False)
class Rig:
    """Stereo pairs, single cameras, and at most one IMU.

    Attributes:
        pairs: stereo pairs; empty for a rig of single cameras, which gets its scale from the IMU.
        imu: the IMU, or None for vision only.
        name: name of the rig in messages and results.
        calibration_sigmas: standard deviations of the calibration.
        singles: cameras without a stereo partner.

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
        set_value(self, "pairs", tuple(self.pairs))
        set_value(self, "singles", tuple(self.singles))
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
        """All cameras: left and right of the first pair, then of the second, and so on; then the single cameras."""
        return tuple(camera for group in self.groups for camera in group.cameras)

    @property
    def groups(self) -> tuple[CameraGroup, ...]:
        """Pairs, then single cameras; `graphvio.measurements.sensors.FrameSet.images` has their indices as keys."""
        return (*self.pairs, *self.singles)

    def left2_T_left1(self, first: int = 0, second: int = 1) -> Float:
        """Return the transform from the left camera of one pair to that of another.

        Args:
            first: index of the pair to transform from.
            second: index of the pair to transform to.

        Returns:
            ``left2_T_left1`` (4, 4), ``P_12`` of the paper's eq. (1).
        """
        return self.pairs[second].left.cam_T_body @ self.pairs[first].left.body_T_cam

    def with_pairs(self, indices: Sequence[int]) -> Rig:
        """Select pairs of the rig; single cameras are left out.

        Args:
            indices: indices of the pairs, in the order wanted.

        Returns:
            The rig of these pairs.

        Raises:
            RigError: if an index does not exist or is repeated.
        """
        if indices and not self.pairs:
            raise RigError(f"{self.name}: has no stereo pairs; choose among its cameras")
        for index in indices:
            if not 0 <= index < len(self.pairs):
                raise RigError(f"{self.name}: there is no pair {index}; choose from 0 to {len(self.pairs) - 1}")
        if len(set(indices)) < len(indices):
            raise RigError(f"{self.name}: a pair is asked for twice; name each once")
        return replace(self, pairs=tuple(self.pairs[i] for i in indices), singles=())

    def with_only(self, cameras: Sequence[str]) -> Rig:
        """Select cameras of the rig; a pair stays one if both its cameras are selected, others become single cameras.

        Args:
            cameras: names of the cameras; a number N is short for ``camN``.

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
        """Return the rig with each camera as a single one, without pairs.

        Raises:
            RigError: if there is no IMU.
        """
        return replace(self, pairs=(), singles=tuple(SingleCamera(camera) for camera in self.cameras))

    def need_pairs(self, user: str) -> None:
        """Raise an error if the rig has no stereo pair.

        Args:
            user: the command or function that needs a stereo pair, for the message.

        Raises:
            RigError: if there is none.
        """
        if not self.pairs:
            names = ", ".join(single.name for single in self.singles)
            raise RigError(
                f"{self.name}: has only single cameras ({names}), and {user} needs a stereo pair; graphvio run, slam, "
                "optimize and calibrate --what all take such rigs"
            )

    def without_imu(self) -> Rig:
        """Return the rig without its IMU.

        Returns:
            The rig, for vision only.

        Raises:
            RigError: if the rig has no stereo pair, so that the scale would be unknown.
        """
        return replace(self, imu=None)

    def without_stamp_offsets(self) -> Rig:
        """Return the rig with stamp offsets of 0, for images whose stamps are corrected already, as in framesets."""

        def corrected(camera: Camera) -> Camera:
            if camera.stamp_offset_s == 0.0:
                return camera
            return as_written(replace(camera, stamp_offset_s=0.0), camera.body_T_cam)

        return self.with_cameras(corrected)

    def with_cameras(self, change: Callable[[Camera], Camera]) -> Rig:
        """Replace each camera by the result of a function.

        Args:
            change: takes a camera, and returns the one to be used instead.

        Returns:
            The rig with these cameras.
        """
        pairs = [replace(pair, left=change(pair.left), right=change(pair.right)) for pair in self.pairs]
        singles = [SingleCamera(change(single.left)) for single in self.singles]
        return replace(self, pairs=tuple(pairs), singles=tuple(singles))


def checked_views(rig: Rig) -> Rig:
    """Check a rig that was read from a file for values that no real rig has, such as those in other units; return it.

    Rays must reach all corners of an image, unless the camera has a mask: images of a fisheye may have black corners.

    Raises:
        RigError: if a corner is not reached, intrinsics are implausible, or the cameras of a pair, or a camera and the
            IMU, are more than 20 m apart.
    """
    for camera in rig.cameras:
        fault = intrinsics_fault(camera.focal_px, camera.intrinsics, camera.size_px)
        if not fault and camera.mask is None:
            fault = view_fault(camera.model, camera.intrinsics, camera.distortion, camera.size_px)
        if fault:
            raise RigError(f"camera {camera.name}: {fault}")
        from_imu_m = float(np.linalg.norm(camera.body_T_cam[:3, 3]))
        if rig.imu is not None and from_imu_m > _MAX_DISTANCE_M:
            raise RigError(f"camera {camera.name}: is {from_imu_m:.0f} m from the IMU; {_IN_METRES}")
    for pair in rig.pairs:
        if pair.baseline_m > _MAX_DISTANCE_M:
            raise RigError(f"pair {pair.name}: baseline is {pair.baseline_m:.0f} m; {_IN_METRES}")
    return rig
