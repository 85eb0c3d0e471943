"""The whole rig, and rigs of a part of its sensors."""

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

_MAX_DISTANCE_M = 20.0  # of cameras of one rig, and from its IMU
_IN_METRES = "translations are in metres: if these are in millimetres, divide them by 1000"


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
        if indices and not self.pairs:
            raise RigError(f"{self.name}: has no stereo pairs; choose among its cameras")
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
        """Return the rig with each camera as a single one, without pairs.

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
                f"{self.name}: has only single cameras ({names}), and {user} needs a stereo pair; graphvio run, slam, "
                "optimize and calibrate --what all take such rigs"
            )

    def without_imu(self) -> Rig:
        """Drop the IMU.

        Returns:
            The rig without it.

        Raises:
            RigError: if no pair is left that shows the scale.
        """
        return replace(self, imu=None)

    def without_stamp_offsets(self) -> Rig:
        """Return the rig for images whose stamps are corrected already, as those of framesets are."""

        def corrected(camera: Camera) -> Camera:
            if camera.stamp_offset_s == 0.0:
                return camera
            return as_written(replace(camera, stamp_offset_s=0.0), camera.body_T_cam)

        return self.with_cameras(corrected)

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
    """Return a rig that was read from a file, after a test of what no real one has, such as values in other units.

    Lenses must reach all of their images, unless there is a mask: images of a fisheye may have black corners.

    Raises:
        RigError: if a lens does not, its intrinsics are of none, or cameras are tens of metres apart.
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
